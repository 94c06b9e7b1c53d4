"""What a profile may say. Frozen records; every field has its unit in its name.

Defaults are the safe choice, so a profile that says nothing about limits has limits.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from vla_zenoh import keys
from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import Keys
from vla_zenoh.profile.ros2 import Ros2Profile

NODE_KINDS = ("router", "sim", "camera", "command", "worker")


class Section(BaseModel):
    """A part of a profile: frozen, unknown keys refused, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _key_part(value: str) -> str:
    try:
        return keys.chunk(value, "name")
    except ProfileError as error:
        raise ValueError(str(error)) from error


Name = Annotated[str, AfterValidator(_key_part)]
Positive = Annotated[float, Field(gt=0)]
Range = Annotated[tuple[float, float], AfterValidator(lambda pair: _ordered(pair))]


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] >= pair[1]:
        raise ValueError(f"[{pair[0]:g}, {pair[1]:g}] is empty: give [smallest, largest]")
    return pair


class GripperProfile(Section):
    """The gripper. A command is sent when the width differs by more than the dead band."""

    max_width_m: float = Field(default=0.08, gt=0, le=1)
    speed_m_s: float = Field(default=0.1, gt=0, le=1)
    force_n: float = Field(default=25.0, ge=0, le=500)
    dead_band_m: float = Field(default=0.001, gt=0, le=0.05)
    command_timeout_s: float = Field(default=2.0, gt=0, le=30)


class RobotProfile(Section):
    """The robot and its description (URDF), which serves the simulator and the kinematics."""

    name: Name
    driver: Literal["sim", "ros2"] = "sim"
    description: str
    base_frame: str
    tcp_frame: str
    arm_joints: tuple[str, ...] = Field(min_length=1)
    finger_joints: tuple[str, ...] = ()
    home_rad: tuple[float, ...]
    gripper: GripperProfile = GripperProfile()

    @model_validator(mode="after")
    def _one_home_angle_a_joint(self) -> RobotProfile:
        if len(self.home_rad) != len(self.arm_joints):
            raise ValueError(
                f"home_rad has {len(self.home_rad)} angles for {len(self.arm_joints)} arm_joints"
            )
        return self


class Workspace(Section):
    """Box in the base frame that the TCP must not leave, in m."""

    x_m: Range = (0.2, 0.75)
    y_m: Range = (-0.45, 0.45)
    z_m: Range = (0.012, 0.9)


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


class Limits(Section):
    """Bounds of every motion; upper bounds are Franka's published ones for the Panda.

    Args:
        workspace: box of the TCP.
        translation: of the smoothed motion.
        rotation: likewise.
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
    step_m: float = Field(default=0.05, gt=0, le=0.2)
    step_rad: float = Field(default=0.2, gt=0, le=0.8)
    out_of_bounds: Literal["clamp", "refuse"] = "clamp"
    lead_m: float = Field(default=0.15, gt=0, le=0.5)
    lead_rad: float = Field(default=0.6, gt=0, le=1.5)
    tracking_m: float = Field(default=0.05, gt=0, le=0.2)
    tracking_rad: float = Field(default=0.3, gt=0, le=1.0)


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
    """

    command_hz: float = Field(default=250.0, ge=50, le=1000)
    state_hz: float = Field(default=200.0, ge=20, le=1000)
    watchdog_s: float = Field(default=0.3, ge=0.02, le=5)
    state_timeout_s: float = Field(default=0.15, ge=0.02, le=2)
    command_timeout_s: float = Field(default=0.1, ge=0.01, le=1)
    max_observation_age_s: float = Field(default=1.0, gt=0, le=10)
    max_clock_step_s: float = Field(default=0.05, gt=0, le=1)


class CameraProfile(Section):
    """A camera.

    Args:
        source: ``sim:<camera of the scene>``, ``v4l2:<device>`` (``v4l2:/dev/video0``),
            ``rtsp://...``, ``file:<video or folder of pictures>``, or ``ros2:<topic>``.
        width: pixels published.
        height: likewise.
        rate_hz: pictures per second, at most.
        jpeg_quality: of the jpeg key, 1 to 100.
        loop: a file starts again at its end.
    """

    source: str = Field(pattern=r"^(sim|v4l2|file|ros2):.+|^rtsps?://.+")
    width: int = Field(default=640, ge=16, le=8192)
    height: int = Field(default=480, ge=16, le=8192)
    rate_hz: float = Field(default=30.0, gt=0, le=240)
    jpeg_quality: int = Field(default=90, ge=1, le=100)
    loop: bool = True


class SimProfile(Section):
    """The simulator.

    Args:
        scene: folder under sim/.
        gains: preset of the impedance controller.
        joint_friction_nm: Coulomb friction in every arm joint.
        seed: of the first placement of the objects.
        renderer: ``auto`` takes OpenGL where it works, else ray casting.
    """

    scene: str = "table"
    gains: Literal["stiff", "compliant"] = "stiff"
    joint_friction_nm: float = Field(default=0.0, ge=0, le=10)
    seed: int = Field(default=0, ge=0)
    renderer: Literal["auto", "egl", "osmesa", "raycast"] = "auto"


class TaskProfile(Section):
    """What the settings are until somebody puts others."""

    prompt: str = "hold"
    rate_hz: float = Field(default=5.0, ge=0.05, le=100)
    worker: Name = "scripted"


class SessionProfile(Section):
    """How nodes of this profile reach each other.

    Args:
        mode: ``client`` of a router (peers are not forwarded to each other by a router), or
            ``peer`` for a direct pair on one host.
        connect: where clients look for the router.
        listen: where the router listens.
        shared_memory: move large payloads through shared memory between processes of one host.
        lease_ms: a silent link is given up after this.
    """

    mode: Literal["client", "peer"] = "client"
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    shared_memory: bool = True
    lease_ms: int = Field(default=1000, ge=200, le=60000)


class HostProfile(Section):
    """One computer: which nodes run there, and how it reaches the router from there."""

    nodes: tuple[Literal["router", "sim", "camera", "command", "worker"], ...]
    connect: tuple[str, ...] | None = None
    cameras: tuple[Name, ...] | None = None
    workers: tuple[Name, ...] | None = None


class Profile(Section):
    """Everything about one robot and its lab."""

    name: Name
    about: str = ""
    root: str = keys.DEFAULT_ROOT
    robot: RobotProfile
    limits: Limits = Limits()
    timing: Timing = Timing()
    cameras: dict[Name, CameraProfile] = {}
    sim: SimProfile = SimProfile()
    workers: tuple[Name, ...] = ("scripted",)
    task: TaskProfile = TaskProfile()
    session: SessionProfile = SessionProfile()
    hosts: dict[Name, HostProfile] = {
        "here": HostProfile(nodes=("router", "sim", "camera", "command", "worker"))
    }
    ros2: Ros2Profile | None = None

    @property
    def keys(self) -> Keys:
        """The keys of this profile's robot."""
        return Keys(self.robot.name, self.root)

    @model_validator(mode="after")
    def _parts_fit(self) -> Profile:
        if self.robot.driver == "ros2" and self.ros2 is None:
            raise ValueError("robot.driver is ros2, so a section ros2 is needed")
        if self.task.worker not in self.workers:
            raise ValueError(
                f"task.worker {self.task.worker!r} is not among workers: {', '.join(self.workers)}"
            )
        for host, part in self.hosts.items():
            for what, named, known in (
                ("cameras", part.cameras, tuple(self.cameras)),
                ("workers", part.workers, self.workers),
            ):
                for name in named or ():
                    if name not in known:
                        raise ValueError(
                            f"hosts.{host}.{what}: {name!r} is not among {what}: {', '.join(known)}"
                        )
        if not self.hosts:
            raise ValueError("hosts is empty: name at least one host and its nodes")
        return self
