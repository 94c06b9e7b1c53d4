"""Inspect Robots 0.60 itself: its doctor and its LLM agent, with our embodiment and no arm."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

VARIABLE = "INSPECT_PYTHON"
SCRIPT = Path(__file__).with_name("inspect_process.py")
DOCTOR = ("doctor", "--embodiment", "vla_zenoh", "-E", "profile=panda_sim")

pytestmark = pytest.mark.timeout(170)


def output(*words: str | Path) -> str:
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


def test_their_doctor_finds_nothing_to_complain_about() -> None:
    program = Path(os.environ[VARIABLE]).with_name("inspect-robots")
    assert "conformant (no issues)" in output(program, *DOCTOR)


def test_their_agent_is_told_which_limit_refused_its_move_and_corrects_it() -> None:
    found = json.loads(output(os.environ[VARIABLE], SCRIPT).splitlines()[-1])
    (why,) = found["heard"]
    assert why.startswith("pre-check rejected this motion: waypoint")
    assert "workspace" in why
    assert found["gone_rad"] == pytest.approx(0.1)
