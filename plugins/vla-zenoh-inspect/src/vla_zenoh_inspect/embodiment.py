"""The embodiment ``vla_zenoh``: an arm on the bus, driven through its command node."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np
from inspect_robots.embodiment import RESETTABLE, SELF_PACED, EmbodimentBase, EmbodimentInfo
from inspect_robots.errors import ConfigError, EmbodimentFault
from inspect_robots.scene import Scene
from inspect_robots.spaces import (
    ActionSemantics,
    Box,
    CameraSpec,
    ObservationSpace,
    StateField,
    StateSpec,
)
from inspect_robots.types import Action, Observation, StepResult
from numpy.typing import NDArray
from vla_zenoh_policy_servers.loop_worker import LoopWorker

import vla_zenoh
from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.keys import worker_node
from vla_zenoh.policy.meaning import joints_as
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh_inspect.targets import Targets

REFUSED = "refused"
FIRST_CHUNK_S = 20.0
"""A command node that is just starting has sent its task within this."""
SETTLE_S, SETTLE_STEPS = 5.0, 20
NOTES = """\
Joint targets in rad ({joints}), absolute; a gripper 0 (shut) to 1 (open). A target that the arm's
limits do not allow (joint ranges, workspace box, table, keep-outs, itself) is refused before
anything moves: the arm stays where it is, and the reason names limit and place."""

Numbers = NDArray[np.float64]


class Arm(EmbodimentBase):
    """An arm on the bus: absolute joints and its gripper, under all limits of its profile.

    It takes the arm at the first `reset` and activates it for as long as this process lives;
    `close` brakes it. A target that its limits do not allow is refused: the arm stays, the trial
    goes on, and the reason is in ``info`` and ``extra`` of the step, and what `pre_check` returns.
    An arm that was stopped or has a fault is an `EmbodimentFault`: a person has to look.

    Args:
        profile: name or path.
        cameras: names, with commas between them; None: all of the profile.
        rate_hz: of the actions.
        home: `reset` drives to ``robot.home_rad``.
        endpoint: router, such as ``tcp/10.0.0.2:7447``, instead of the profile's.
        worker: name under which the actions are sent.
    """

    def __init__(
        self,
        profile: str = "panda_sim",
        cameras: str | None = None,
        rate_hz: float = 10.0,
        home: bool = True,
        endpoint: str = "",
        worker: str = "inspect",
    ) -> None:
        try:
            loaded = load_profile(profile)
            if endpoint:
                loaded = override(loaded, {"session": {"connect": [endpoint]}})
            self._targets = Targets(loaded, rate_hz)
        except VlaZenohError as error:
            raise ConfigError(str(error)) from error
        names = list(loaded.cameras) if cameras is None else _words(cameras)
        if unknown := [name for name in names if name not in loaded.cameras]:
            known = ", ".join(loaded.cameras) or "none"
            raise ConfigError(f"cameras: profile {profile!r} has no {unknown[0]!r}, it has {known}")
        self._profile, self._cameras, self._worker_name = loaded, names, worker
        self._period_s, self._home = 1.0 / rate_hz, home
        self._opened = ExitStack()
        self._robot: vla_zenoh.RemoteRobot | None = None
        self._worker: LoopWorker | None = None
        self._goal: Numbers | None = None
        self._instruction: str | None = None
        self._next_s = 0.0
        self.info = _info(loaded, self._targets, names, rate_hz)

    # -- what Inspect Robots calls ------------------------------------------------------------
    def reset(self, scene: Scene, *, seed: int | None = None) -> Observation:
        """Take the arm, drive it home if it is to, and see."""
        del seed
        try:
            if self._worker is None:
                self._take()
            robot = self._driven()
            self._instruction = scene.instruction
            robot.set_prompt(scene.instruction)
            self._goal = self._measured()
            if self._home:
                self._drive_home()
            return self._see()
        except VlaZenohError as error:
            raise EmbodimentFault(str(error)) from error

    def step(self, action: Action) -> StepResult:
        """Send a target, and see one period later. One that is refused moves nothing."""
        try:
            self._driven()
            assert self._goal is not None
            target = np.asarray(action.data, float).reshape(-1)
            why = self._targets.refusal(self._goal, target)
            if not why:
                self._send(target)
            self._pace()
            seen = self._see(why)
        except VlaZenohError as error:
            raise EmbodimentFault(str(error)) from error
        return StepResult(seen, info={REFUSED: why} if why else {})

    def close(self) -> None:
        """Brake the arm and leave the bus."""
        robot, self._robot, self._worker = self._robot, None, None
        try:
            if robot is not None:
                robot.deactivate()
        finally:
            self._opened.close()

    # -- for agents ---------------------------------------------------------------------------
    def pre_check(self, waypoints: Numbers) -> str | None:
        """Why the arm cannot go along waypoints (k, n) from where it is; None if it can.

        For ``LLMAgentPolicy(pre_check=arm.pre_check)``: the model is told, and corrects itself.
        """
        here = self._goal if self._goal is not None else np.asarray(waypoints[0], float)
        return self._targets.refusal_of_path(here, waypoints) or None

    # -- the bus ------------------------------------------------------------------------------
    def _take(self) -> None:
        with ExitStack() as opened:
            robot = opened.enter_context(vla_zenoh.connect(self._profile))
            identity = worker_node(self._worker_name)
            session = opened.enter_context(open_session(self._profile.session, identity=identity))
            worker = LoopWorker(
                *(self._profile, session, self._worker_name, self._targets.action), model="inspect"
            )
            opened.callback(worker.close)
            robot.wait_for(lambda: worker.ready, FIRST_CHUNK_S)
            robot.set_worker(self._worker_name)
            robot.activate_with_deadman("inspect-robots")
            self._robot, self._worker = robot, worker
            self._opened = opened.pop_all()

    def _driven(self) -> vla_zenoh.RemoteRobot:
        """The robot while it follows us.

        Raises:
            EmbodimentFault: it does not; says why.
        """
        robot = self._robot
        if robot is None:
            raise EmbodimentFault("the arm is not taken: reset comes before step")
        task = robot.task
        if task is None or not task.active:
            raise EmbodimentFault(f"the arm is not active: {robot.why_inactive()}")
        if task.worker != self._worker_name:
            raise EmbodimentFault(f"the arm follows worker {task.worker!r} now")
        return robot

    def _send(self, target: Numbers) -> None:
        assert self._worker is not None
        if not self._worker.send(target):
            raise EmbodimentFault(f"no new state of the robot came. {self._worker.complaint}")
        self._goal = target

    def _pace(self) -> None:
        now_s = time.monotonic()
        self._next_s = max(self._next_s + self._period_s, now_s - self._period_s)
        time.sleep(max(0.0, self._next_s - now_s))

    def _drive_home(self) -> None:
        assert self._goal is not None
        home_rad = self._profile.robot.home_rad
        home = np.array([*home_rad, *self._goal[len(home_rad) :]])
        if why := self._targets.refusal(self._goal, home):
            raise EmbodimentFault(f"the arm cannot go straight home: {why}")
        for target in self._targets.way(self._goal, home):
            self._driven()
            self._send(target)
            self._pace()
        give_up_s = time.monotonic() + SETTLE_S
        while not self._targets.settled(self._measured(), home):
            if time.monotonic() > give_up_s:
                raise EmbodimentFault("the arm does not arrive at home: `vla-zenoh status` has why")
            self._driven()
            self._pace()

    def _measured(self) -> Numbers:
        assert self._robot is not None
        joint = joints_as(self._robot.joint_state().record, "wrapped")
        at = dict(zip(joint.names, joint.position_rad, strict=True))
        robot = self._profile.robot
        joints = [float(at[name]) for name in robot.arm_joints]
        if robot.gripper is None:
            return np.array(joints)
        opening = self._robot.gripper_state().record.kept_width_m / robot.max_width_m
        return np.array([*joints, min(float(opening), 1.0)])

    def _see(self, refused: str = "") -> Observation:
        robot = self._robot
        assert robot is not None
        pose = robot.pose_state().record
        images = {name: robot.image(name, jpeg=True) for name in self._cameras}
        return Observation(
            images={name: np.array(each.record.rgb) for name, each in images.items()},
            state={
                "joint_pos": self._measured(),
                "eef_pose": np.array([*pose.position_m, *pose.quat_xyzw]),
            },
            instruction=self._instruction,
            image_times={name: each.header.stamp_wall_ns * 1e-9 for name, each in images.items()},
            state_time=time.time(),
            extra={REFUSED: refused} if refused else {},
        )


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _info(
    profile: Profile, targets: Targets, cameras: Sequence[str], rate_hz: float
) -> EmbodimentInfo:
    count = len(targets.labels)
    most: list[Any] = targets.most.tolist()
    known = profile.cameras
    return EmbodimentInfo(
        name="vla_zenoh",
        action_space=Box(
            shape=(count,),
            low=targets.low,
            high=targets.high,
            semantics=ActionSemantics(
                control_mode="joint_pos",
                gripper="continuous" if profile.robot.gripper is not None else "none",
                dim_labels=targets.labels,
                max_step=tuple(most),
            ),
        ),
        observation_space=ObservationSpace(
            cameras=tuple(CameraSpec(n, known[n].height, known[n].width) for n in cameras),
            state=StateSpec(
                (StateField("joint_pos", (count,), "rad"), StateField("eef_pose", (7,), "m+quat"))
            ),
        ),
        control_hz=rate_hz,
        is_simulated=profile.robot.driver == "sim",
        capabilities=frozenset((RESETTABLE, SELF_PACED)),
        docs=NOTES.format(joints=", ".join(profile.robot.arm_joints)),
        environment_id=f"{profile.root}/{profile.robot.name}",
    )
