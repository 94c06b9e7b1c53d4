"""Vision-language-action models and robots, connected by Zenoh.

    import vla_zenoh

    with vla_zenoh.connect("panda_sim") as robot:
        robot.set_prompt("HARD: go up x20")
        robot.activate()

The names below are the public ones. Each is imported when it is first used, so that a host needs
only the libraries of what it runs.
"""

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from vla_zenoh.client.primitives import PrimitiveError
    from vla_zenoh.client.remote_robot import RemoteRobot, connect
    from vla_zenoh.errors import (
        CodecError,
        ProfileError,
        RecordError,
        SecurityError,
        SessionError,
        SpecError,
        VlaZenohError,
    )
    from vla_zenoh.policy import (
        ActionSpec,
        ActionSteps,
        CameraSpec,
        ModelSpec,
        Observation,
        ObservationSpec,
        Policy,
    )
    from vla_zenoh.profile import Profile, load_profile
    from vla_zenoh.robot import Command, Reading, Robot
    from vla_zenoh.types import ActionChunk, GripperState, Image, JointState, PoseState, Stamped

__all__ = [
    "ActionChunk",
    "ActionSpec",
    "ActionSteps",
    "CameraSpec",
    "CodecError",
    "Command",
    "GripperState",
    "Image",
    "JointState",
    "ModelSpec",
    "Observation",
    "ObservationSpec",
    "Policy",
    "PoseState",
    "PrimitiveError",
    "Profile",
    "ProfileError",
    "Reading",
    "RecordError",
    "RemoteRobot",
    "Robot",
    "SecurityError",
    "SessionError",
    "SpecError",
    "Stamped",
    "VlaZenohError",
    "connect",
    "load_profile",
]


def lazy_names(package: str, *modules: str) -> Callable[[str], Any]:
    """A package's ``__getattr__``: imports the first of `modules` that has the name.

    `vla_zenoh.types` and `vla_zenoh.profile` are such packages, so that a command which only drives
    loads neither numpy nor the profile's schema. Light modules come first.
    """

    def find(name: str) -> Any:
        # Python itself asks for names with underscores; submodules are not among our names.
        for module in () if name.startswith("__") or name in modules else modules:
            found = getattr(import_module(f"{package}.{module}"), name, find)
            if found is not find:
                return found
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return find


_find = lazy_names(__name__, "errors", "types", "robot", "policy", "profile", "client.remote_robot")


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'vla_zenoh' has no attribute {name!r}")
    return _find(name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
