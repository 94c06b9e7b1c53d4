"""A model of ours in the form of openpi: metadata first, then an answer to each observation.

A new connection, a new prompt or a reset starts an episode. An error is told as text, and ends it.
For the clients see `models/openpi/wire.py`.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from vla_zenoh_policy_servers import message

from vla_zenoh.errors import CodecError, PeerError, SpecError, in_words
from vla_zenoh.policy import ActionSpec
from vla_zenoh.policy.inference import Committed
from vla_zenoh.types import shown
from vla_zenoh_serve.served_policy import ServedPolicy

PORT = 8000
HEALTH_PATH, STATUS_PATH = "/healthz", "/status"
MAX_BYTES = message.MAX_PAYLOAD_BYTES
SPEC = "vla_zenoh_action"
"""Where a server of ours says what its actions mean."""
TAKES_COMMITTED = "vla_zenoh_takes_committed"
"""Where a server of ours says that its model takes the steps in execution."""
COMMITTED = "vla_zenoh_committed"
"""Field of an observation: the steps in execution, see `read_committed`."""
RESET: Final = {"endpoint": "reset"}
"""Request that starts an episode, as vllm-omni takes it."""
MAX_ERROR = 1000
LOG = logging.getLogger("vla_zenoh.serve")


@dataclass(slots=True)
class Tally:
    """What clients asked and were told.

    Args:
        answered: requests that got actions.
        refused: the others, by reason.
        last: why the newest of them was refused.
    """

    answered: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    last: str = ""

    def summary(self) -> dict[str, Any]:
        """Plain values."""
        return {"answered": self.answered, "refused": dict(self.refused), "last_refused": self.last}


class OpenPiConversation:
    """One connection of an openpi client; `tally` counts what it asked."""

    def __init__(self, policy: ServedPolicy, tally: Tally) -> None:
        self._policy, self._tally = policy, tally
        self._prompt: str | None = None
        self._previous_ms: float | None = None

    def greeting(self) -> bytes:
        """What the model's numbers mean."""
        policy = self._policy
        return metadata(policy.spec.action, policy.described(), policy.takes_committed)

    def reply(self, frame: bytes | str) -> bytes | str:
        """The actions for an observation; text: why there are none."""
        began_s = time.monotonic()
        try:
            given = read_observation(frame)
            if given == RESET:
                self._prompt = None
                return message.pack({"status": "reset"})
            observation = self._policy.observe(given, time.time_ns())
            if observation.prompt != self._prompt:
                self._prompt = observation.prompt
                self._policy.reset()
            committed = read_committed(given, self._policy.spec.action)
            actions = self._policy.infer(observation, committed)
        except Exception as error:  # sent to the client as openpi does; it may reconnect
            known = isinstance(error, (PeerError, SpecError))
            LOG.warning("request rejected: %s", error if known else repr(error))
            self._tally.refused[error.reason if known else "model_failed"] += 1
            self._tally.last = in_words(error)[:MAX_ERROR]
            return self._tally.last
        self._tally.answered += 1
        answer = pack_answer(actions, (time.monotonic() - began_s) * 1e3, self._previous_ms)
        self._previous_ms = (time.monotonic() - began_s) * 1e3
        return answer


# -- frames ---------------------------------------------------------------------------------------
def metadata(action: ActionSpec, names: Mapping[str, str], takes_committed: bool = False) -> bytes:
    """The first frame of a server of ours; `names`: of an observation, with their contents."""
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


def pack_answer(actions: Any, infer_ms: float, previous_ms: float | None) -> bytes:
    """One reply of a server of ours; `previous_ms`: the whole request before this one took."""
    timing = {"infer_ms": infer_ms}
    if previous_ms is not None:
        timing["prev_total_ms"] = previous_ms
    return message.pack({"actions": actions, "server_timing": timing})
