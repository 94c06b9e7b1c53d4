"""The model contract: what a model declares, its input and its output."""

# Not found lazily, as a model's file may import all of them by a star.
from vla_zenoh.policy.inference import *
from vla_zenoh.policy.spec import *
