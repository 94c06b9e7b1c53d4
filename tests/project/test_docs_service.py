"""The systemd unit of the page about services; `test_docs_commands` checks its command line."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from vla_zenoh.runtime.launch import STOP_BUDGET_S
from vla_zenoh.runtime.process import INNER_PRIORITY, LINK_PRIORITY, LOOP_PRIORITY

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "service.md"


def unit() -> str:
    block = re.search(r"^    \[Unit\]\n(?:(?:    .*)?\n)+", PAGE.read_text("utf-8"), re.MULTILINE)
    assert block is not None
    return textwrap.dedent(block[0])


def test_the_unit_leaves_time_to_brake_and_permits_the_priorities_of_an_arm() -> None:
    parsed = configparser.ConfigParser(interpolation=None)
    parsed.read_string(unit())
    service = parsed["Service"]
    assert service["ExecStart"].split()[0].startswith("/")
    assert service["KillMode"] == "mixed"
    assert float(service["TimeoutStopSec"]) > STOP_BUDGET_S
    assert int(service["LimitRTPRIO"]) >= max(INNER_PRIORITY, LINK_PRIORITY, LOOP_PRIORITY)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
    path = tmp_path / "vla-zenoh-robot.service"
    here = re.sub(r"ExecStart=\S+", f"ExecStart={sys.executable}", unit())
    path.write_text(here.replace("User=lab", "User=root"))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert path.name not in done.stderr, done.stderr
    assert done.returncode == 0, done.stderr
