"""Wires of the policy servers: modules of the models that query them."""

from __future__ import annotations

from vla_zenoh.policy.loader import find_model, import_model

for _name in ("groot", "lerobot_server", "openpi", "openvla_rest", "origami", "xpolicylab"):
    import_model(find_model(_name))

from vla_zenoh_model_groot import npy  # noqa: E402
from vla_zenoh_model_groot import wire as groot  # noqa: E402
from vla_zenoh_model_lerobot_server import pickles  # noqa: E402
from vla_zenoh_model_lerobot_server import wire as lerobot_server  # noqa: E402
from vla_zenoh_model_openpi import wire as openpi  # noqa: E402
from vla_zenoh_model_openvla_rest import wire as openvla_rest  # noqa: E402
from vla_zenoh_model_origami import wire as origami  # noqa: E402
from vla_zenoh_model_xpolicylab import wire as xpolicylab  # noqa: E402

__all__ = [
    "groot",
    "lerobot_server",
    "npy",
    "openpi",
    "openvla_rest",
    "origami",
    "pickles",
    "xpolicylab",
]
