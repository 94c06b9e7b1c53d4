"""An episode through our command node: limits, composition and smoothing before the environment.

`Lockstep` runs command node and guard on a virtual clock; the environment takes the place of the
simulated robot and makes a step of its own whenever its control period is over.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import NodeError
from vla_zenoh.kinematics.so3 import held_pose
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.profile import load_profile, override
from vla_zenoh.types import FloatArray, GripperState, JointState, PoseState
from vla_zenoh.types.records import JointReference, PoseReference
from vla_zenoh_benchmarks.episode import EpisodeClock, EpisodeConditions
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays

WARM_UP_S, ACTIVATE_PATIENCE_S, POLL_S = 0.3, 3.0, 0.02
JOINTS = 7


def run_through_command_node(clock: EpisodeClock, conditions: EpisodeConditions) -> None:
    """Run an episode until it is over or the command node gives up.

    Raises:
        NodeError: the benchmark cannot be commanded, or activation is rejected.
    """
    benchmark = clock.benchmark
    if getattr(benchmark, "set_point", None) is None:
        raise NodeError(
            "this benchmark has no set_point(position_m, width_m), which mode command needs"
        )
    profile = override(
        load_profile("panda_sim"),
        {
            "limits": dict(getattr(benchmark, "limits", {})),
            "composition": {"mode": conditions.composition},
            "robot": {"gripper": {"max_width_m": getattr(benchmark, "max_width_m", 0.08)}},
        },
    )
    world = _EnvironmentWorld(clock)
    policy = _AskedPolicy(clock, world)
    delays = Delays((conditions.delay_ms or 0.0) / 1e3)
    loop = Lockstep(profile, world, policy, delays=delays)
    world.loop, policy.delay_ns = loop, round(delays.inference_s * 1e9)
    taken = conditions.replan or clock.spec.action.horizon
    loop.put("rate", min(100.0, 1.0 / (taken * clock.spec.action.dt_s)))
    loop.put("prompt", clock.request.task.prompt or "go")
    loop.run(WARM_UP_S)
    if why := loop.activate(ACTIVATE_PATIENCE_S, POLL_S):
        raise NodeError(f"the arm was not activated: {why}")
    while not clock.over:
        loop.run(POLL_S)
        if not loop.commander.task.active:
            clock.outcome.failure = f"stopped: {loop.commander.why}"[:200]
            return


class _AskedPolicy:
    """The worker, asked for what the environment shows now; it sees nothing while inactive."""

    def __init__(self, clock: EpisodeClock, world: _EnvironmentWorld) -> None:
        self._clock, self._world = clock, world
        self.delay_ns = 0
        self.spec = ModelSpec(
            name=clock.spec.name,
            observation=ObservationSpec(state=("pose",), prompt=False),
            action=clock.spec.action,
        )

    def infer(self, observation: Observation) -> ActionSteps:
        if not observation.task.active or self._clock.over:
            return ActionSteps(np.zeros((1, self.spec.action.dimension)))
        steps = self._clock.ask()
        self._world.begin(self.delay_ns)
        return ActionSteps(steps)


class _EnvironmentWorld:
    """A benchmark's environment as the robot of `Lockstep`; it steps from the first chunk on."""

    def __init__(self, clock: EpisodeClock) -> None:
        self.loop: Any = None
        self._clock = clock
        self._set_point: Any = getattr(clock.benchmark, "set_point")  # noqa: B009
        self._next_ns: int | None = None
        self._step_ns = round(clock.benchmark.action.dt_s * 1e9)
        self._see()
        self._width_m = self._gripper.opening_m
        zeros = np.zeros(JOINTS)
        self._joints = JointState(
            tuple(f"joint{i}" for i in range(1, JOINTS + 1)), zeros, zeros, None
        )

    @property
    def joint_range_rad(self) -> tuple[FloatArray, FloatArray]:
        return np.full(JOINTS, -3.0), np.full(JOINTS, 3.0)

    @property
    def slides(self) -> NDArray[np.bool_]:
        return np.zeros(JOINTS, bool)

    def begin(self, delay_ns: int) -> None:
        if self._next_ns is None:
            self._next_ns = self.loop.now_ns + delay_ns + self._step_ns

    def tick(self, reference: PoseReference | JointReference) -> None:
        if self._next_ns is None or self.loop.now_ns < self._next_ns or self._clock.over:
            return
        assert isinstance(reference, PoseReference)
        self._next_ns += self._step_ns
        self._clock.step(self._set_point(reference.position_m, self._width_m))
        self._see()

    def _see(self) -> None:
        seen = self._clock.benchmark.observe([])
        if seen.pose is None or seen.gripper is None:
            raise NodeError("mode command needs the benchmark's pose and gripper")
        self._pose, self._gripper = seen.pose, seen.gripper

    def tcp(self) -> tuple[FloatArray, FloatArray]:
        """Where the environment's own controller holds the hand: the guard begins there."""
        held = held_pose(self._pose)
        return held.position_m, held.rotation

    def pose_state(self, reference: PoseReference | JointReference) -> PoseState:
        assert isinstance(reference, PoseReference)
        return self._pose

    def joint_state(self) -> JointState:
        return self._joints

    def gripper_state(self) -> GripperState:
        return self._gripper

    def set_gripper(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        self._width_m = width_m
