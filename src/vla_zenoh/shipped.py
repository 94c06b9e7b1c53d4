"""Declarations of the models in this package; see `vla_zenoh.plugins`.

Each is an entry point in ``pyproject.toml``: ``NAME = "vla_zenoh.shipped:NAME"``.
"""

from __future__ import annotations

from vla_zenoh.plugins import FilePlugin
from vla_zenoh.resources import shipped


def __getattr__(name: str) -> FilePlugin:
    for file in (shipped("models") / name, shipped("models") / f"{name}.py"):
        if not name.startswith("_") and file.exists():
            return FilePlugin(file=file)
    raise AttributeError(f"vla-zenoh ships no model {name!r}")
