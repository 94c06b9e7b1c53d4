"""GR00T's wire: msgpack over ZeroMQ REQ/REP, arrays as .npy files.

A request is ``{endpoint, data, api_token?}``; endpoints are ``ping``, ``get_action``, ``reset`` and
``get_modality_config``. An array is ``{__ndarray_class__: True, as_npy: bytes}``. Two shapes exist:

=======  =======================================================  ===========================
         ``data`` of ``get_action``                               answer
=======  =======================================================  ===========================
n1.5     ``{"video.NAME": (T,H,W,3), "state.NAME": (T,D),         ``{"action.NAME": (H,D)}``
         "annotation...": [text]}``
n1.6     ``{observation: {video: {NAME: (B,T,H,W,3)}, state:      ``[{NAME: (B,H,D)}, info]``
         {NAME: (B,T,D)}, language: {NAME: [[text]]}}, options}``
=======  =======================================================  ===========================

Early servers, and some derived ones, send torch's files instead, which are pickles and run code
when read; they are rejected.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from vla_zenoh_model_groot import npy
from vla_zenoh_policy_servers import message
from vla_zenoh_policy_servers.field_mapping import FieldMapping
from vla_zenoh_policy_servers.presets import BRIDGE, OPENS_AT_1, OSC, Presets

from vla_zenoh.errors import CodecError, PeerError
from vla_zenoh.types import shown

Version = Literal["n1.5", "n1.6"]
PORT = 5555
MAX_BYTES = message.MAX_PAYLOAD_BYTES
VIDEO, STATE, ACTION = "video.", "state.", "action."
_ARRAY, _CONFIG = "__ndarray_class__", "__ModalityConfig_class__"
_PICKLES = (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05", b"PK\x03\x04")

PRESETS: Presets = {
    "libero": {
        "map": "video.image=camera:front, video.wrist_image=camera:wrist, state.x=x, state.y=y, "
        "state.z=z, state.roll=rx, state.pitch=ry, state.yaw=rz, state.gripper=fingers_m, "
        "annotation.human.action.task_description=prompt",
        "size": "256x256",
        "keys": "x,y,z,roll,pitch,yaw,gripper",
        **OSC,
        **OPENS_AT_1,
        "horizon": "16",
    },
    "bridge": {
        "map": "video.image_0=camera:front, state.x=x, state.y=y, state.z=z, state.roll=roll, "
        "state.pitch=pitch, state.yaw=yaw, state.pad=zero, state.gripper=gripper_open, "
        "annotation.human.action.task_description=prompt",
        "size": "256x256",
        "keys": "x,y,z,roll,pitch,yaw,gripper",
        **BRIDGE,
        "horizon": "8",
    },
}


def pack(value: Any) -> bytes:
    """Maps, lists, text, numbers and arrays."""

    def as_map(array: Any) -> Any:
        if isinstance(array, np.ndarray):
            return {_ARRAY: True, "as_npy": npy.dump(array)}
        raise TypeError(f"{type(array).__name__} has no form on GR00T's wire")

    return message.pack(value, as_map)


def unpack(payload: bytes) -> Any:
    """Inverse of `pack`; a modality's description becomes a plain map.

    Raises:
        PeerError: the bytes are anything else.
    """
    if payload.startswith(_PICKLES):
        raise PeerError(
            "peer_reply",
            "the server sends torch's or Python's pickles, which run code when they are read; they "
            "are never read: use a server that speaks msgpack (GR00T N1.5 or later)",
        )
    try:
        return message.unpack(payload, _from_map)
    except CodecError as error:
        raise PeerError("peer_reply", f"the answer cannot be read: {error}") from error


def _from_map(value: dict[Any, Any]) -> Any:
    if _ARRAY in value:
        return npy.load(value.get("as_npy"))
    if _CONFIG in value:
        described = value.get("as_json")
        if isinstance(described, str):  # N1.5 writes JSON within
            try:
                described = json.loads(described)
            except (ValueError, RecursionError) as error:
                raise PeerError("peer_reply", "a modality that is not JSON") from error
        if not isinstance(described, dict):
            raise PeerError("peer_reply", f"a modality that is no map: {shown(described)}")
        return described
    return value


# -- requests -------------------------------------------------------------------------------------
def request(endpoint: str, data: Any = None, token: str = "") -> bytes:
    """A request; without `data` where the endpoint takes none."""
    asked: dict[str, Any] = {"endpoint": endpoint}
    if data is not None:
        asked["data"] = data
    if token:
        asked["api_token"] = token
    return pack(asked)


def observation(fields: Mapping[str, Any], version: Version) -> dict[str, Any]:
    """``data`` of get_action.

    Args:
        fields: ``video.NAME`` (H, W, 3), ``state.NAME`` (D,), any other name: text.
        version: which shape.
    """
    if version == "n1.5":
        return {
            name: [value] if isinstance(value, str) else np.ascontiguousarray(value)[None]
            for name, value in fields.items()
        }
    nested: dict[str, dict[str, Any]] = {"video": {}, "state": {}, "language": {}}
    for name, value in fields.items():
        if isinstance(value, str):
            nested["language"][name] = [[value]]
        else:
            kind = "video" if name.startswith(VIDEO) else "state"
            short = name.removeprefix(f"{kind}.")
            nested[kind][short] = np.ascontiguousarray(value)[None, None]
    return {"observation": nested, "options": None}


def reset_data(version: Version) -> Any:
    """``data`` of reset; N1.5 has no such endpoint."""
    return {"options": None} if version == "n1.6" else None


# -- answers --------------------------------------------------------------------------------------
def read_answer(payload: bytes) -> Any:
    """An answer that is not an error.

    Raises:
        PeerError: it is an error, or cannot be read.
    """
    if payload == b"ERROR":
        raise PeerError("peer_error", "the server says ERROR; is it the right kind of server?")
    answer = unpack(payload)
    if isinstance(answer, dict) and "error" in answer:
        raise PeerError("peer_error", f"the server says: {shown(answer['error'])}")
    return answer


def read_actions(payload: bytes) -> dict[str, Any]:
    """Name (without ``action.``) -> array, of either shape.

    Raises:
        PeerError: it is an error, or has another form.
    """
    answer = read_answer(payload)
    if isinstance(answer, list) and len(answer) == 2:
        answer = answer[0]
    if not isinstance(answer, dict):
        raise PeerError("peer_reply", f"the answer is no map of actions: {shown(answer)}")
    return {str(name).removeprefix(ACTION): value for name, value in answer.items()}


def mismatches(modalities: Any, mapping: FieldMapping) -> list[str]:
    """Differences between the server's modalities and the layout, one sentence each."""
    if not isinstance(modalities, dict):
        return []
    out: list[str] = []
    for kind, prefix in (("video", VIDEO), ("state", STATE)):
        asked = _names(modalities, kind, prefix)
        given = {name.removeprefix(prefix) for name in mapping.fields if name.startswith(prefix)}
        if asked is None:
            continue
        if asked - given:
            out.append(f"it wants {kind} {', '.join(sorted(asked - given))}; add it to map=")
        if given - asked:
            out.append(f"it does not know {kind} {', '.join(sorted(given - asked))}; see map=")
        times = modalities[kind].get("delta_indices")
        if isinstance(times, list) and len(times) != 1:
            out.append(f"it wants {len(times)} {kind} entries in time, only the newest is sent")
    gives = _names(modalities, "action", ACTION)
    if gives is not None and set(mapping.keys) - gives:
        missing = ", ".join(sorted(set(mapping.keys) - gives))
        out.append(f"it gives no action {missing}, but {', '.join(sorted(gives))}; see keys=")
    language = _names(modalities, "language", "")
    prompts = {name for name, source in mapping.fields.items() if source.prompt}
    if language is not None and language != prompts:
        out.append(f"its prompt is called {', '.join(sorted(language))}; see map=")
    return out


def _names(modalities: Mapping[str, Any], kind: str, prefix: str) -> set[str] | None:
    described = modalities.get(kind)
    keys = described.get("modality_keys") if isinstance(described, dict) else None
    if not isinstance(keys, list):
        return None
    return {str(key).removeprefix(prefix) for key in keys}
