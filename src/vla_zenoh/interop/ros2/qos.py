"""ROS 2 quality of service, and its text in liveliness tokens."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Qos:
    """The used part of a ROS 2 QoS profile; history is always the last `depth`.

    Args:
        depth: samples kept.
        reliable: they must arrive.
    """

    depth: int = 10
    reliable: bool = True

    def as_ros2dds(self, type_hash: str | None) -> str:
        """As in the bridge's tokens: key-less, DDS's numbers, and the hash as user data."""
        text = f":{int(self.reliable)}:0:0,{self.depth}"
        return text if type_hash is None else f"{text}:typehash={type_hash};"

    def as_rmw_zenoh(self) -> str:
        """As in rmw_zenoh's tokens: what is the default (reliable, volatile) is left out."""
        reliability = "" if self.reliable else "2"
        return f"{reliability}::,{self.depth}:,:,:,,"


DEFAULT = Qos()
SENSOR = Qos(depth=5, reliable=False)
"""rclcpp's SensorDataQoS: matches both reliable and best-effort publishers."""
COMMAND = Qos(depth=1)
"""Setpoints: reliable, so that it matches every subscriber; the newest replaces older ones."""
