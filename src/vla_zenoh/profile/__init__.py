"""Profiles: one YAML file describes a robot, its computers and its limits."""

from vla_zenoh.profile.limits import *
from vla_zenoh.profile.load import *
from vla_zenoh.profile.profile import *
from vla_zenoh.profile.robot import *
from vla_zenoh.profile.schema import *
