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
    from vla_zenoh.types.arrays import *
    from vla_zenoh.types.form import *
    from vla_zenoh.types.joint_bound import *
    from vla_zenoh.types.records import *
    from vla_zenoh.types.stream import *

__getattr__ = lazy_names(__name__, "stream", "form", "records", "arrays", "joint_bound")
