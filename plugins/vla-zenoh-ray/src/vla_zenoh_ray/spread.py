"""Spreads the observations of a moment over replicas, and asks again where one is lost or slow.

No Ray here: `Spread` is given a function that asks some replica and waits.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from typing import Any

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy import ActionSteps, Observation

REMEMBERED = 10
LEAST_PATIENCE_S = 0.1
"""No replica is given up sooner: Ray's own way and a busy computer take some of it."""
SLOWER = 2.0
"""Times as long as the slowest of the last answers, before another replica is asked as well."""
GIVE_UP = 5.0
"""Times that patience, until the observation is too old to be answered."""
FIRST_PATIENCE_S = 60.0
"""Before anything was answered: models compile and fill caches with their first inference."""
PACE_S = 0.02
"""Between two requests for the same observations, where replicas are lost one after the other."""

Ask = Callable[[Sequence[Observation], Sequence[Any] | None], list[ActionSteps]]


@dataclass
class _Part:
    """Observations that one replica is asked for at once."""

    numbers: list[int]
    asked: int = 0
    next_s: float = 0.0
    found: list[ActionSteps] | None = None
    lost: str = ""
    began_s: dict[Any, float] = field(default_factory=dict)


class Spread:
    """See the module.

    Args:
        ask: asks one replica and waits for its answers; called from several threads.
        replicas: among how many observations are shared out.
        lost: exceptions of `ask` which say that a replica is gone, not that the model failed.
    """

    def __init__(
        self, ask: Ask, replicas: int, lost: tuple[type[BaseException], ...] = (ConnectionError,)
    ) -> None:
        self._ask, self._replicas, self._lost = ask, replicas, lost
        self._took_s: deque[float] = deque(maxlen=REMEMBERED)
        # A request that hangs keeps its thread until it times out.
        self._threads = ThreadPoolExecutor(8 * replicas, thread_name_prefix="replica")
        self.asked_again = 0

    @property
    def patience_s(self) -> float:
        """How long one replica may take before another one is asked as well."""
        if not self._took_s:
            return FIRST_PATIENCE_S
        return max(LEAST_PATIENCE_S, SLOWER * max(self._took_s))

    def answers(
        self, observations: Sequence[Observation], committed: Sequence[Any] | None = None
    ) -> list[ActionSteps]:
        """One answer for each observation, in their order.

        Raises:
            WorkerError: no replica answered while the observations were worth an answer.
            Exception: that of the model.
        """
        count = min(self._replicas, len(observations))
        parts = [_Part(list(range(first, len(observations), count))) for first in range(count)]
        patience_s, now_s = self.patience_s, time.monotonic()
        give_up_s = now_s + GIVE_UP * patience_s
        pending: dict[Future[list[ActionSteps]], _Part] = {}
        try:
            while left := [part for part in parts if part.found is None]:
                now_s = time.monotonic()
                if now_s > give_up_s:
                    raise WorkerError(_silent(left, GIVE_UP * patience_s))
                for part in left:
                    if now_s >= part.next_s:
                        pending[self._begin(part, observations, committed)] = part
                        part.next_s = now_s + patience_s
                until_s = min(give_up_s, *(part.next_s for part in left))
                if not pending:  # all of them were lost; `wait` would return at once
                    time.sleep(max(0.0, until_s - now_s))
                    continue
                done, _ = wait(pending, max(0.0, until_s - now_s), FIRST_COMPLETED)
                for future in done:
                    self._take(future, pending.pop(future))
        finally:
            for future in pending:  # one that waits for a thread would ask for old observations
                future.cancel()
        out: dict[int, ActionSteps] = {}
        for part in parts:
            out.update(zip(part.numbers, part.found or (), strict=True))
        return [out[number] for number in range(len(observations))]

    def _begin(
        self, part: _Part, observations: Sequence[Observation], committed: Sequence[Any] | None
    ) -> Future[list[ActionSteps]]:
        self.asked_again += part.asked > 0
        part.asked += 1
        seen = [observations[number] for number in part.numbers]
        steps = None if committed is None else [committed[number] for number in part.numbers]
        future = self._threads.submit(self._ask, seen, steps)
        part.began_s[future] = time.monotonic()
        return future

    def _take(self, future: Future[list[ActionSteps]], part: _Part) -> None:
        if part.found is not None:
            return  # the other replica was sooner
        error = future.exception()
        if error is None:
            part.found = future.result()
            self._took_s.append(time.monotonic() - part.began_s[future])
        elif isinstance(error, self._lost):
            part.lost = f"{type(error).__name__}: {error}".splitlines()[0]
            part.next_s = time.monotonic() + PACE_S
        else:
            raise error

    def close(self) -> None:
        """Ask nothing any more."""
        self._threads.shutdown(wait=False, cancel_futures=True)


def _silent(parts: Sequence[_Part], after_s: float) -> str:
    why = next((f" ({part.lost})" for part in parts if part.lost), "")
    return (
        f"no replica has answered for {after_s:.1f} s{why}: `ray status` and `serve status` show "
        "what is left of the cluster"
    )
