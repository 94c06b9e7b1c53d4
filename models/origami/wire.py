"""origami-zenoh-v1: a policy that answers Zenoh queries, msgpack with arrays in openpi's form.

Three queryables, ``metadata``, ``reset`` and ``infer``. A request is ``{protocol_version,
operation, request_id, session_id, observation?}``; the answer repeats the first four and adds
``metadata``, ``ok: true``, or ``actions`` (T, 65) with ``server_timing``; an error is ``{code,
message, retryable}`` under ``error``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from vla_zenoh_policy_servers import message
from vla_zenoh_policy_servers.field_mapping import FieldMapping
from vla_zenoh_policy_servers.presets import Presets

from vla_zenoh.errors import CodecError, PeerError
from vla_zenoh.types import shown

PROTOCOL = "origami-zenoh-v1"
Operation = Literal["metadata", "reset", "infer"]
ENCODING = "application/msgpack"
PRESETS: Presets = {
    "north_right": {
        "map": "observation/image/head_left=camera:front, "
        "observation/image/head_right=camera:front, "
        "observation/image/wrist_left=blank:224x224, observation/image/wrist_right=camera:wrist, "
        "observation/state=zero*29+joint+zero*29, observation/state/joint_torque=zero*65, "
        "observation/tactile=zero*60, observation/image/tactile_deform=blank:480x1200, "
        "prompt=prompt",
        "resize": "stretch",
        "columns": "29:36",
        "action": "joint_position",
        "joint_scale_rad": "1",
        "gripper": "none",
        "dt_s": "0.1",
        "horizon": "25",
    },
}
"""The right arm of the competition's two-armed robot; everything else is sent as zero. Its rate is
not published: set dt_s."""


def request(
    operation: Operation,
    request_id: str,
    session_id: str,
    observation: Mapping[str, Any] | None = None,
) -> bytes:
    """A request; `observation` for ``infer`` only."""
    asked: dict[str, Any] = {
        "protocol_version": PROTOCOL,
        "operation": operation,
        "request_id": request_id,
        "session_id": session_id,
    }
    if observation is not None:
        asked["observation"] = dict(observation)
    return message.pack(asked)


def read_answer(payload: bytes, operation: Operation, request_id: str) -> Any:
    """The requested result: the metadata, True, or the actions.

    Raises:
        PeerError: it is an error, belongs to another request, or cannot be read.
    """
    try:
        answer = message.unpack(payload)
    except CodecError as error:
        raise PeerError("peer_reply", f"the answer cannot be read: {error}") from error
    if not isinstance(answer, dict):
        raise PeerError("peer_reply", f"the answer is no map: {shown(answer)}")
    if "error" in answer:
        said = answer["error"]
        said = said if isinstance(said, dict) else {"message": said}
        raise PeerError(
            "peer_error",
            f"the server says {shown(said.get('code', ''))}: {shown(said.get('message', ''))}",
        )
    expected = {"protocol_version": PROTOCOL, "operation": operation, "request_id": request_id}
    for name, value in expected.items():
        if answer.get(name) != value:
            raise PeerError(
                "peer_reply", f"{name} of the answer is {shown(answer.get(name))}, not {value!r}"
            )
    part = {"metadata": "metadata", "reset": "ok", "infer": "actions"}[operation]
    if part not in answer or (operation == "reset" and answer["ok"] is not True):
        raise PeerError("peer_reply", f"the answer to {operation} has no {part}")
    return answer[part]


def mismatches(metadata: Any, mapping: FieldMapping) -> list[str]:
    """Contradictions between the server's metadata and the layout, one sentence each."""
    if not isinstance(metadata, dict):
        return [f"its metadata is no map: {shown(metadata)}"]
    out = mapping.wrong_columns(metadata.get("action_dim"))
    kind, units, action = (
        metadata.get("action_type"),
        metadata.get("action_units"),
        mapping.semantics,
    )
    if kind == "absolute_joint_position":
        if action.action != "joint_position":
            out.append(f"its actions are joint positions, action={action.action} is set")
        if units not in (None, "radians"):
            out.append(f"its joints are in {shown(units)}, wanted radians")
    elif isinstance(kind, str) and action.needs_joints:
        out.append(f"its actions are {kind}, action={action.action} is set")
    return out
