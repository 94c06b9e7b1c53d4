"""A robot and its model to look at, in Rerun: samples of a live robot or of a recording.

`show.Show` takes samples as they were heard and logs them into a Rerun stream; `layout` says how
the views stand, `shapes` what the robot looks like. Nothing here speaks Zenoh or has a clock.
"""

from __future__ import annotations
