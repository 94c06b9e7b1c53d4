"""Declarations of the benchmarks, whose files name their packages."""

from __future__ import annotations

from pathlib import Path

from vla_zenoh.plugins import FilePlugin

SUITES = Path(__file__).with_name("suites")

LIBERO = FilePlugin(file=SUITES / "libero.py")
METAWORLD = FilePlugin(file=SUITES / "metaworld.py")
OGBENCH = FilePlugin(file=SUITES / "ogbench.py")
SO101 = FilePlugin(file=SUITES / "so101.py")
