"""Makes the parts of the OpenVLA worker importable, as its own files import each other."""

from __future__ import annotations

from vla_zenoh.policy.loader import find_model, import_model

import_model(find_model("openvla"))
