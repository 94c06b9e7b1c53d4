"""Score of a trial: success rates of its workers, and their paired difference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from vla_zenoh_benchmarks.statistics import Paired, paired, wilson_95

from vla_zenoh_trial.plan import TrialPlan
from vla_zenoh_trial.verdict import INTERVENTIONS, EpisodeVerdict


@dataclass(frozen=True, slots=True)
class WorkerScore:
    """Score of one worker; void episodes count in `void` alone.

    Args:
        wilson_95: interval of the success rate.
        time_to_success_s: median; None: no success.
        interventions: episodes ended by an emergency stop or another client.
    """

    worker: str
    successes: int
    episodes: int
    wilson_95: tuple[float, float]
    time_to_success_s: float | None
    brakes: int
    interventions: int
    void: int

    @property
    def rate(self) -> float | None:
        """Share of successes; None: no episode."""
        return self.successes / self.episodes if self.episodes else None


@dataclass(frozen=True, slots=True)
class TrialScore:
    """Score of a trial. `paired`: setups that both of two workers did; None: not two workers."""

    workers: tuple[WorkerScore, ...]
    paired: Paired | None
    done: int
    of: int


def score(plan: TrialPlan, episodes: Sequence[EpisodeVerdict]) -> TrialScore:
    """Score of the verdicts so far."""
    is_judged = [each for each in episodes if each.verdict != "void"]
    workers = tuple(_of(worker, episodes) for worker in plan.workers)
    both = _both(plan, is_judged) if len(plan.workers) == 2 else None
    return TrialScore(workers, both, len(is_judged), plan.episodes)


def _of(worker: str, episodes: Sequence[EpisodeVerdict]) -> WorkerScore:
    own = [each for each in episodes if each.worker == worker]
    is_judged = [each for each in own if each.verdict != "void"]
    times_s = [each.time_s for each in is_judged if each.verdict == "success"]
    return WorkerScore(
        worker,
        len(times_s),
        len(is_judged),
        wilson_95(len(times_s), len(is_judged)),
        median(times_s) if times_s else None,
        sum(each.brakes for each in is_judged),
        sum(each.end in INTERVENTIONS for each in is_judged),
        len(own) - len(is_judged),
    )


def _both(plan: TrialPlan, is_judged: Sequence[EpisodeVerdict]) -> Paired:
    succeeded = {(each.setup, each.worker): each.verdict == "success" for each in is_judged}
    one, other = plan.workers
    return paired(
        (succeeded[setup, one], succeeded[setup, other])
        for setup in range(1, len(plan.setups) + 1)
        if (setup, one) in succeeded and (setup, other) in succeeded
    )
