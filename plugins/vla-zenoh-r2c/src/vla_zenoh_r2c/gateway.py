"""Answers a robot that speaks R2C with a model of ours: `Answers` on Zenoh.

Each observation is answered at most once. One that is refused gets no answer, as the wire has no
word for it: the robot asks again after its timeout, and the reason is counted and told here.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter

import zenoh

from vla_zenoh.bus.buffers import CallbackRing, LatestSample, bytes_of
from vla_zenoh.errors import CountedError, SpecError, VlaZenohError, in_words
from vla_zenoh_r2c import link, wire
from vla_zenoh_r2c.admission import Admission
from vla_zenoh_r2c.answer import Answers
from vla_zenoh_r2c.declared import DeclaredRobot

LOOK_S = 0.1
QUIET_S = 5.0
"""No answers for this long after somebody else's: the robot would execute both."""
TOLD_S = 5.0
"""A reason is told again after this time."""
LOG = logging.getLogger("vla_zenoh.r2c")


class Gateway:
    """Answers the observations of one robot.

    Args:
        session: at a router that the robot reaches, too.
        robot: as declared.
        answers: of the model.
    """

    def __init__(self, session: zenoh.Session, robot: DeclaredRobot, answers: Answers) -> None:
        self._answers, self._admission = answers, Admission(robot.max_age_s)
        self.counts: Counter[str] = Counter()
        """``answered``, and what was refused by reason."""
        self.answer_s = 0.0
        """The newest answer took this long."""
        self._told_s: dict[str, float] = {}
        self._quiet_until_s = 0.0
        self._asked = LatestSample(wire.MAX_BYTES)
        self._others = CallbackRing(8, wire.MAX_ACTION_BYTES)
        actions = wire.actions_key(robot.project, robot.device)
        link.listen(session, wire.observations_key(robot.project, robot.device), self._asked)
        link.listen(session, actions, self._others)
        self._replies = link.declare(session, actions)

    def run(self, stop: threading.Event) -> None:
        """Answer until `stop`."""
        while not stop.is_set():
            self._asked.wait(LOOK_S)
            self.look()

    def look(self) -> None:
        """Answer the newest observation, if one came."""
        for buffer in (self._asked, self._others):
            for each in buffer.pop_rejected():
                self._tell(each.reason, f"{each.key}: {each.why}", each.times)
        if others := self._others.drain():
            self._quiet_until_s = time.monotonic() + QUIET_S
            key = others[-1].sample.key_expr
            self._tell(
                "second_policy",
                f"somebody else answers on {key}: no answers of ours for {QUIET_S:g} s",
                len(others),
            )
        received = self._asked.pop()
        if received is None:
            return
        try:
            if time.monotonic() < self._quiet_until_s:
                self._tell("quiet", "an observation is left to the other policy")
                return
            self._answer(bytes_of(received.sample.payload, wire.MAX_BYTES))
        except VlaZenohError as error:
            counted = isinstance(error, (CountedError, SpecError))
            self._tell(error.reason if counted else "refused", str(error))
        except Exception as error:  # a model's: the next observation may suit it
            self._tell("model_failed", in_words(error))

    def _answer(self, payload: bytes) -> None:
        began_s = time.monotonic()
        seen = wire.decode_observation(payload)
        if self._admission.admit(seen, time.time() * 1e3, began_s):
            self._answers.reset()
            LOG.warning("the robot begins at observation %d", seen.id)
        steps = self._answers.answer(seen, round(time.time() * 1e3))
        if self._others.has_new:
            return  # told by the next look
        self._replies.put(wire.encode_actions(steps))
        self.answer_s = time.monotonic() - began_s
        self.counts["answered"] += 1

    def _tell(self, reason: str, why: str, times: int = 1) -> None:
        self.counts[reason] += times
        now_s = time.monotonic()
        if now_s - self._told_s.get(reason, float("-inf")) >= TOLD_S:
            self._told_s[reason] = now_s
            LOG.warning("%s (%d): %s", reason, self.counts[reason], why)
