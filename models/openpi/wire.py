"""openpi's wire: msgpack over WebSocket, one binary frame a request, one a reply, in turn.

A server sends first: a map that describes it, which may be empty. An observation is a map of names,
an answer a map with ``actions`` (H, D). An error is a text frame, after which the connection is
closed. ``GET /healthz`` is answered with ``OK``.

vllm-omni serves the same with additions: ``{"endpoint": "reset"}``, a ``session_id`` in every
observation, answers that are a bare array, and errors that are a map with ``type: error``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vla_zenoh_policy_servers import message
from vla_zenoh_policy_servers.field_mapping import FieldMapping
from vla_zenoh_policy_servers.presets import ADDED, OSC, STATE8, Presets

from vla_zenoh.errors import CodecError, PeerError
from vla_zenoh.types import shown

PORT = 8000
VLLM_PATH = "/v1/realtime/robot/openpi"
MAX_BYTES = message.MAX_PAYLOAD_BYTES
MAX_ERROR = 400
SPEC = "vla_zenoh_action"
"""Where our servers declare the meaning of their actions."""
TAKES_COMMITTED = "vla_zenoh_takes_committed"
"""Where our servers declare that their model takes the steps in execution."""
COMMITTED = "vla_zenoh_committed"
"""Field of an observation: the steps in execution, in the numbers of the server's answers."""

_OWN = {
    "size": "",
    "resize": "none",
    "action": "delta",
    **ADDED,
    "rotation": "rpy",
    "gripper": "absolute_m",
    "dt_s": "0.1",
    "horizon": "16",
}

PRESETS: Presets = {
    "libero": {
        "map": "observation/image=camera:front, observation/wrist_image=camera:wrist, "
        f"observation/state={STATE8}, prompt=prompt",
        **OSC,
        "gripper": "binary",
        "gripper_open": "low",
        "gripper_threshold": "0",
        "horizon": "10",
    },
    "droid": {
        "map": "observation/exterior_image_1_left=camera:front, "
        "observation/wrist_image_left=camera:wrist, observation/joint_position=joint, "
        "observation/gripper_position=gripper_closed, prompt=prompt",
        "action": "joint_delta",
        "anchor": "goal",
        "relative_to": "previous",
        "joint_scale_rad": "0.2",
        "clip": "1",
        "gripper": "binary",
        "gripper_open": "low",
        "dt_s": "0.0666667",
        "horizon": "8",
    },
    "own": {
        "map": "observation/front=camera:front, observation/pose=position+quat_xyzw, "
        "observation/gripper=gripper_m, prompt=prompt",
        **_OWN,
    },
}


def request(fields: Mapping[str, Any], session: str | None = None) -> bytes:
    """One observation; `session` only for servers that know it."""
    extra = {} if session is None else {"session_id": session}
    return message.pack({**fields, **extra})


def reset_request() -> bytes:
    """An episode begins; for vllm-omni and our servers."""
    return message.pack({"endpoint": "reset"})


def read_metadata(frame: bytes | str) -> dict[str, Any]:
    """The first frame of a server.

    Raises:
        PeerError: it is an error, or no map.
    """
    found = _read(frame)
    if not isinstance(found, dict):
        raise PeerError("peer_reply", f"the server's first frame is no map: {shown(found)}")
    return found


def read_answer(frame: bytes | str) -> Any:
    """A reply: a map with arrays, or an array.

    Raises:
        PeerError: it is an error, or neither.
    """
    answer = _read(frame)
    if isinstance(answer, dict) and isinstance(answer.get("actions"), dict):
        answer = answer["actions"]
    return answer


def read_reset(frame: bytes | str) -> None:
    """The reply to a reset, as text or as a map.

    Raises:
        PeerError: it did not succeed.
    """
    if isinstance(frame, str) and "success" in frame[:MAX_ERROR]:
        return
    _read(frame)


def _read(frame: bytes | str) -> Any:
    if isinstance(frame, str):
        lines = [line for line in frame.strip().splitlines() if line.strip()]
        # A traceback says what happened in its last line.
        raise PeerError("peer_error", f"the server says: {(lines or [''])[-1][:MAX_ERROR]}")
    try:
        found = message.unpack(frame)
    except CodecError as error:
        raise PeerError("peer_reply", f"the server's frame cannot be read: {error}") from error
    if isinstance(found, dict) and found.get("type") == "error":
        said = found.get("message", found.get("error"))
        raise PeerError("peer_error", f"the server says: {shown(said)}")
    return found


def mismatches(metadata: Mapping[str, Any], mapping: FieldMapping) -> list[str]:
    """Contradictions between the server's description and the layout, one sentence each.

    openpi's own server does not describe its actions; vllm-omni's and ours do.
    """
    out = mapping.wrong_columns(metadata.get("action_dim"))
    space = metadata.get("action_space")
    if isinstance(space, str) and space.startswith("joint") is not mapping.semantics.needs_joints:
        out.append(f"its action_space is {space}, action={mapping.semantics.action} is set")
    size = metadata.get("image_resolution")
    if isinstance(size, list) and len(size) == 2:
        for camera in mapping.spec.observation.cameras:
            if camera.height is not None and [camera.height, camera.width] != size:
                out.append(
                    f"it wants images of {size[1]}x{size[0]}, size="
                    f"{camera.width}x{camera.height} is set"
                )
                break
    theirs = metadata.get(SPEC)
    if isinstance(theirs, dict):
        ours = mapping.spec.action.model_dump(mode="json")
        out += [
            f"its {name} is {shown(theirs[name])}, {shown(ours[name])} is set"
            for name in _MEANING
            if name in theirs and theirs[name] != ours[name]
        ]
    return out


_MEANING = (
    "kind",
    "frame",
    "anchor",
    "relative_to",
    "controller",
    "rotation",
    "gripper",
    "gripper_open_is_high",
    "dt_s",
)
