"""A run in a file: MCAP that Foxglove, Rerun and ``ros2 bag`` open, written and read without loss.

`writer.RunWriter` takes samples as they were heard, `reader.open_recording` gives them back, and
`run.load_run` makes records of them. Nothing here speaks Zenoh or has a clock.
"""

from __future__ import annotations
