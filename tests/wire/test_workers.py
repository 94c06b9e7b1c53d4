"""More than one worker beside a robot: shadows, the lease, and a user's own file."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from chain import MOVING_M_S, READY_PATIENCE_S, Chain, command_line
from typed import typed
from vla_zenoh_diagnose.inference_views import InferenceDebugSubscriber, InferenceView

from vla_zenoh.bus.host import own_boot_id
from vla_zenoh.codec.image import decode_jpeg
from vla_zenoh.errors import NodeError
from vla_zenoh.profile import override
from vla_zenoh.runtime.launch import Host

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


LOOKER = '''
# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""Stands still and tells the mean colour of what it sees."""
import numpy as np
from vla_zenoh.policy import (
    ActionSpec, ActionSteps, CameraSpec, ModelSpec, ObservationSpec
)

class Looker:
    spec = ModelSpec(
        name="looker",
        observation=ObservationSpec(
            cameras=(
                CameraSpec(camera="front", width=64, height=64, resize="crop", colour="bgr"),
            ),
            state=("pose",),
        ),
        action=ActionSpec(horizon=2, dt_s=0.1, gripper="none"),
    )

    def infer(self, observation):
        picture = observation.images["front"]
        raw = {"mean_bgr": picture.mean(axis=(0, 1)), "tokens": [31999, 7], "score": np.nan}
        return ActionSteps(np.zeros((2, 6)), raw=raw)
'''
COLOUR_TOLERANCE = 2.0
"""Of 255: what JPEG changes in the mean of a picture."""


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
        try:
            process.communicate(timeout=10)
        finally:
            process.kill()


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
        chain.client.pop_events()
        process.kill()
        chain.until("inactive", lambda: chain.state() == "inactive")
        assert chain.detail("why") == "node 'worker-riser' is gone"


def test_a_worker_of_a_name_that_is_taken_refuses_to_start(chain: Chain) -> None:
    with worker(chain, "scripted") as process:
        out, _ = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "node 'worker-scripted' of robot 'panda' is already running" in out


def test_a_second_up_of_a_host_is_refused_and_leaves_the_arm_to_the_running_one(
    chain: Chain,
) -> None:
    chain.activate_when_ready()
    twin = override(chain.profile, {"hosts": {chain.host.host: {"nodes": ["worker"]}}})
    with (
        pytest.raises(NodeError, match=r"is already running: pid \d+, since"),
        Host(twin, None, log=lambda *_: None, tell=lambda *_: None),
    ):
        pass
    count = chain.detail("accepted_chunks")
    chain.until("it goes on", lambda: chain.detail("accepted_chunks") > count + 2)
    assert chain.state() == "active"
    assert not chain.events("active->inactive")
    heard = chain.client.snapshot().values()
    places = {(said.host, said.boot) for said, _, alive in heard if alive}
    assert places == {(chain.host.host, own_boot_id())}


def test_a_worker_that_is_not_there_is_refused_in_motion_and_the_arm_goes_on(
    chain: Chain,
) -> None:
    chain.move()
    chain.client.pop_events()
    chain.client.publish(chain.client.keys.worker, "ghost")
    chain.until("a refusal", lambda: chain.events("worker_refused"))
    (event,) = chain.events("worker_refused")
    assert "worker 'ghost' is not alive; alive are: scripted" in event.why
    assert chain.detail("worker") == "scripted"
    assert chain.state() == "active"


def test_what_a_model_sees_is_shown_with_its_prompt_raw_output_and_steps(
    chain: Chain, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "looker.py"
    model.write_text(LOOKER)
    chain.client.set_prompt("hold")
    with worker(chain, str(model)):
        chain.until(
            "the looker infers",
            lambda: chain.state("worker-looker") == "inferring",
            READY_PATIENCE_S,
        )
        listener = InferenceDebugSubscriber(chain.session, chain.profile.keys, "looker")
        sights: list[InferenceView] = []

        def shown() -> bool:
            sights.extend(listener.poll())
            return len([sight for sight in sights if sight.jpegs]) >= 3

        chain.until("it is shown", shown)
        listener.close()
        for sight in [sight for sight in sights if sight.jpegs]:
            rgb = decode_jpeg(sight.jpegs["front"]).rgb
            assert rgb.shape == (64, 64, 3)
            mean = sight.record.raw["mean_bgr"][::-1]
            assert rgb.mean(axis=(0, 1)) == pytest.approx(mean, abs=COLOUR_TOLERANCE)
            assert sight.record.raw["tokens"] == [31999, 7]
            assert sight.record.raw["score"] == "nan"
            assert sight.record.prompt == "hold"
            assert sight.record.steps.shape == (2, 6)

        out = tmp_path / "out"
        words = ("inspect", "--count", "2", "--json", "--output", str(out))
        said = typed(capsys, *words, "--profile", str(chain.profile_file))
        assert said.code == 0, said.stderr
        lines = [json.loads(line) for line in said.stdout.splitlines()]
        assert {line["worker"] for line in lines} <= {"looker", "scripted"}
        assert len(list(out.glob("*/*.json"))) == 2


@pytest.mark.slow
def test_two_workers_are_compared_while_one_of_them_moves_the_arm(
    chain: Chain, tmp_path: Path
) -> None:
    model = tmp_path / "riser.py"
    model.write_text(OWN_MODEL)
    with worker(chain, str(model)):
        infers = "the riser infers"
        chain.until(infers, lambda: chain.state("worker-riser") == "inferring", READY_PATIENCE_S)
        chain.move()
        file = str(tmp_path / "both.mcap")
        said = command_line("record", "--seconds", "2", "-o", file, profile=chain.profile_file)
        assert said.returncode == 0, said.stderr
        words = ("compare", "scripted", "riser", file, "--tolerance", "0.2", "--json")
        said = command_line(*words)
        assert said.returncode == 0, said.stderr
        found = json.loads(said.stdout)
        assert found["pairs"] >= 5
        assert abs(found["cosine"]) == pytest.approx(1.0)
        assert found["mean"][0] == pytest.approx(0.0, abs=1e-6)
        assert found["gripper"] is None
        chain.client.set_prompt("hold")  # before the arm is at the end of its reach
        # The shadow's deltas are on their key like those of the one that is obeyed.
        said = command_line(
            "echo", "delta/*", "--seconds", "2", "--json", profile=chain.profile_file
        )
        keys = {json.loads(line)["key"].rsplit("/", 1)[-1] for line in said.stdout.splitlines()}
        assert keys == {"scripted", "riser"}
        shown = command_line("status", "--once", profile=chain.profile_file).stdout
        assert "in control" in shown
        assert "shadow mode" in shown


@pytest.mark.slow
def test_who_shows_nothing_is_named(chain: Chain) -> None:
    said = command_line("inspect", "ghost", "--json", profile=chain.profile_file)
    assert said.returncode == 1
    assert "no inference of ghost of robot panda" in said.stderr
    assert "does it run?" in said.stderr
