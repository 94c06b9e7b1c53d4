"""An arm of six joints of which three turn without an end: its base, its forearm and its flange."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from made_arm import made_arm

from vla_zenoh.profile import Profile, override

CHAIN = "eztytyextyex"
ENDLESS = ("joint1", "joint4", "joint6")
HOME_RAD = (3.0, -0.8, 1.6, 0.2, 0.7, 3.0)


def endless_arm(folder: Path, **parts: Any) -> Profile:
    """Its profile, with changes by section."""
    made = made_arm(folder, CHAIN, 0.2, effort=60.0)
    return override(override(made, {"robot": {"home_rad": list(HOME_RAD)}}), parts)
