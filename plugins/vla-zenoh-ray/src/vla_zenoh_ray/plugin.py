"""The model ``ray_serve``: its declaration."""

from __future__ import annotations

from pathlib import Path

from vla_zenoh.plugins import FilePlugin

RAY_SERVE = FilePlugin(file=Path(__file__).parent)
