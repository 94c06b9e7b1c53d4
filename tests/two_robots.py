"""Two robots of real processes on one bus, without cameras; the router is that of ``one``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from camera_rig import free_endpoint
from chain import LONG_PATIENCE_S, Chain, running_chain

COMMAND_HZ = 100
ROBOT = """\
extends: panda_sim
robot: {{name: {name}}}
cameras: {{front: null, wrist: null}}
workers: [scripted]
options: {{scripted: {{camera: ""}}}}
task: {{prompt: hold, rate_hz: 10, worker: scripted}}
session: {{listen: [{endpoint}], connect: [{endpoint}], lease_ms: 4000}}
timing:
  command_timeout_s: {command_s}
  state_timeout_s: {state_s}
  command_hz: {hz}
  state_hz: {hz}
hosts: {{here: {{nodes: [{nodes}]}}}}
"""
BOUNCER = '''
# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""Goes up for a second and down for one, whatever the prompt; one answer takes `slow_s`.

Outside the heights {low_m} to {high_m} it goes back: what is dropped of chunks would add up.
"""
import time
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, ObservationSpec

class Bouncer:
    spec = ModelSpec(
        name="bouncer",
        observation=ObservationSpec(cameras=(), state=("pose",), prompt=False),
        action=ActionSpec(horizon={horizon}, dt_s=0.1, gripper="none"),
    )

    def infer(self, observation):
        time.sleep({slow_s})
        height_m = observation.pose.position_m[2]
        up = observation.stamp_wall_ns // 10**9 % 2 and height_m < {high_m} or height_m < {low_m}
        way_m = 0.01 if up else -0.01
        return ActionSteps([[0.0, 0.0, way_m, 0.0, 0.0, 0.0]] * {horizon})
'''
BOUNCE = "bounce"
"""A prompt for it."""


def write_bouncer(
    path: Path,
    *,
    horizon: int = 1,
    slow_s: float = 0.0,
    between_m: tuple[float, float] = (0.0, 1.0),
) -> None:
    """A model that moves every arm by 10 mm a step, and turns at heights outside `between_m`."""
    low_m, high_m = between_m
    model = BOUNCER.format(horizon=horizon, slow_s=slow_s, low_m=low_m, high_m=high_m)
    path.write_text(model)


@contextmanager
def two_robots(folder: Path) -> Iterator[tuple[Chain, Chain]]:
    """Both, at rest; their profiles are ``one.yaml`` and ``two.yaml`` in `folder`."""
    endpoint = free_endpoint()
    files: list[Path] = []
    for name, nodes in (("one", "router, sim, command, worker"), ("two", "sim, command, worker")):
        files.append(folder / f"{name}.yaml")
        files[-1].write_text(
            ROBOT.format(
                name=name,
                endpoint=endpoint,
                command_s=LONG_PATIENCE_S["command"],
                state_s=LONG_PATIENCE_S["state"],
                hz=COMMAND_HZ,
                nodes=nodes,
            )
        )
    with (
        running_chain(folder, profile_file=files[0]) as one,
        running_chain(folder, profile_file=files[1]) as two,
    ):
        yield one, two
