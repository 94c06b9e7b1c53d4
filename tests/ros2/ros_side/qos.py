"""QoS of a topic as a test writes it, and what rclpy says where two do not match."""

from __future__ import annotations

from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from told import tell


def qos(reliable: bool = True, transient_local: bool = False, depth: int = 10) -> QoSProfile:
    """What is not given is as in ROS: reliable, volatile, the last ten."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if transient_local
        else DurabilityPolicy.VOLATILE,
    )


def publishes(topic: str) -> PublisherEventCallbacks:
    """Tells of every subscriber that asks for more than a publisher offers."""

    def mismatch(info: Any) -> None:
        tell(mismatch=topic, side="publisher", policy=str(info.last_policy_kind))

    return PublisherEventCallbacks(incompatible_qos=mismatch)


def subscribes(topic: str) -> SubscriptionEventCallbacks:
    """Tells of every publisher that offers less than is asked for."""

    def mismatch(info: Any) -> None:
        tell(mismatch=topic, side="subscription", policy=str(info.last_policy_kind))

    return SubscriptionEventCallbacks(incompatible_qos=mismatch)
