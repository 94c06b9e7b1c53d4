"""What LeRobot's commands are told about a robot, camera or leader of vla-zenoh."""

from dataclasses import dataclass, field

from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig

from vla_zenoh.errors import ProfileError, nearest
from vla_zenoh.profile import Profile, load_profile


def arm_profile(name: str) -> Profile:
    """The profile of a robot of one arm.

    Raises:
        ProfileError: it is wrong, or its robot has parts.
    """
    profile = load_profile(name)
    profile.require_one_arm(f"LeRobot's type vla_zenoh with profile {name!r}")
    return profile


@CameraConfig.register_subclass("vla_zenoh")
@dataclass(kw_only=True)
class VlaZenohCameraConfig(CameraConfig):
    """A camera of a robot on the bus.

    Args:
        profile: of the robot, name or path.
        camera: its name there.
        endpoints: routers, such as ``tcp/10.0.0.2:7447``; empty: the profile's.
        width, height, fps: None: those of the profile. The images must have this size, and come as
            often at least.
    """

    profile: str
    camera: str
    endpoints: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        cameras = load_profile(self.profile).cameras
        if self.camera not in cameras:
            raise ProfileError(
                f"profile {self.profile!r} has no camera {self.camera!r}"
                f"{nearest(self.camera, cameras)} It has: {', '.join(cameras) or 'none'}"
            )
        known = cameras[self.camera]
        rate_hz = min(known.rate_hz, known.jpeg_rate_hz or known.rate_hz)
        self.width = self.width or known.width
        self.height = self.height or known.height
        self.fps = self.fps or int(rate_hz)
        if self.fps > rate_hz:
            raise ProfileError(
                f"camera {self.camera!r} has {rate_hz:g} images a second, not fps={self.fps}"
            )


@RobotConfig.register_subclass("vla_zenoh")
@dataclass(kw_only=True)
class VlaZenohConfig(RobotConfig):
    """An arm on the bus, driven through its command node and all of its limits.

    Args:
        profile: of the robot, name or path.
        fps: of LeRobot's loop: an action is reached after 1 / fps s.
        worker: name of the worker whose chunks the actions are.
        endpoints: routers, such as ``tcp/10.0.0.2:7447``; empty: the profile's.
        cameras: None: all of the profile; ``{}``: none.
    """

    profile: str
    fps: int = 30
    worker: str = "lerobot_loop"
    endpoints: list[str] = field(default_factory=list)
    cameras: dict[str, CameraConfig] | None = None

    def __post_init__(self) -> None:
        profile = arm_profile(self.profile)
        if self.fps < 1:
            raise ValueError(f"fps is {self.fps}, wanted 1 or more")
        if self.cameras is None:
            self.cameras = {
                name: VlaZenohCameraConfig(
                    profile=self.profile, camera=name, endpoints=self.endpoints
                )
                for name in profile.cameras
            }
        super().__post_init__()


@TeleoperatorConfig.register_subclass("vla_zenoh")
@dataclass(kw_only=True)
class VlaZenohTeleopConfig(TeleoperatorConfig):
    """An arm on the bus as a leader: its measured joints are the actions.

    Args:
        profile: of the leader, name or path.
        endpoints: routers, such as ``tcp/10.0.0.2:7447``; empty: the profile's.
    """

    profile: str
    endpoints: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        arm_profile(self.profile)
