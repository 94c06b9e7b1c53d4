"""A model of ours in the form of vla-eval (0.8), so that its benchmarks can ask it.

Messages are msgpack maps ``{type, payload, seq, timestamp}`` of the types hello, observation,
action, episode_start, episode_end and error. An observation is answered with one action: a chunk is
inferred when the last one is used up. An error is answered as such, and the connection goes on.
Source: the package ``vla-eval``, ``vla_eval/protocol`` and ``vla_eval/model_servers/serve.py``.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh import __version__
from vla_zenoh.codec.image import decode_jpeg, decode_png
from vla_zenoh.errors import CodecError, PeerError, in_words
from vla_zenoh.lab.policy_servers import message
from vla_zenoh.lab.serve.served_policy import DefaultNames, ServedPolicy
from vla_zenoh.policy import ActionSpec
from vla_zenoh.types import shown

PORT = 8000
HEALTH_PATH = "/health"
PROTOCOL_VERSION = 1
NAMES = DefaultNames(camera="images/{}", state="states/{}", prompt="task_description")
_ROTATIONS = {"rpy": "euler_xyz", "rotvec": "axis_angle", "quaternion": "quaternion_xyzw"}
MAX_ERROR = 1000
LOG = logging.getLogger("vla_zenoh.serve")


class VlaEvalConversation:
    """One connection of a vla-eval harness.

    Args:
        execute: steps of each chunk that are given out before the next one is inferred; 0: all.
    """

    def __init__(self, policy: ServedPolicy, execute: int = 0) -> None:
        self._policy, self._execute = policy, execute
        self._left: deque[NDArray[np.float32]] = deque()
        self._begin()

    def greeting(self) -> None:
        """The harness begins."""

    def reply(self, frame: bytes | str) -> bytes | None:
        """The answer to a message; None: it wants none."""
        seq = 0
        try:
            kind, payload, seq = read_message(frame)
            if kind == "hello":
                return pack_message("hello", self._hello(), seq)
            if kind == "episode_start":
                self._begin()
            elif kind == "observation":
                return pack_message("action", {"actions": self._act(payload)}, seq)
        except Exception as error:
            LOG.warning("request rejected: %s", in_words(error))
            return pack_message("error", {"error": in_words(error)[:MAX_ERROR]}, seq)
        return None

    def _begin(self) -> None:
        self._left.clear()
        self._policy.reset()
        self._stamp_ns = time.time_ns()

    def _act(self, payload: Mapping[str, Any]) -> NDArray[np.float32]:
        if not self._left:
            observation = self._policy.observe(_flat(payload), self._stamp_ns)
            steps = self._policy.infer(observation, None)
            self._left.extend(steps[: self._execute or len(steps)])
        # A benchmark's time goes on with its steps, however long they take.
        self._stamp_ns += round(self._policy.spec.action.dt_s * 1e9)
        return self._left.popleft()

    def _hello(self) -> dict[str, Any]:
        return {
            "harness_version": f"vla-zenoh {__version__}",
            "protocol_version": PROTOCOL_VERSION,
            "model_server": self._policy.spec.name,
            "capabilities": {},
            "action_spec": action_spec(self._policy.spec.action),
        }


def action_spec(action: ActionSpec) -> dict[str, Any]:
    """Parts of an action by the names of vla-eval; its orchestrator warns where they differ.

    Nothing is said of what it has no name for.
    """
    if action.space != "tcp":
        return {}
    out: dict[str, Any] = {}
    position = {"delta": "delta_xyz", "absolute": "absolute_xyz"}.get(action.kind)
    if position is not None:
        out["position"] = {"name": "position", "dims": 3, "format": position}
    rotation = _ROTATIONS.get(action.rotation)
    if rotation is not None:
        out["rotation"] = {
            "name": "rotation",
            "dims": action.rotation_form.size,
            "format": rotation,
        }
    return out


def pack_message(kind: str, payload: Mapping[str, Any], seq: int) -> bytes:
    """A message of vla-eval."""
    fields = {name: _plain(value) for name, value in payload.items()}
    return message.pack({"type": kind, "payload": fields, "seq": seq, "timestamp": time.time()})


def _plain(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value
    shape = list(value.shape)
    return {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": shape}


def read_message(frame: bytes | str) -> tuple[str, dict[str, Any], int]:
    """Type, payload and number of a message.

    Raises:
        PeerError: it is none.
    """
    if isinstance(frame, str):
        raise PeerError("peer_request", "a text frame; messages are msgpack in binary frames")
    try:
        found = message.unpack(frame)
        if not isinstance(found, dict):
            raise PeerError("peer_request", f"a message is a map, not {shown(found)}")
        kind, payload, seq = (found.get(name) for name in ("type", "payload", "seq"))
        if not isinstance(kind, str) or not isinstance(payload, dict) or type(seq) is not int:
            raise PeerError("peer_request", f"no type, payload and seq in {shown(found)}")
        return kind, {name: _value(value) for name, value in payload.items()}, seq
    except CodecError as error:
        raise PeerError("peer_request", f"the message cannot be read: {error}") from error


def _value(value: Any) -> Any:
    """Arrays and images as arrays, in maps too."""
    if not isinstance(value, dict):
        return value
    if "__ndarray__" in value:
        return message.make_array(value.get("data"), value.get("dtype"), value.get("shape"))
    if "__image__" in value:
        return _image(value)
    return {name: _value(item) for name, item in value.items()}


def _image(value: Mapping[str, Any]) -> NDArray[np.uint8]:
    kind, data = value.get("format"), value.get("data")
    if kind == "raw":
        return _value({"__ndarray__": True, **value})
    if not isinstance(data, bytes) or kind not in ("jpeg", "png"):
        raise CodecError("malformed", f"an image of format {shown(kind)}; raw, png or jpeg")
    return (decode_jpeg if kind == "jpeg" else decode_png)(data).rgb


def _flat(payload: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """``{"images": {"wrist": a}}`` as ``{"images/wrist": a}``."""
    out: dict[str, Any] = {}
    for name, value in payload.items():
        if isinstance(value, Mapping):
            out |= _flat(value, f"{before}{name}/")
        else:
            out[f"{before}{name}"] = value
    return out
