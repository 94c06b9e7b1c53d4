"""More than one worker beside a robot: shadows, the lease, and a user's own file."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from chain import MOVING_M_S, READY_PATIENCE_S, Chain

COMMAND_TOLERANCE, ARM_TOLERANCE = 1.1, 2.7
"""As in tests/fault/test_dead_nodes.py."""

OWN_MODEL = '''
# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""Goes up at half a step a request, whatever the prompt; needs no picture."""
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, ObservationSpec

class Riser:
    spec = ModelSpec(
        name="riser",
        observation=ObservationSpec(cameras=(), state=("pose",), prompt=False),
        action=ActionSpec(horizon=1, dt_s=0.1, gripper="none"),
    )

    def infer(self, observation):
        return ActionSteps([[0.0, 0.0, 0.01, 0.0, 0.0, 0.0]])
'''


@contextmanager
def worker(chain: Chain, model: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    words = ["worker", model, "--profile", str(chain.profile_file), *arguments]
    process = subprocess.Popen(
        [sys.executable, "-m", "vla_zenoh", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=10)


def test_a_shadow_is_not_obeyed_and_takes_over_in_motion(chain: Chain, tmp_path: Path) -> None:
    model = tmp_path / "riser.py"
    model.write_text(OWN_MODEL)
    with worker(chain, str(model)) as process:
        chain.until(
            "the riser infers", lambda: chain.state("worker-riser") == "inferring", READY_PATIENCE_S
        )
        chain.activate_when_ready()
        began_ns = time.time_ns()
        time.sleep(1.0)
        assert chain.detail("obeyed", "worker-riser") is False
        assert chain.recorder.track(began_ns).speed_m_s.max() < MOVING_M_S

        chain.client.set_prompt("HARD: go up")
        chain.until("it moves", chain.moves)
        chain.client.set_worker("riser")
        swapped_ns = time.time_ns()
        chain.until("the riser is obeyed", lambda: chain.detail("obeyed", "worker-riser"))
        chain.until("a new chunk", lambda: chain.detail("accepted_chunks") >= 3)
        chain.until("it moves on", chain.moves)
        assert chain.detail("prompt") == "HARD: go up"
        track = chain.recorder.track()
        across = track.between(swapped_ns - 300_000_000, swapped_ns + 300_000_000)
        limit = chain.profile.limits.translation.acceleration_m_s2
        assert chain.recorder.hardest_command() <= limit * COMMAND_TOLERANCE
        assert across.hardest_change() <= limit * ARM_TOLERANCE
        chain.until("active", lambda: chain.state() == "active")
        assert not chain.events("active->inactive")

        # Who is obeyed and dies brakes the arm, though another worker is there.
        chain.client.take_events()
        process.kill()
        chain.until("inactive", lambda: chain.state() == "inactive")
        assert chain.detail("why") == "node 'worker-riser' is gone"


def test_a_worker_of_a_name_that_is_taken_refuses_to_start(chain: Chain) -> None:
    with worker(chain, "scripted") as process:
        out, _ = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "a node 'worker-scripted' of robot 'panda' is alive already" in out


def test_a_worker_that_is_not_there_is_refused_in_motion_and_the_arm_goes_on(
    chain: Chain,
) -> None:
    chain.move()
    chain.client.take_events()
    chain.client.put(chain.client.keys.worker, "ghost")
    chain.until("a refusal", lambda: chain.events("worker_refused"))
    (event,) = chain.events("worker_refused")
    assert "worker 'ghost' is not alive; alive are: scripted" in event.why
    assert chain.detail("worker") == "scripted"
    assert chain.state() == "active"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("import no_such_module_at_all\n", "No module named 'no_such_module_at_all'"),
        ("class Model:\n    spec = 1\n    def infer(self, o): ...\n", "needs a property `spec`"),
    ],
)
def test_a_file_that_is_no_model_is_refused_with_its_reason(
    chain: Chain, tmp_path: Path, text: str, why: str
) -> None:
    model = tmp_path / "bad.py"
    model.write_text(text)
    with worker(chain, str(model)) as process:
        out, _ = process.communicate(timeout=30)
    assert process.returncode == 1
    assert why in out
    assert "Traceback" not in out
