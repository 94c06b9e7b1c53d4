"""A model of one's own, by its path: in a profile under `up`, and under `bench task`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from chain import MOVING_M_S, command_line, running_chain

from vla_zenoh.policy.loader import find_model, make_policy

pytestmark = pytest.mark.slow

MODEL = '''\
"""Goes straight up or down, whatever the prompt; needs no picture."""
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, ObservationSpec


class Riser:
    def __init__(self, step_m="0.0"):
        self.step_m = float(step_m)
        self.spec = ModelSpec(
            name="riser",
            observation=ObservationSpec(cameras=(), state=("pose",), prompt=False),
            action=ActionSpec(horizon=1, dt_s=0.1, gripper="none"),
        )

    def infer(self, observation):
        return ActionSteps([[0.0, 0.0, self.step_m, 0.0, 0.0, 0.0]])
'''
TIMEOUT_S = 110.0
WORSE = 3


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "riser.py"
    path.write_text(MODEL)
    return path


def test_up_starts_two_workers_of_one_file_beside_the_profile(model: Path) -> None:
    more = """\
workers: [scripted, up, down]
models: {up: riser.py, down: ./riser.py}
options: {up: {step_m: "0.01"}, down: {step_m: "-0.01"}}
"""
    with running_chain(model.parent, more=more) as chain:
        hash_ = make_policy(find_model(str(model))).spec.hash
        for worker in ("up", "down"):
            chain.until(
                f"{worker} infers", lambda w=worker: chain.state(f"worker-{w}") == "inferring"
            )
            assert chain.detail("spec", f"worker-{worker}") == hash_
        chain.client.publish(chain.client.keys.worker, "up")
        chain.activate_when_ready()
        chain.until("the arm moves", chain.moves)
        assert chain.recorder.track().twist[-1][2] > MOVING_M_S / 2
        chain.client.publish(chain.client.keys.worker, "down")
        chain.until("it goes down", lambda: chain.recorder.track().twist[-1][2] < -MOVING_M_S / 2)


def test_bench_task_runs_a_path_and_bench_compare_reads_what_it_wrote(
    model: Path, tmp_path: Path
) -> None:
    still, moved = tmp_path / "still", tmp_path / "moved"
    words = ["bench", "task", "--model", str(model), "--family", "stay", "--episodes", "6"]
    words += ["--limit", "4", "--lockstep", "--processes", "2"]
    for step_m, folder in (("0.0", still), ("0.02", moved)):
        done = command_line(
            *words, "--set", f"step_m={step_m}", "--output", str(folder), timeout_s=TIMEOUT_S
        )
        assert done.returncode == 0, done.stderr
    found = command_line("compare", str(still), str(moved), "--json")
    assert found.returncode == WORSE, found.stderr
    said = json.loads(found.stdout)
    assert (said["pairs"], said["only_a"], said["b_is_worse"]) == (6, 6, True)
    assert (said["a"]["model"], said["b"]["options"]) == ("riser", {"step_m": "0.02"})


def test_a_model_that_cannot_be_made_is_told_by_its_own_last_lines(model: Path) -> None:
    words = ["bench", "task", "--model", str(model), "--episodes", "1", "--set", "colour=red"]
    done = command_line(*words, timeout_s=TIMEOUT_S)
    assert done.returncode == 1
    assert "Its options: step_m" in done.stderr
    assert "error: worker-riser keeps crashing: " in done.stderr
