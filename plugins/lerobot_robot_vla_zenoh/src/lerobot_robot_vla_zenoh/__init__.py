"""Arms, cameras and leaders of vla-zenoh in LeRobot's own commands, of the type ``vla_zenoh``."""

from lerobot_robot_vla_zenoh.camera import VlaZenohCamera
from lerobot_robot_vla_zenoh.config import (
    VlaZenohCameraConfig,
    VlaZenohConfig,
    VlaZenohTeleopConfig,
)
from lerobot_robot_vla_zenoh.robot import VlaZenoh
from lerobot_robot_vla_zenoh.teleoperator import VlaZenohTeleop

__all__ = [
    "VlaZenoh",
    "VlaZenohCamera",
    "VlaZenohCameraConfig",
    "VlaZenohConfig",
    "VlaZenohTeleop",
    "VlaZenohTeleopConfig",
]
