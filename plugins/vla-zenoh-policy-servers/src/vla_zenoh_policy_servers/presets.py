"""Options for the robots and data sets that published policies were trained on.

Not converted: the origin of the model's world (LIBERO's is not the robot's base), the rotation of
its tool frame against ours, and the framing of its images.

LIBERO's controller covers a part of each step only, and here the arm moves about as far:
`ActionSpec.controller`. BridgeData's arm adds each step to its last target.

Sources: openpi's examples for DROID and LIBERO, DROID's own joint velocity control (one unit is 0.2
rad a step), robosuite's OSC_POSE controller (one unit is 0.05 m or 0.5 rad a step, kp 150, damping
ratio 1), GR00T's LIBERO and SimplerEnv evaluation, OpenVLA's data statistics for BridgeData V2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

Presets = Mapping[str, Mapping[str, str]]

STATE8 = "position+rotvec+fingers_m"
OSC = {
    "action": "delta",
    "rotation": "rotvec",
    "rotation_reference": "1,0,0,0",
    "clip": "1",
    "position_scale_m": "0.05",
    "rotation_scale_rad": "0.5",
    "anchor": "goal",
    "relative_to": "previous",
    "controller": "150:1",
    "dt_s": "0.05",
}
"""LIBERO's controller. Its states turn about +x by about half a turn where the tool points down."""
OPENS_AT_1 = {"gripper": "binary", "gripper_open": "high"}
"""As data for OpenVLA and GR00T was converted to; LIBERO's environment takes -1 for open."""
ADDED = {"anchor": "goal", "relative_to": "previous", "controller": "none"}
"""Each step is added to the one before it, and all of it is executed."""
BRIDGE = {"action": "delta", **ADDED, "rotation": "rpy", "dt_s": "0.2", **OPENS_AT_1}
LEROBOT = {
    "action": "joint_position",
    "joint_scale_rad": repr(math.pi / 180),
    "gripper": "open_fraction",
    "gripper_range": "0:100",
}
"""LeRobot's robots: ``JOINT.pos`` in degrees, ``gripper.pos`` from 0 shut to 100 open."""
LEROBOT_STATE = "joint+gripper_open"
"""Their state, in the same units."""
