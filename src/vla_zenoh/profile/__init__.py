"""Profiles: one YAML file describes a robot, its computers and its limits."""

from typing import TYPE_CHECKING

from vla_zenoh import lazy_names

if TYPE_CHECKING:
    from vla_zenoh.profile.limits import *
    from vla_zenoh.profile.load import *
    from vla_zenoh.profile.profile import *
    from vla_zenoh.profile.robot import *
    from vla_zenoh.profile.schema import *

__getattr__ = lazy_names(__name__, "load", "profile", "schema", "robot", "limits")
