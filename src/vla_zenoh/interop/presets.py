"""Options for the robots and data sets that published policies were trained on.

Not converted: the origin of the model's world (LIBERO's is not the robot's base), the rotation of
its tool frame against ours, the framing of its images, and that the controllers of
LIBERO and DROID put a step on where the arm is measured, of which it then covers a part: here a
step is put on the goal, and all of it is carried out.

Sources: openpi's examples for DROID and LIBERO, DROID's own joint velocity control (one unit is 0.2
rad a step), robosuite's OSC_POSE controller (one unit is 0.05 m or 0.5 rad a step), GR00T's LIBERO
and SimplerEnv evaluation, OpenVLA's data statistics for BridgeData V2.
"""

from __future__ import annotations

from collections.abc import Mapping

Presets = Mapping[str, Mapping[str, str]]

_STATE8 = "position+rotvec+fingers_m"
OSC = {
    "action": "delta",
    "rotation": "rotvec",
    "clip": "1",
    "position_scale_m": "0.05",
    "rotation_scale_rad": "0.5",
    "dt_s": "0.05",
}
"""LIBERO's controller."""
_OPENS_AT_1 = {"gripper": "binary", "gripper_open": "high"}
"""As data for OpenVLA and GR00T was converted to; LIBERO's environment takes -1 for open."""
_BRIDGE = {"action": "delta", "rotation": "rpy", "dt_s": "0.2", **_OPENS_AT_1}
_OWN = {
    "size": "",
    "resize": "none",
    "action": "delta",
    "rotation": "rpy",
    "gripper": "absolute_m",
    "dt_s": "0.1",
    "horizon": "16",
}

OPENPI: Presets = {
    "libero": {
        "map": "observation/image=camera:front, observation/wrist_image=camera:wrist, "
        f"observation/state={_STATE8}, prompt=prompt",
        **OSC,
        "gripper": "binary",
        "gripper_open": "low",
        "gripper_threshold": "0",
        "horizon": "10",
    },
    "droid": {
        "map": "observation/exterior_image_1_left=camera:front, "
        "observation/wrist_image_left=camera:wrist, observation/joint_position=joint, "
        "observation/gripper_position=gripper_closed, prompt=prompt",
        "action": "joint_delta",
        "joint_scale_rad": "0.2",
        "clip": "1",
        "gripper": "binary",
        "gripper_open": "low",
        "dt_s": "0.0666667",
        "horizon": "8",
    },
    "own": {
        "map": "observation/front=camera:front, observation/pose=position+quat_xyzw, "
        "observation/gripper=gripper_m, prompt=prompt",
        **_OWN,
    },
}

GROOT: Presets = {
    "libero": {
        "map": "video.image=camera:front, video.wrist_image=camera:wrist, state.x=x, state.y=y, "
        "state.z=z, state.roll=rx, state.pitch=ry, state.yaw=rz, state.gripper=fingers_m, "
        "annotation.human.action.task_description=prompt",
        "size": "256x256",
        "keys": "x,y,z,roll,pitch,yaw,gripper",
        **OSC,
        **_OPENS_AT_1,
        "horizon": "16",
    },
    "bridge": {
        "map": "video.image_0=camera:front, state.x=x, state.y=y, state.z=z, state.roll=roll, "
        "state.pitch=pitch, state.yaw=yaw, state.pad=zero, state.gripper=gripper_open, "
        "annotation.human.action.task_description=prompt",
        "size": "256x256",
        "keys": "x,y,z,roll,pitch,yaw,gripper",
        **_BRIDGE,
        "horizon": "8",
    },
}

OPENVLA_REST: Presets = {
    "bridge": {
        "map": "image=camera:front, instruction=prompt",
        **_BRIDGE,
        "horizon": "1",
    },
    "libero": {
        "map": "image=camera:front, instruction=prompt",
        **OSC,
        **_OPENS_AT_1,
        "horizon": "1",
    },
    "oft_libero": {
        "map": "full_image=camera:front, wrist_image=camera:wrist, "
        f"state={_STATE8}, instruction=prompt",
        **OSC,
        **_OPENS_AT_1,
        "horizon": "8",
    },
}
