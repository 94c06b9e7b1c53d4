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
    from vla_zenoh.types.arrays import QUATERNION_NORM_TOLERANCE as QUATERNION_NORM_TOLERANCE
    from vla_zenoh.types.arrays import FloatArray as FloatArray
    from vla_zenoh.types.arrays import computed as computed
    from vla_zenoh.types.arrays import unit_quaternion as unit_quaternion
    from vla_zenoh.types.arrays import vector as vector
    from vla_zenoh.types.records import LATENCY_STAGES as LATENCY_STAGES
    from vla_zenoh.types.records import ActionChunk as ActionChunk
    from vla_zenoh.types.records import Cause as Cause
    from vla_zenoh.types.records import Depth as Depth
    from vla_zenoh.types.records import GripperCommand as GripperCommand
    from vla_zenoh.types.records import GripperState as GripperState
    from vla_zenoh.types.records import Image as Image
    from vla_zenoh.types.records import InferenceDebug as InferenceDebug
    from vla_zenoh.types.records import JointCommand as JointCommand
    from vla_zenoh.types.records import JointReference as JointReference
    from vla_zenoh.types.records import JointState as JointState
    from vla_zenoh.types.records import ObjectPoses as ObjectPoses
    from vla_zenoh.types.records import PoseCommand as PoseCommand
    from vla_zenoh.types.records import PoseReference as PoseReference
    from vla_zenoh.types.records import PoseState as PoseState
    from vla_zenoh.types.records import PrivilegedState as PrivilegedState
    from vla_zenoh.types.records import SceneState as SceneState
    from vla_zenoh.types.stream import MAX_NAMES as MAX_NAMES
    from vla_zenoh.types.stream import MAX_TEXT as MAX_TEXT
    from vla_zenoh.types.stream import Event as Event
    from vla_zenoh.types.stream import Header as Header
    from vla_zenoh.types.stream import HeldBox as HeldBox
    from vla_zenoh.types.stream import NodeStatus as NodeStatus
    from vla_zenoh.types.stream import SingleWriterFilter as SingleWriterFilter
    from vla_zenoh.types.stream import Stamped as Stamped
    from vla_zenoh.types.stream import Task as Task
    from vla_zenoh.types.stream import shown as shown

__getattr__ = lazy_names(__name__, "stream", "records", "arrays")
