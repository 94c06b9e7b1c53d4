"""What a profile may say. Frozen records; every field has its unit in its name.

Defaults are the safe choice, so a profile that says nothing about limits has limits.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from vla_zenoh import keys
from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import Keys
from vla_zenoh.profile import fit
from vla_zenoh.profile.joint_limits import JointLimits
from vla_zenoh.profile.ros2 import Ros2Profile
from vla_zenoh.profile.section import (
    Distinct,
    Name,
    Names,
    Range,
    Section,
    Text,
    Word,
    Words,
    refuse,
)
from vla_zenoh.profile.session import Endpoints, SessionProfile

NodeKind = Literal["router", "sim", "ros2", "camera", "command", "worker"]
NODE_KINDS: tuple[NodeKind, ...] = ("router", "sim", "ros2", "camera", "command", "worker")
SIMULATED: tuple[NodeKind, ...] = ("router", "sim", "camera", "command", "worker")
CAMERA_SOURCES = ("sim:CAMERA", "v4l2:DEVICE", "rtsp://...", "file:PATH", "ros2:TOPIC")
REACH_M = 3.0
"""No arm that fits a table reaches further: a workspace beyond it is in other units."""
REFUSE_FACTOR = 4.0
"""A step this many times over its limit is a mistake (a wrong unit), not a motion: refused."""
MIN_PERIODS = 3
"""A silence shorter than this many periods happens on a healthy link."""


def _source(value: str) -> str:
    kind, colon, rest = value.partition(":")
    if not colon or not rest or kind not in ("sim", "v4l2", "rtsp", "rtsps", "file", "ros2"):
        raise ValueError(f"{value!r} is not a camera: write one of {', '.join(CAMERA_SOURCES)}")
    if kind in ("rtsp", "rtsps") and not rest.removeprefix("//"):
        raise ValueError(f"{value!r} lacks the host: write rtsp://HOST/PATH")
    return value


def _root(value: str) -> str:
    try:
        for part in value.split("/"):
            keys.chunk(part, "root")
    except ProfileError as error:
        raise ValueError(str(error)) from error
    return value


def _within_reach(pair: tuple[float, float]) -> tuple[float, float]:
    if max(map(abs, pair)) > REACH_M:
        raise ValueError(f"[{pair[0]:g}, {pair[1]:g}] is further than {REACH_M:g} m; give metres")
    return pair


Reach = Annotated[Range, AfterValidator(_within_reach)]


class GripperProfile(Section):
    """The gripper. A command is sent when the width differs by more than the dead band."""

    max_width_m: float = Field(default=0.08, gt=0, le=1)
    speed_m_s: float = Field(default=0.1, gt=0, le=1)
    force_n: float = Field(default=25.0, ge=0, le=500)
    dead_band_m: float = Field(default=0.001, gt=0, le=0.05)
    command_timeout_s: float = Field(default=2.0, gt=0, le=30)


class RobotProfile(Section):
    """The robot and its description (URDF), which serves the simulator and the kinematics.

    Args:
        name: part of every key.
        driver: who moves it.
        command: what it is commanded by: ``pose`` of the TCP, for a Cartesian impedance
            controller, or ``joint`` positions, for an arm without one.
        description: path of the URDF, or ``example-robot-data:`` and a path in that package.
        base_frame: link all poses are given in.
        tcp_frame: link whose pose is meant.
        arm_joints: in the order in which every list of joint values in the profile is.
        finger_joints: of the gripper.
        home_rad: where a reset puts the simulated arm, and the posture a redundant arm keeps.
        gripper: its own section.
    """

    name: Name
    driver: Literal["sim", "ros2"] = "sim"
    command: Literal["pose", "joint"] = "pose"
    description: Word
    base_frame: Word
    tcp_frame: Word
    arm_joints: Words = Field(min_length=1)
    finger_joints: Words = ()
    home_rad: tuple[float, ...] = Field(strict=False)
    gripper: GripperProfile = GripperProfile()

    @model_validator(mode="after")
    def _joints_fit(self) -> RobotProfile:
        faults = []
        if len(self.home_rad) != len(self.arm_joints):
            why = f"has {len(self.home_rad)} angles for {len(self.arm_joints)} arm_joints"
            faults.append((("home_rad",), why))
        faults += [
            (("home_rad", str(index)), f"is {angle:g}: more than a turn; give radians")
            for index, angle in enumerate(self.home_rad)
            if abs(angle) > 2 * math.pi
        ]
        shared = sorted(set(self.arm_joints) & set(self.finger_joints))
        if shared:
            faults.append((("finger_joints",), f"repeats arm_joints: {', '.join(shared)}"))
        if self.gripper.dead_band_m >= self.gripper.max_width_m:
            why = (
                f"must be less than max_width_m ({self.gripper.max_width_m:g}): nothing would move"
            )
            faults.append((("gripper", "dead_band_m"), why))
        refuse(faults)
        return self


class Workspace(Section):
    """Box in the base frame that the TCP must not leave, in m."""

    x_m: Reach = (0.2, 0.75)
    y_m: Reach = (-0.45, 0.45)
    z_m: Reach = (0.012, 0.9)


class TranslationLimits(Section):
    """Per axis of the base frame."""

    velocity_m_s: float = Field(default=0.5, gt=0, le=1.7)
    acceleration_m_s2: float = Field(default=2.0, gt=0, le=13)
    jerk_m_s3: float = Field(default=20.0, gt=0, le=6500)


class RotationLimits(Section):
    """Per axis of the rotation vector."""

    velocity_rad_s: float = Field(default=1.5, gt=0, le=2.5)
    acceleration_rad_s2: float = Field(default=6.0, gt=0, le=25)
    jerk_rad_s3: float = Field(default=60.0, gt=0, le=12500)


class ReachLimits(Section):
    """What the arm's kinematics allow a goal to be; see `vla_zenoh.control.reach`.

    Args:
        joint_margin_rad: kept from both ends of every joint's range.
        singularity_slow: smallest singular value of the Jacobian below which the arm gets slower
            and steps shorter.
        singularity_stop: it gets no smaller than this.
        collision_slow_m: distance of the arm to itself below which likewise.
        collision_stop_m: it comes no nearer; also the arm, without its hand, to the table.
        table_z_m: height of the table in the base frame; null: there is none.
        table_slow_m: likewise for hand and fingers, which have work to do there.
        table_stop_m: they come no nearer.
    """

    joint_margin_rad: float = Field(default=0.05, ge=0, le=0.5)
    singularity_slow: float = Field(default=0.05, ge=0, le=0.5)
    singularity_stop: float = Field(default=0.015, ge=0, le=0.5)
    collision_slow_m: float = Field(default=0.05, ge=0, le=0.3)
    collision_stop_m: float = Field(default=0.02, ge=0, le=0.3)
    table_z_m: float | None = Field(default=0.0, ge=-2, le=2)
    table_slow_m: float = Field(default=0.002, ge=0, le=0.3)
    table_stop_m: float = Field(default=0.001, ge=0, le=0.3)

    @model_validator(mode="after")
    def _a_stop_lies_behind_its_slow(self) -> ReachLimits:
        refuse(
            [
                ((stop,), f"is {at:g}, which must not be above {slow} ({before:g})")
                for slow, before, stop, at in (
                    (
                        "singularity_slow",
                        self.singularity_slow,
                        "singularity_stop",
                        self.singularity_stop,
                    ),
                    (
                        "collision_slow_m",
                        self.collision_slow_m,
                        "collision_stop_m",
                        self.collision_stop_m,
                    ),
                    ("table_slow_m", self.table_slow_m, "table_stop_m", self.table_stop_m),
                )
                if at > before
            ]
        )
        return self


class Limits(Section):
    """Bounds of every motion; upper bounds are Franka's published ones for the Panda.

    Args:
        workspace: box of the TCP.
        translation: of the smoothed motion.
        rotation: likewise.
        joint: of a motion commanded by joint positions.
        reach: what joints, singularities, the arm itself and the table allow.
        step_m: largest translation of one model step.
        step_rad: largest rotation of one model step.
        out_of_bounds: ``clamp`` shortens to the bound and tells, ``refuse`` drops the whole chunk.
        lead_m: leash: the goal may run ahead of the commanded pose by this much.
        lead_rad: likewise.
        tracking_m: leash: commanded minus measured pose; more brakes the arm (it is blocked).
        tracking_rad: likewise.
    """

    workspace: Workspace = Workspace()
    translation: TranslationLimits = TranslationLimits()
    rotation: RotationLimits = RotationLimits()
    joint: JointLimits = JointLimits()
    reach: ReachLimits = ReachLimits()
    step_m: float = Field(default=0.05, gt=0, le=0.2)
    step_rad: float = Field(default=0.2, gt=0, le=0.8)
    out_of_bounds: Literal["clamp", "refuse"] = "clamp"
    lead_m: float = Field(default=0.15, gt=0, le=0.5)
    lead_rad: float = Field(default=0.6, gt=0, le=1.5)
    tracking_m: float = Field(default=0.05, gt=0, le=0.2)
    tracking_rad: float = Field(default=0.3, gt=0, le=1.0)

    @model_validator(mode="after")
    def _a_step_fits_the_leash(self) -> Limits:
        refuse(
            [
                ((step,), f"is {value:g}, longer than the leash {lead} ({limit:g})")
                for step, value, lead, limit in (
                    ("step_m", self.step_m, "lead_m", self.lead_m),
                    ("step_rad", self.step_rad, "lead_rad", self.lead_rad),
                )
                if value > limit
            ]
        )
        return self


class Timing(Section):
    """Rates and patience.

    Args:
        command_hz: of the pose stream.
        state_hz: of the robot's state (the simulator's; a real robot has its own).
        watchdog_s: no fresh chunk for this long after the last one ran out: brake and hold.
        state_timeout_s: robot state older than this: brake, and activation is needed again.
        command_timeout_s: pose stream silent for this long: the robot side brakes by itself.
        max_observation_age_s: a chunk made from an older observation is refused.
        max_clock_step_s: the wall clock jumped by more: brake, and activation is needed again.
        max_clock_offset_s: another host's clock may differ by this much, which is then reckoned
            with; beyond it activation is refused.
    """

    command_hz: float = Field(default=250.0, ge=50, le=1000)
    state_hz: float = Field(default=200.0, ge=20, le=1000)
    watchdog_s: float = Field(default=0.3, ge=0.02, le=5)
    state_timeout_s: float = Field(default=0.15, ge=0.02, le=2)
    command_timeout_s: float = Field(default=0.1, ge=0.01, le=1)
    max_observation_age_s: float = Field(default=1.0, gt=0, le=10)
    max_clock_step_s: float = Field(default=0.05, gt=0, le=1)
    max_clock_offset_s: float = Field(default=0.1, gt=0, le=1)

    @model_validator(mode="after")
    def _patience_outlasts_the_rate(self) -> Timing:
        refuse(
            [
                ((name,), f"is {wait_s:g}, less than {MIN_PERIODS} periods of {rate} ({rate_hz:g})")
                for name, wait_s, rate, rate_hz in (
                    ("command_timeout_s", self.command_timeout_s, "command_hz", self.command_hz),
                    ("watchdog_s", self.watchdog_s, "command_hz", self.command_hz),
                    ("state_timeout_s", self.state_timeout_s, "state_hz", self.state_hz),
                )
                if wait_s * rate_hz < MIN_PERIODS - 1e-9
            ]
        )
        return self


class Composition(Section):
    """What is followed where chunks overlap; see `vla_zenoh.control.aggregate`.

    Args:
        mode: ``replace``: the newest chunk alone; ``blend``: it takes over from the one before
            within a window; ``ensemble``: the weighted mean of all that still run.
        blend_s: the window of ``blend``.
        ensemble_decay: m of ``ensemble``: chunk i, 0 the oldest, has the weight exp(-m i).
        ensemble_plans: the newest so many chunks have a say at most.
    """

    mode: Literal["replace", "blend", "ensemble"] = "replace"
    blend_s: float = Field(default=0.2, gt=0, le=2)
    ensemble_decay: float = Field(default=0.01, ge=0, le=10)
    ensemble_plans: int = Field(default=16, ge=2, le=64)


class CameraProfile(Section):
    """A camera.

    Args:
        source: ``sim:<camera of the scene>``, ``v4l2:<device>`` (``v4l2:/dev/video0``),
            ``rtsp://...``, ``file:<video or folder of pictures>``, or ``ros2:<topic>``.
        width: pixels published.
        height: likewise.
        rate_hz: pictures per second, at most.
        jpeg_quality: of pictures as JPEG, which is how they travel between hosts, 1 to 100.
        jpeg_rate_hz: of those at most; null: as many as there are.
        jpeg_width: wider ones are made smaller for the jpeg key; null: as they are.
        fit_for_workers: a worker on another host gets them in the very size of its spec, made
            where the camera is. Of the sources all but ``ros2:`` can.
        loop: a file starts again at its end.
    """

    source: Annotated[Word, AfterValidator(_source)]
    width: int = Field(default=640, ge=16, le=8192)
    height: int = Field(default=480, ge=16, le=8192)
    rate_hz: float = Field(default=30.0, gt=0, le=240)
    jpeg_quality: int = Field(default=90, ge=1, le=100)
    jpeg_rate_hz: float | None = Field(default=None, gt=0, le=240)
    jpeg_width: int | None = Field(default=None, ge=16, le=8192)
    fit_for_workers: bool = False
    loop: bool = True


class SimProfile(Section):
    """The simulator.

    Args:
        scene: folder under sim/.
        gains: preset of the impedance controller.
        joint_friction_nm: Coulomb friction in every arm joint.
        seed: of the first placement of the objects.
        vary: what else a seed changes, beside places; the scene has to have it.
        renderer: ``auto`` takes OpenGL where it works, else ray casting.
    """

    scene: Word = "table"
    gains: Literal["stiff", "compliant"] = "stiff"
    joint_friction_nm: float = Field(default=0.0, ge=0, le=10)
    seed: int = Field(default=0, ge=0)
    vary: Annotated[
        tuple[Literal["lights", "table", "camera", "distractors"], ...],
        Field(strict=False),
        Distinct,
    ] = ()
    renderer: Literal["auto", "egl", "osmesa", "raycast"] = "auto"


class TaskProfile(Section):
    """What the settings are until somebody puts others."""

    prompt: Text = "hold"
    rate_hz: float = Field(default=5.0, ge=0.05, le=100)
    worker: Name = "scripted"


class HostProfile(Section):
    """One computer: which nodes run there, and how it reaches the router from there.

    Args:
        nodes: kinds of nodes.
        connect: where the router is seen from there; None: as session.connect says.
        listen: where the router of this host listens; None: as session.listen says.
        link: routers of other hosts that this one connects to. With two routers in ``connect`` a
            host goes on with the second one when the first is gone.
        cameras: those of its camera node; None: all.
        workers: those it runs; None: all.
    """

    nodes: Annotated[tuple[NodeKind, ...], Field(strict=False, min_length=1), Distinct]
    connect: Endpoints | None = None
    listen: Endpoints | None = None
    link: Endpoints | None = None
    cameras: Names | None = None
    workers: Names | None = None


class Profile(Section):
    """Everything about one robot and its lab."""

    name: Name
    about: Text = ""
    root: Annotated[Word, AfterValidator(_root)] = keys.DEFAULT_ROOT
    robot: RobotProfile
    limits: Limits = Limits()
    timing: Timing = Timing()
    composition: Composition = Composition()
    cameras: dict[Name, CameraProfile] = Field(default_factory=dict)
    sim: SimProfile = SimProfile()
    workers: Names = ("scripted",)
    task: TaskProfile = TaskProfile()
    session: SessionProfile = SessionProfile()
    hosts: dict[Name, HostProfile] = Field(
        default_factory=lambda: {"here": HostProfile(nodes=SIMULATED)}
    )
    ros2: Ros2Profile | None = None

    @property
    def keys(self) -> Keys:
        """The keys of this profile's robot."""
        return Keys(self.robot.name, self.root)

    @model_validator(mode="after")
    def _parts_fit(self) -> Profile:
        refuse(fit.faults(self))
        return self
