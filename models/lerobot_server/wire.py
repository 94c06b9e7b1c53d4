"""The wire of lerobot's policy server: pickles within gRPC, service ``transport.AsyncInference``.

========================  ==========================================  ===========================
``Ready``                 empty                                       empty; the queue is emptied
``SendPolicyInstructions``  pickled ``RemotePolicyConfig``            empty, once it is loaded
``SendObservations``      pickled ``TimedObservation``, in parts      empty; it waits its turn
``GetActions``            empty                                       pickled ``[TimedAction]``
========================  ==========================================  ===========================

``GetActions`` is empty where inference failed, or nothing waited. The actions of one observation
carry its number, then those that follow.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from vla_zenoh_model_lerobot_server import pickles
from vla_zenoh_model_lerobot_server.pickles import Instance
from vla_zenoh_policy_servers import message
from vla_zenoh_policy_servers.field_mapping import FieldMapping
from vla_zenoh_policy_servers.presets import OSC, STATE8, Presets
from vla_zenoh_policy_servers.state_vector import size_of

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.types import shown

PORT = 8080
MAX_BYTES = message.MAX_PAYLOAD_BYTES
PART_BYTES = 2 * 1024 * 1024
"""Of an observation in one message; the server's own limit is 4 MiB."""
METHODS = "/transport.AsyncInference/"
POLICIES = ("act", "diffusion", "groot", "pi0", "pi05", "smolvla", "tdmpc", "vqbet")
STATE, PICTURES, TASK = "observation.state", "observation.images.", "task"
_BEGIN, _MIDDLE, _END = 1, 2, 3

PRESETS: Presets = {
    "libero": {
        "map": f"{PICTURES}image=camera:front, {PICTURES}image2=camera:wrist, {STATE}={STATE8}, "
        f"{TASK}=prompt",
        "size": "",
        **OSC,
        "gripper": "binary",
        "gripper_open": "low",
        "gripper_threshold": "0",
    },
}
"""Of policies trained on LIBERO as lerobot has it."""


# -- protobuf: one or two fields of each message --------------------------------------------------
def _field(number: int, data: bytes) -> bytes:
    size, left = bytearray(), len(data)
    while left > 0x7F:
        size.append(left & 0x7F | 0x80)
        left >>= 7
    size.append(left)
    return bytes((number << 3 | 2,)) + bytes(size) + data


def policy_setup(data: bytes) -> bytes:
    """A ``PolicySetup``."""
    return _field(1, data)


def observation_parts(data: bytes) -> Iterator[bytes]:
    """``Observation`` messages that the server puts together."""
    for start in range(0, len(data), PART_BYTES):
        last = start + PART_BYTES >= len(data)
        state = _END if last else _MIDDLE if start else _BEGIN
        yield bytes((0x08, state)) + _field(2, data[start : start + PART_BYTES])


def read_actions_message(payload: bytes) -> bytes:
    """``data`` of an ``Actions``; empty: there are none.

    Raises:
        PeerError: it is something else.
    """
    if not payload:
        return b""
    size = 0
    for at, byte in enumerate(payload[1:6]):
        size |= (byte & 0x7F) << 7 * at
        if byte < 0x80:
            data = payload[at + 2 :]
            if payload[0] == 0x0A and len(data) == size:
                return data
            break
    raise PeerError("peer_reply", f"the answer is no Actions message: {shown(payload)}")


# -- requests -------------------------------------------------------------------------------------
def features(mapping: FieldMapping, joints: int) -> dict[str, dict[str, Any]]:
    """What an observation holds, as lerobot describes a data set.

    Args:
        mapping: of the adapter.
        joints: how many the arm has.

    Raises:
        SpecError: a name that the server does not read, or no state.
    """
    out: dict[str, dict[str, Any]] = {}
    for name, source in mapping.fields.items():
        picture = source.camera or source.blank
        if picture and name.startswith(PICTURES) and name != PICTURES:
            axes = ["height", "width", "channels"]
            out[name] = {"dtype": "image", "shape": (0, 0, 3), "names": axes}
        elif source.parts and name == STATE:
            size = sum(size_of(part, joints) for part in source.parts)
            names = [f"state_{index}" for index in range(size)]
            out[name] = {"dtype": "float32", "shape": (size,), "names": names}
        elif not source.prompt or name != TASK:
            raise SpecError(
                f"map: {name!r} is not read by the server; an image is {PICTURES}NAME, the "
                f"state {STATE}, the prompt {TASK}"
            )
    if STATE not in out:
        raise SpecError(f"map: {STATE} is missing, which the server wants of every policy")
    return out


def policy_config(
    policy: str, checkpoint: str, device: str, described: Mapping[str, Any], steps: int
) -> bytes:
    """The policy that the server must load."""
    fields = {
        "policy_type": policy,
        "pretrained_name_or_path": checkpoint,
        "lerobot_features": dict(described),
        "actions_per_chunk": steps,
        "device": device,
        "rename_map": {},
    }
    return pickles.write(Instance(pickles.POLICY_CONFIG, fields))


def observation(fields: Mapping[str, Any], number: int, stamp_s: float) -> bytes:
    """One observation with a unique number."""
    seen: dict[str, Any] = {}
    for name, value in fields.items():
        if name == STATE:
            seen |= {f"state_{index}": float(one) for index, one in enumerate(value)}
        else:
            seen[name.removeprefix(PICTURES)] = value
    told = {"timestamp": stamp_s, "timestep": number, "observation": seen, "must_go": True}
    return pickles.write(Instance(pickles.TIMED_OBSERVATION, told))


# -- answers --------------------------------------------------------------------------------------
def read_actions(payload: bytes, number: int) -> Any:
    """Steps (H, D) for the observation with this number.

    Raises:
        PeerError: there are none, they belong to another one, or cannot be read.
    """
    data = read_actions_message(payload)
    if not data:
        raise PeerError(
            "peer_error", "the server gave no actions; its log says why (does map= fit the policy?)"
        )
    steps = pickles.read(data)
    if not isinstance(steps, list) or not 0 < len(steps) <= message.MAX_ITEMS:
        raise PeerError("peer_reply", f"the answer is no list of steps: {shown(steps)}")
    rows: list[Any] = []
    for index, step in enumerate(steps):
        fields = step.fields if isinstance(step, Instance) else {}
        action = fields.get("action")
        if not isinstance(action, np.ndarray):
            raise PeerError("peer_reply", f"step {index} of the answer has no action")
        if fields.get("timestep") != number + index:
            raise PeerError(
                "peer_reply",
                f"step {index} of the answer has the number {shown(fields.get('timestep'))}, not "
                f"{number + index}: it is that of another observation",
            )
        rows.append(action)
    if len({len(row) for row in rows}) != 1:
        raise PeerError("peer_reply", "steps of different sizes")
    return np.stack(rows)
