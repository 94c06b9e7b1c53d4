"""Whether tables and live displays can be drawn."""

from __future__ import annotations

import codecs
import os
import shutil
import sys
from collections.abc import Mapping

from vla_zenoh.lab.doctor.finding import HostFinding

NARROWEST_COLUMNS = 80


def terminal(
    environ: Mapping[str, str] | None = None,
    encoding: str | None = None,
    columns: int | None = None,
) -> HostFinding:
    """The terminal shows UTF-8 and is wide enough; arguments stand in for what is really there."""
    environ = os.environ if environ is None else environ
    encoding = encoding or str(sys.stdout.encoding or "ascii")
    columns = columns or shutil.get_terminal_size().columns
    found = f"{environ.get('TERM') or 'no TERM'}, {encoding}, {columns} columns"
    if codecs.lookup(encoding).name != "utf-8":
        return HostFinding("terminal", "warn", found, "export LANG=C.UTF-8")
    if columns < NARROWEST_COLUMNS:
        return HostFinding("terminal", "warn", found, f"make it {NARROWEST_COLUMNS} columns wide")
    return HostFinding("terminal", "ok", found)
