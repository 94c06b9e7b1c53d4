"""Keys that profiles of older versions have, and what stands there now.

``docs/reference/renamed.md`` is the page for people; a test compares.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

FORMER: Mapping[str, str] = {
    "cameras.*.loop": "is gone: a file: camera always starts again at its end; delete the line",
    "cameras.*.check.uniform_share": "is gone: contrast_levels detects a covered lens; delete it",
    "hosts.*.pictures": "is gone: jpeg_rate_hz, jpeg_width, jpeg_quality and fit_for_workers of a "
    "camera limit what travels between hosts",
    "ros2.gripper.per_finger": "is now position: finger (true) or position: width (false)",
    "ros2.services": "is now true or false; write the topic under ros2.prefix",
    "ros2.tcp": "is gone: the pose of the TCP follows from joints and description; delete it",
    "session.router": "is gone: up uses a router that answers already; delete the line",
    "sim.gains": "is gone: the simulated arm has one set of gains; delete the line",
}
"""Place, ``*`` for any name -> how the sentence about it goes on."""


def former(place: Sequence[str]) -> str:
    """What became of the key at `place`; empty: no older version had it."""
    for known, remedy in FORMER.items():
        names = known.split(".")
        if len(names) == len(place) and all(map(_matches, names, place)):
            return remedy
    return ""


def _matches(pattern: str, name: str) -> bool:
    return pattern in ("*", name)
