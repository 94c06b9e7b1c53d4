"""Records that travel on keys: frozen, checked, units in their names.

A record that exists is valid: arrays have their shape, are finite, contiguous and read-only,
quaternions are unit. Constructing one from bad values raises a `RecordError` that names the field.
The stamp is not part of a record: it travels beside it as a `Header`.

Frames: poses are those of the tool centre point (TCP) in the robot's base frame. A twist is
``[linear m/s, angular rad/s]``, a wrench ``[force N, torque Nm]``, both with respect to the base
frame's axes and the TCP's origin. Quaternions are stored ``x, y, z, w``.
"""

from typing import TYPE_CHECKING

from vla_zenoh import lazy_names

if TYPE_CHECKING:
    from vla_zenoh.types.arrays import (
        QUATERNION_NORM_TOLERANCE,
        FloatArray,
        computed,
        unit_quaternion,
        vector,
    )
    from vla_zenoh.types.checks import (
        MAX_NAMES,
        MAX_TEXT,
        shown,
    )
    from vla_zenoh.types.chunk import ActionChunk, InferenceDebug
    from vla_zenoh.types.commands import (
        LATENCY_STAGES,
        Cause,
        GripperCommand,
        JointCommand,
        PoseCommand,
    )
    from vla_zenoh.types.reports import Event, HeldBox, NodeStatus, Task
    from vla_zenoh.types.states import (
        Depth,
        GripperState,
        Image,
        JointState,
        ObjectPoses,
        PoseState,
        PrivilegedState,
        SceneState,
    )
    from vla_zenoh.types.stream import Header, Stamped

__all__ = [
    "LATENCY_STAGES",
    "MAX_NAMES",
    "MAX_TEXT",
    "QUATERNION_NORM_TOLERANCE",
    "ActionChunk",
    "Cause",
    "Depth",
    "Event",
    "FloatArray",
    "GripperCommand",
    "GripperState",
    "Header",
    "HeldBox",
    "Image",
    "InferenceDebug",
    "JointCommand",
    "JointState",
    "NodeStatus",
    "ObjectPoses",
    "PoseCommand",
    "PoseState",
    "PrivilegedState",
    "SceneState",
    "Stamped",
    "Task",
    "computed",
    "shown",
    "unit_quaternion",
    "vector",
]

__getattr__ = lazy_names(
    __name__, "checks", "stream", "reports", "commands", "states", "chunk", "arrays"
)
