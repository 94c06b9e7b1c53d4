"""What the thesis this package grew from published for the same protocol.

Source: "Building a ROS2-VLA Bridge", Table 5.2 and the summary published with its recordings: a
real Franka Panda, 50 requests each, deltas added to the measured pose. Path length, not distance.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Published:
    """Figures of one run; None where none was published.

    Args:
        path_m: length of the path of the TCP, in translation.
        path_rad: likewise in rotation.
        e2e_ms: request to pose command, mean and p95.
        outbound_ms: request to its arrival at the model, mean and p95.
    """

    path_m: float | None = None
    path_rad: float | None = None
    e2e_ms: tuple[float, float] | None = None
    outbound_ms: tuple[float, float] | None = None


THESIS: dict[tuple[str, float], Published] = {
    ("go up", 1.0): Published(0.248, 0.421, (7.323, 8.055), (5.963, 6.631)),
    ("go up", 5.0): Published(0.121),
    ("yaw right", 1.0): Published(None, 1.248),
    ("yaw right", 5.0): Published(None, 1.003),
    ("yaw left", 5.0): Published(0.096, 1.251, (6.189, 6.948), (5.122, 5.702)),
    ("pitch down", 1.0): Published(0.076, 0.238, (7.210, 8.340), (5.939, 6.692)),
    ("pitch down", 5.0): Published(None, 0.285),
    ("roll left", 1.0): Published(None, 0.043),
    ("roll left", 5.0): Published(None, 0.010),
    ("close gripper", 5.0): Published(0.001, 0.001, (6.169, 6.828), (5.047, 5.594)),
}
"""By motion and rate in Hz."""
