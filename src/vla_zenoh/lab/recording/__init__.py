"""Recordings: MCAP files that Foxglove, Rerun and ``ros2 bag`` open, without loss.

`recorder.Recorder` writes the keys of a robot to a file, `reader.open_recording` reads the samples,
`run.load_run` decodes them, and `replay.Replay` publishes them again.
"""

from __future__ import annotations
