"""The model with weights of docs/how-to/models.md runs where torch is installed."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch", reason="needs OpenVLA's environment: make test-models")
import torch

from vla_zenoh.errors import SpecError, WorkerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy.loader import find_model, make_policy

pytestmark = pytest.mark.models

TEXT = (Path(__file__).parents[3] / "docs" / "how-to" / "models.md").read_text("utf-8")
STEP_M, ATOL_M = 0.004, 1e-6


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "reach.py"
    (text,) = [t for t in re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL) if "nn.Module" in t]
    path.write_text(text, "utf-8")
    return path


@pytest.fixture
def checkpoint(model: Path, tmp_path: Path) -> Path:
    """Weights that go up and open the gripper by half, whatever is seen."""
    folder = tmp_path / "weights"
    folder.mkdir()
    names: dict[str, Any] = {"__name__": "reach"}
    exec(compile(model.read_text(), str(model), "exec"), names)
    network = names["Network"]()
    torch.nn.init.zeros_(network.head.weight)
    with torch.no_grad():
        network.head.bias.zero_()
        network.head.bias[2::7], network.head.bias[6::7] = STEP_M, 0.5
    torch.save(network.state_dict(), folder / "weights.pt")
    return folder


def test_it_answers_with_what_its_weights_say(model: Path, checkpoint: Path) -> None:
    policy: Any = make_policy(find_model(str(model)), {"checkpoint": str(checkpoint)})
    policy.load()
    steps = policy.infer(example_observation(policy.spec)).steps
    assert steps.shape == (8, 7)
    assert steps[:, 2] == pytest.approx([STEP_M] * 8, abs=ATOL_M)
    assert policy.device == ("cuda" if torch.cuda.is_available() else "cpu")


def test_it_keeps_its_contract(model: Path, checkpoint: Path) -> None:
    words = ["check", str(model), "--set", f"checkpoint={checkpoint}", "--set", "device=cpu"]
    done = subprocess.run(
        [sys.executable, "-m", "vla_zenoh", *words, "--profile", "panda_sim", "--json"],
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout)["deterministic"] is True


def test_weights_that_are_not_there_and_devices_that_are_none_are_refused(
    model: Path, checkpoint: Path
) -> None:
    with pytest.raises(WorkerError, match="it needs weights"):
        make_policy(find_model(str(model)))
    with pytest.raises((SpecError, WorkerError), match="device is 'tpu'"):
        make_policy(find_model(str(model)), {"checkpoint": str(checkpoint), "device": "tpu"})
