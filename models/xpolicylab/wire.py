"""XPolicyLab's wire: msgpack over WebSocket, arrays as msgpack-numpy writes them.

A frame is ``{message_type, message_id, evaluation_id, action_case_id, trial_id, repeat_index, step,
sent_at, payload}``; the answer repeats all but the type and the payload. An environment sends

================  ====================  ======================================================
``hello``         ``hello_ack``         on every connection
``prepare_case``  ``prepare_case_ack``  before the first trial of a case
``reset``         ``reset_result``      a trial begins
``infer``         ``infer_result``      ``{observation}`` -> ``{actions, latency_ms}``
``trial_end``     ``trial_end_ack``     a trial is over
``heartbeat``     ``heartbeat_ack``     is the server alive? Not used here: WebSocket shows it
================  ====================  ======================================================

or gets ``error`` with ``{code, message, details}``. A frame that the server cannot read has no
answer. An observation is nested (``vision/cam_head/color``, ``state/arm_joint_state``,
``instruction``); actions are a list of maps, one for each step, with the names of the state. Poses
are x, y, z, then the quaternion w, x, y, z. Neither the unit of a joint nor that of a gripper is
part of the format.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

import numpy as np
from vla_zenoh_policy_servers import message
from vla_zenoh_policy_servers.field_mapping import FieldMapping
from vla_zenoh_policy_servers.presets import Presets

from vla_zenoh.errors import CodecError, PeerError, SpecError
from vla_zenoh.types import shown

PORT = 19000
MAX_BYTES = message.MAX_PAYLOAD_BYTES
FORMAT = "v1.0"
Request = Literal["hello", "prepare_case", "reset", "infer", "trial_end"]
ANSWERS: Mapping[Request, str] = {
    "hello": "hello_ack",
    "prepare_case": "prepare_case_ack",
    "reset": "reset_result",
    "infer": "infer_result",
    "trial_end": "trial_end_ack",
}
_SEEN = (
    "vision/cam_head/color=camera:front, vision/cam_wrist/color=camera:wrist, instruction=prompt"
)

PRESETS: Presets = {
    "joint": {
        "map": _SEEN,
        "size": "",
        "keys": "arm_joint_state,ee_joint_state",
        "action": "joint_position",
    },
    "pose": {
        "map": f"{_SEEN}, state/ee_pose=position+quat_wxyz",
        "size": "",
        "keys": "ee_pose,ee_joint_state",
        "action": "absolute",
        "rotation": "quat_wxyz",
    },
}
"""One arm, by its action type. The format leaves the rest open, so options must set it."""


@dataclass(frozen=True, slots=True)
class Place:
    """Place of a request in an evaluation.

    Args:
        evaluation_id: of all requests of one client.
        action_case_id: of the case; empty: none.
        trial_id: of the trial; empty: none has begun.
        step: requests of the trial before this one.
    """

    evaluation_id: str
    action_case_id: str = ""
    trial_id: str = ""
    step: int = 0


def check_names(mapping: FieldMapping, *, whole: bool) -> None:
    """Names of values hold no others; with `whole`, each part of an answer is in the state too.

    Raises:
        SpecError: says what is wrong, or missing.
    """
    names = set(mapping.fields)
    outer = {name[:at] for name in names for at, char in enumerate(name) if char == "/"}
    if wrong := sorted(outer & names) or [name for name in names if not all(name.split("/"))]:
        raise SpecError(f"map: {wrong[0]!r} is no value of its own; a name is as state/ee_pose")
    missing = [f"state/{key}" for key in mapping.keys if f"state/{key}" not in names]
    if whole and missing:
        raise SpecError(
            "what the state holds is missing: "
            + ", ".join(f"--set map={name}=(joint, gripper_open, ...)" for name in missing)
        )


# -- requests -------------------------------------------------------------------------------------
def request(kind: Request, message_id: str, place: Place, payload: Mapping[str, Any]) -> bytes:
    """A frame; `message_id` comes back with the answer."""
    return message.pack(
        {
            "message_type": kind,
            "message_id": message_id,
            "evaluation_id": place.evaluation_id,
            "action_case_id": place.action_case_id or None,
            "trial_id": place.trial_id or None,
            "repeat_index": None,
            "step": place.step,
            "sent_at": datetime.now(UTC).isoformat(),
            "payload": dict(payload),
        },
        _to_map,
    )


def observation(fields: Mapping[str, Any]) -> dict[str, Any]:
    """``observation`` of an infer: ``a/b/c`` is c in b in a."""
    out: dict[str, Any] = {"data_format_version": FORMAT}
    for name, value in fields.items():
        *outer, last = name.split("/")
        inner = out
        for part in outer:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return out


def _to_map(value: Any) -> dict[bytes, Any]:
    if not isinstance(value, np.ndarray):
        raise TypeError(f"{type(value).__name__} has no form on XPolicyLab's wire")
    data, dtype, shape = message.array_parts(value)
    return {b"nd": True, b"type": dtype, b"kind": b"", b"shape": shape, b"data": data}


# -- answers --------------------------------------------------------------------------------------
def read_answer(frame: bytes | str, kind: Request, message_id: str) -> dict[str, Any]:
    """The payload of an answer.

    Raises:
        PeerError: it is an error, belongs to another request, or cannot be read.
    """
    if isinstance(frame, str):
        raise PeerError("peer_reply", f"a text frame, wanted msgpack: {shown(frame)}")
    try:
        answer = message.unpack(frame, _from_map)
    except CodecError as error:
        raise PeerError("peer_reply", f"the answer cannot be read: {error}") from error
    payload = answer.get("payload") if isinstance(answer, dict) else None
    if not isinstance(payload, dict):
        raise PeerError("peer_reply", f"the answer is no frame with a payload: {shown(answer)}")
    if answer.get("message_id") != message_id:
        raise PeerError(
            "peer_reply",
            f"message_id of the answer is {shown(answer.get('message_id'))}, not {message_id!r}",
        )
    said = answer.get("message_type")
    if said == "error":
        code, why = payload.get("code", ""), payload.get("message", "")
        raise PeerError("peer_error", f"the server says {shown(code)}: {shown(why)}")
    if said != ANSWERS[kind]:
        raise PeerError("peer_reply", f"the answer to {kind} is {shown(said)}, not {ANSWERS[kind]}")
    return payload


def read_actions(payload: Mapping[str, Any]) -> Any:
    """Name -> (H, n), of a list of steps; any other value is returned unchanged.

    Raises:
        PeerError: there are no actions, or steps differ in their names or sizes.
    """
    if "actions" not in payload:
        raise PeerError("peer_reply", f"the answer has no actions; it has: {shown([*payload])}")
    steps = payload["actions"]
    if isinstance(steps, list) and not steps:
        raise PeerError("peer_reply", "the answer has no steps")
    if not isinstance(steps, list) or not isinstance(steps[0], dict):
        return steps
    if not all(isinstance(step, dict) and step.keys() == steps[0].keys() for step in steps):
        raise PeerError("peer_reply", f"steps with other names than {shown([*steps[0]])}")
    try:
        return {
            name: np.stack([np.atleast_1d(np.asarray(step[name])) for step in steps])
            for name in steps[0]
        }
    except (ValueError, TypeError, OverflowError) as error:
        raise PeerError("peer_reply", f"steps of different sizes: {error}") from error


def _from_map(value: dict[Any, Any]) -> Any:
    if b"nd" not in value:
        return value
    kind, shape = value.get(b"kind", b""), value.get(b"shape")
    if kind not in (b"", ""):
        raise CodecError("malformed", f"an array of kind {shown(kind)} is not carried")
    if value[b"nd"] is not True:  # a scalar has no shape
        return message.make_array(value.get(b"data"), value.get(b"type"), [])
    return message.make_array(value.get(b"data"), value.get(b"type"), shape)
