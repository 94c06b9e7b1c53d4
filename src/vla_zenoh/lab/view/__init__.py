"""Live and recorded runs in Rerun.

`rerun_logger.RerunLogger` logs samples into a Rerun stream, `layout` arranges the views, `viewer`
starts the viewer, `listener` receives the samples of a live robot.
"""

from __future__ import annotations
