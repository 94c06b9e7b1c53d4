"""A model of ours in the form of openpi: metadata first, then an answer to each observation.

A new connection, a new prompt or a reset starts an episode. An error is told as text, and ends it.
"""

from __future__ import annotations

import logging
import time

from vla_zenoh.errors import PeerError, SpecError, in_words
from vla_zenoh.lab.serve import openpi_frames
from vla_zenoh.lab.serve.served_policy import ServedPolicy

MAX_ERROR = 1000
LOG = logging.getLogger("vla_zenoh.serve")


class OpenPiConversation:
    """One connection of an openpi client.

    Args:
        policy: what is served.
    """

    def __init__(self, policy: ServedPolicy) -> None:
        self._policy = policy
        self._prompt: str | None = None
        self._previous_ms: float | None = None

    def greeting(self) -> bytes:
        """What the model's numbers mean."""
        policy = self._policy
        return openpi_frames.metadata(
            policy.spec.action, policy.described(), takes_committed=policy.takes_committed
        )

    def reply(self, frame: bytes | str) -> bytes | str:
        """The actions for an observation; text: why there are none."""
        began_s = time.monotonic()
        try:
            given = openpi_frames.read_observation(frame)
            if given == openpi_frames.RESET:
                self._prompt = None
                return openpi_frames.reset_done()
            observation = self._policy.observe(given, time.time_ns())
            if observation.prompt != self._prompt:
                self._prompt = observation.prompt
                self._policy.reset()
            committed = openpi_frames.read_committed(given, self._policy.spec.action)
            actions = self._policy.infer(observation, committed)
        except Exception as error:  # sent to the client as openpi does; it may reconnect
            why = error if isinstance(error, (PeerError, SpecError)) else repr(error)
            LOG.warning("request rejected: %s", why)
            return in_words(error)[:MAX_ERROR]
        answer = openpi_frames.answer(
            actions, (time.monotonic() - began_s) * 1e3, self._previous_ms
        )
        self._previous_ms = (time.monotonic() - began_s) * 1e3
        return answer
