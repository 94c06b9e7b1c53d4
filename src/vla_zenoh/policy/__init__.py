"""The model contract: what a model declares, its input and its output."""

from typing import TYPE_CHECKING

from vla_zenoh import lazy_names

if TYPE_CHECKING:
    from vla_zenoh.policy.inference import *
    from vla_zenoh.policy.spec import *

__getattr__ = lazy_names(__name__, "spec", "inference")
