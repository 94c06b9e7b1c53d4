"""docs/models.md tells what works: its model is taken out of the text and run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from vla_zenoh.interop.options import DEFAULTS
from vla_zenoh.interop.presets import GROOT, OPENPI, OPENVLA_REST, ORIGAMI
from vla_zenoh.loader import find_model, make_policy
from vla_zenoh.lockstep import Lockstep
from vla_zenoh.nodes.sim import build_world
from vla_zenoh.profile import load_profile

TEXT = (Path(__file__).parents[2] / "docs" / "models.md").read_text("utf-8")
LINES = 10
STEP_M, SECONDS, RATE_HZ = 0.01, 1.0, 10.0
WAY_M = STEP_M * RATE_HZ * SECONDS
LAG_M, STILL_M = 0.04, 1e-3


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """The first block of Python, as the file that the text says."""
    (code, *_) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    path = tmp_path / "lift.py"
    path.write_text(code, "utf-8")
    return path


def test_the_model_is_ten_lines(model: Path) -> None:
    lines = [line for line in model.read_text().splitlines() if line and line[0] != "#"]
    assert len(lines) <= LINES


def height_m(loop: Lockstep) -> float:
    return float(loop.trace.position_m[-1][2])


def test_the_model_lifts_the_arm(model: Path) -> None:
    policy, profile = make_policy(find_model(str(model))), load_profile("panda_sim")
    loop = Lockstep(profile, build_world(profile), policy)
    loop.put("rate", RATE_HZ)
    loop.put("prompt", "wait")
    loop.run(1.1)
    loop.put("active", True)
    loop.run(0.3)
    still_m = height_m(loop)
    assert still_m == pytest.approx(float(loop.trace.position_m[0][2]), abs=STILL_M)
    loop.put("prompt", "lift")
    loop.run(SECONDS)
    assert height_m(loop) - still_m == pytest.approx(WAY_M, abs=LAG_M)


def test_the_model_passes_the_check(model: Path) -> None:
    command = re.search(r"^    vla-zenoh (check lift\.py.*)$", TEXT, re.MULTILINE)
    assert command is not None
    done = subprocess.run(
        [sys.executable, "-m", "vla_zenoh", *command[1].split()],
        cwd=model.parent,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_preset_and_option_is_told() -> None:
    for presets in (OPENPI, GROOT, OPENVLA_REST, ORIGAMI):
        for preset in presets:
            assert f"`{preset}`" in TEXT, preset
    for option in DEFAULTS:
        assert f"`{option}`" in TEXT, option
