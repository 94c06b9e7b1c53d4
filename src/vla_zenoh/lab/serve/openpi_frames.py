"""Frames of a server of openpi's protocol; for its clients see `models/openpi/wire.py`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError, PeerError
from vla_zenoh.policy import ActionSpec
from vla_zenoh.policy.chunk_prefix import Committed
from vla_zenoh.types import shown

PORT = 8000
HEALTH_PATH = "/healthz"
MAX_BYTES = message.MAX_PAYLOAD_BYTES
SPEC = "vla_zenoh_action"
"""Where a server of ours says what its actions mean."""
TAKES_COMMITTED = "vla_zenoh_takes_committed"
"""Where a server of ours says that its model takes the steps in execution."""
COMMITTED = "vla_zenoh_committed"
"""Field of an observation: the steps in execution, see `read_committed`."""
RESET: Final = {"endpoint": "reset"}
"""Request that starts an episode, as vllm-omni takes it."""


def metadata(
    action: ActionSpec, names: Mapping[str, str], *, takes_committed: bool = False
) -> bytes:
    """The first frame of a server of ours.

    Args:
        action: what its actions mean.
        names: name of an observation -> its content, as text.
        takes_committed: the model uses the steps in execution.
    """
    return message.pack(
        {
            "action_dim": action.dimension,
            "action_horizon": action.horizon,
            "observation": dict(names),
            SPEC: action.model_dump(mode="json"),
            TAKES_COMMITTED: takes_committed,
        }
    )


def read_observation(frame: bytes | str) -> dict[str, Any]:
    """One request to a server of ours.

    Raises:
        PeerError: it is no map that can be read.
    """
    if isinstance(frame, str):
        raise PeerError("peer_request", "a text frame; observations are msgpack in binary frames")
    try:
        found = message.unpack(frame)
    except CodecError as error:
        raise PeerError("peer_request", f"the frame cannot be read: {error}") from error
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found):
        raise PeerError("peer_request", f"an observation is a map of names, not {shown(found)}")
    return found


def read_committed(given: Mapping[str, Any], action: ActionSpec) -> Committed | None:
    """The steps in execution that an observation holds; None: none.

    Raises:
        PeerError: they are not ``{"steps": (K, D), "frozen": F}`` in the numbers of the answers.
    """
    found = given.get(COMMITTED)
    if found is None:
        return None
    steps = found.get("steps") if isinstance(found, dict) else None
    frozen = found.get("frozen") if isinstance(found, dict) else None
    if (
        not isinstance(steps, np.ndarray)
        or steps.dtype.kind != "f"
        or steps.ndim != 2
        or steps.shape[1] != action.dimension
        or not 1 <= len(steps) <= action.horizon
        or not np.isfinite(steps).all()
        or type(frozen) is not int
        or not 0 <= frozen <= len(steps)
    ):
        raise PeerError(
            "peer_request",
            f'{COMMITTED} is {shown(found)}, wanted {{"steps": array of floats (K, '
            f'{action.dimension}), "frozen": 0 to K}} with K from 1 to {action.horizon}',
        )
    return Committed(steps.astype(np.float32), frozen)


def answer(actions: Any, infer_ms: float, previous_ms: float | None) -> bytes:
    """One reply of a server of ours; `previous_ms`: the whole request before this one took."""
    timing = {"infer_ms": infer_ms}
    if previous_ms is not None:
        timing["prev_total_ms"] = previous_ms
    return message.pack({"actions": actions, "server_timing": timing})


def reset_done() -> bytes:
    """Reply to `RESET`."""
    return message.pack({"status": "reset"})
