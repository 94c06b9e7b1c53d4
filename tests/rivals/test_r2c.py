"""hw-cloudrobo-r2c 0.2.1 itself: its dummy robot before our gateway.

Its eclipse-zenoh is 1.9.0, ours 1.10: every test is on a bus of both.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import r2c_peer as peer
from peer_rig import free_port
from r2c_rig import DEVICE, Gateway, Robot, Router, write

from vla_zenoh.profile import load_profile

JOINTS = load_profile("so101_sim").robot.arm_joints
HOME = load_profile("so101_sim").robot.home_rad
STEP_RAD = 0.01
ROBOT = peer.DECLARED.replace("project: lab", "project: project-demo")
"""Its robot_dummy_config.yaml, in our words."""
SWEEP = """\
import numpy as np
from vla_zenoh.policy import ActionSpec, ActionSteps, CameraSpec, ModelSpec, ObservationSpec


class Sweep:
    spec = ModelSpec(
        name="sweep",
        observation=ObservationSpec(
            cameras=(CameraSpec(camera="front", width=64, height=64, resize="pad"),),
            state=("joint", "gripper"),
        ),
        action=ActionSpec(
            horizon=10, dt_s=0.1, space="joint", joints={joints}, gripper="none"
        ),
    )

    def __init__(self):
        self.answers = 0

    def infer(self, observation):
        self.answers += 1
        steps = np.zeros((10, 5))
        if self.answers <= {chunks}:
            steps[:, 0] = {step_rad}
        return ActionSteps(steps)
"""
"""Turns the shoulder by 0.1 rad a second, for so many chunks."""
CHUNK_RAD = 10 * STEP_RAD
CHUNK_S = 1.0
EXACT_RAD = 1e-6
DROPPED_RAD = 1e-4
"""Its robot prints four digits or more."""

pytestmark = pytest.mark.timeout(170)


class Bench:
    """A router, a gateway and its robot."""

    def __init__(self, folder: Path, chunks: int) -> None:
        self.folder, self.port = folder, free_port()
        self._model = write(
            folder / "sweep.py", SWEEP, joints=repr(JOINTS), chunks=chunks, step_rad=STEP_RAD
        )
        self._declared = write(folder / "robot.yaml", ROBOT)
        self.router = self.new_router()
        self.gateway = self.new_gateway()
        self.robot = self.new_robot()

    def new_router(self) -> Router:
        return Router(self.folder / f"router-{time.monotonic_ns()}.log", self.port)

    def new_gateway(self) -> Gateway:
        log = self.folder / f"gateway-{time.monotonic_ns()}.log"
        return Gateway(log, self.port, self._model, self._declared)

    def new_robot(self) -> Robot:
        return Robot(self.folder / f"robot-{time.monotonic_ns()}.log", self.port)

    def close(self) -> None:
        for process in (self.robot, self.gateway, self.router):
            process.__exit__()


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path, getattr(request, "param", 1000))
    yield bench
    bench.close()


@pytest.mark.parametrize("bench", [3], indirect=True)
def test_its_robot_ends_where_our_model_said(bench: Bench) -> None:
    bench.robot.moves_on()
    end_s = time.monotonic() + 60
    while len(bench.robot.targets_rad) < 125:
        assert time.monotonic() < end_s, bench.gateway.text
        time.sleep(0.1)
    bench.robot.interrupt()
    bench.gateway.interrupt()
    targets_rad = np.array(bench.robot.targets_rad)
    wanted_rad = np.minimum(STEP_RAD / 3 * np.arange(1, len(targets_rad) + 1), 3 * CHUNK_RAD)
    np.testing.assert_allclose(targets_rad, wanted_rad, atol=EXACT_RAD)
    final = np.array(bench.robot.final)
    print(f"at rest {abs(final[0] - 3 * CHUNK_RAD):.1e} rad off")
    np.testing.assert_allclose(final, [3 * CHUNK_RAD, 0.1, -0.2, 0.0, 0.0, 0.5], atol=EXACT_RAD)
    assert "answered" in bench.gateway.text


def test_our_gateway_killed_leaves_its_robot_standing_and_a_new_one_goes_on(bench: Bench) -> None:
    bench.robot.moves_on()
    bench.gateway.kill()
    stood_s = bench.robot.stands_after()
    assert stood_s < CHUNK_S + 0.5
    bench.gateway = bench.new_gateway()
    moved_s = bench.robot.moves_on()
    print(f"stood {stood_s:.2f} s after kill -9 of the gateway; moved {moved_s:.2f} s after a new")
    steps_rad = np.diff(bench.robot.targets_rad)
    assert np.abs(steps_rad).max() < STEP_RAD / 3 + DROPPED_RAD


def test_its_robot_killed_and_started_again_begins_an_episode(bench: Bench) -> None:
    bench.robot.moves_on()
    bench.robot.kill()
    bench.robot = bench.new_robot()
    bench.robot.moves_on()
    assert bench.gateway.text.count("the robot begins at observation") == 2
    assert bench.robot.targets_rad[0] == pytest.approx(STEP_RAD / 3, abs=EXACT_RAD)


def test_a_router_killed_and_started_again_joins_both(bench: Bench) -> None:
    bench.robot.moves_on()
    bench.router.kill()
    stood_s = bench.robot.stands_after()
    assert stood_s < CHUNK_S + 0.5
    bench.router = bench.new_router()
    moved_s = bench.robot.moves_on()
    print(f"stood {stood_s:.2f} s after kill -9 of the router; moved {moved_s:.2f} s after a new")


def test_beside_a_second_policy_ours_stays_out(bench: Bench) -> None:
    bench.robot.moves_on()
    other = peer.Policy(
        bench.port, lambda seen: peer.actions([seen["position"]], id=seen["id"]), DEVICE
    )
    began_s = time.monotonic()
    bench.gateway.until("second_policy (")
    print(f"a second policy was told after {time.monotonic() - began_s:.2f} s")
    bench.gateway.until("quiet (")
    other.session.close()
    bench.gateway.interrupt()
    assert "quiet" in bench.gateway.text
