"""Meaning of a data set's unnormalised numbers: as known, or as set by options."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from vla_zenoh_model_openvla.statistics import AXES, Range
from vla_zenoh_policy_servers.action_semantics import ActionSemantics, read_action_semantics
from vla_zenoh_policy_servers.presets import ADDED, OSC

from vla_zenoh.errors import WorkerError

USUAL: Mapping[str, str] = {
    "action": "delta",
    "rotation": "rpy",
    "gripper": "open_fraction",
    "gripper_open": "high",
}
"""Units that OpenVLA's own data sets were converted to: metres and radians."""
DATA: Mapping[str, Mapping[str, str]] = {
    "bridge_orig": {**ADDED, "dt_s": "0.2"},
    "fractal20220817_data": {"dt_s": "0.333333"},
    "libero": OSC,
}
"""Known meanings of data sets, by the beginning of their names. LIBERO's statistics are in the
units of its controller. For others the options must set `dt_s` (a delta at another rate is another
speed), and what a delta is added to."""
LONGEST_STEP_M = 0.5
"""No arm goes further in a step of its data: larger numbers are not metres."""


def data_meaning(told: Mapping[str, str], key: str, trained: Range, chunk: int) -> ActionSemantics:
    """Meaning of the numbers of the data set `key`, as set and as known.

    Args:
        told: options of the user, see `vla_zenoh_policy_servers.action_semantics`.
        key: of the data set.
        trained: range of its actions.
        chunk: steps in an answer of the model.

    Raises:
        SpecError: an option is invalid, or missing.
        WorkerError: the options do not give `AXES` numbers, ask for more steps than a chunk has, or
            leave open the unit of statistics that cannot be metres.
    """
    data = next((known for begin, known in DATA.items() if key.startswith(begin)), {})
    known = {**USUAL, **data, "horizon": str(chunk)}
    if told.get("action", "").startswith("joint"):
        raise WorkerError("action: joints are not read by this worker; use delta or absolute")
    found = read_action_semantics(told, known, f"data set {key!r}", normalisation=key)
    parts = found.parts()
    if sum(parts.values()) != AXES:
        wanted = " + ".join(f"{name} {count}" for name, count in parts.items())
        raise WorkerError(f"an action has {AXES} numbers, {wanted} are {sum(parts.values())}")
    if found.spec.horizon > chunk:
        raise WorkerError(f"horizon is {found.spec.horizon}; the model's chunks have {chunk}")
    longest = float(np.abs([trained.low[:3], trained.high[:3]]).max())
    if found.action == "delta" and longest * found.units.position_scale_m > LONGEST_STEP_M:
        raise WorkerError(
            f"data set {key!r} has steps of {longest:.3g}, which are no metres. Say what one unit "
            "is with --set position_scale_m= and --set rotation_scale_rad= (robosuite's and "
            "LIBERO's controller: 0.05, 0.5 and rotation=rotvec)"
        )
    return found
