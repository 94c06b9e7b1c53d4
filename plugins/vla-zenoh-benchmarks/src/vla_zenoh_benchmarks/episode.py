"""One episode of a benchmark: in lockstep with the model, or with a clock that does not wait."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import ActionChunk, FloatArray
from vla_zenoh_benchmarks.contract import (
    Benchmark,
    BenchmarkObservation,
    BenchmarkTask,
    standing_step,
)

Mode = Literal["native", "live", "command"]
Composition = Literal["replace", "blend", "ensemble"]
DISAGREEMENT = 0.7


@dataclass(frozen=True, slots=True)
class EpisodeConditions:
    """What is the same for every episode of a run.

    Args:
        mode: ``native``: the environment waits for the model, whose steps go into its own
            controller. ``live``: its clock runs on during inference, and the arm stands meanwhile.
            ``command``: it runs on too, and our command node is between model and environment.
        delay_ms: what an inference takes on the environment's clock; None: what it took.
        replan: steps to carry out of each chunk; 0: all.
        composition: of chunks that overlap, in mode ``command``: `composition.mode` of a profile.
        takeover: worker that leads from where it disagrees, in mode ``native``; empty: none.
        disagreement: see `Takeover`.
    """

    mode: Mode = "native"
    delay_ms: float | None = None
    replan: int = 0
    composition: Composition = "replace"
    takeover: str = ""
    disagreement: float = DISAGREEMENT


@dataclass(frozen=True, slots=True)
class EpisodeRequest:
    """An episode to run."""

    suite: str
    task: BenchmarkTask
    episode: int

    @property
    def key(self) -> str:
        """What tells it from all others of a run."""
        return f"{self.suite}/{self.task.name}/{self.episode}"


@dataclass(slots=True)
class EpisodeOutcome:
    """How an episode went.

    Args:
        ask_ms: time from an observation to its chunk, p50 and p95.
        end: hash of the simulation's state after the last step, empty: it does not tell.
        failure: empty, ``steps`` (the limit) or what the command node stopped for.
        attempts: how often it was begun; those before were lost with their process.
        taken_over_at: number of steps before another worker took over; None: none did.
    """

    suite: str
    task: str
    episode: int
    success: bool = False
    steps: int = 0
    chunks: int = 0
    wall_s: float = 0.0
    ask_ms: tuple[float, float] = (0.0, 0.0)
    end: str = ""
    failure: str = ""
    attempts: int = 1
    taken_over_at: int | None = None
    actions: list[FloatArray] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        return {k: v for k, v in asdict(self).items() if k != "actions"}


class Asked(Protocol):
    """Whom an episode asks for chunks, see `AskedWorker`."""

    spec: ModelSpec
    worker: str

    def begin(self, prompt: str) -> None: ...

    def ask(self, seen: BenchmarkObservation) -> ActionChunk: ...


class Recorder(Protocol):
    """Who keeps what happens in an episode, see `EpisodeRecorder`."""

    cameras: Sequence[str]

    def begin(self, prompt: str) -> None: ...

    def taken_over(self, worker: str, spec: ModelSpec, step: int) -> None: ...

    def chunk(self, chunk: ActionChunk, step: int) -> None: ...

    def saw(self, seen: BenchmarkObservation, step: int) -> None: ...

    def moved(self, seen: BenchmarkObservation, action: FloatArray, step: int) -> None: ...


class EpisodeClock:
    """The environment in an episode: its steps, their limit, and what they led to.

    Args:
        recorder: who keeps every step; None: nobody.
    """

    def __init__(
        self,
        benchmark: Benchmark,
        request: EpisodeRequest,
        worker: Asked,
        recorder: Recorder | None = None,
    ) -> None:
        self.benchmark, self.request, self.worker = benchmark, request, worker
        self.recorder = recorder
        self.spec = worker.spec
        self.cameras = [one.camera for one in self.spec.observation.cameras]
        self.outcome = EpisodeOutcome(request.suite, request.task.name, request.episode)
        self._asked_ms: list[float] = []
        self._last: FloatArray | None = None

    @property
    def over(self) -> bool:
        return self.outcome.success or self.outcome.steps >= self.request.task.max_steps

    def ask(self) -> NDArray[np.float32]:
        """Steps for what is to see now, in the model's units."""
        began_s = time.perf_counter()
        chunk = self.worker.ask(self.benchmark.observe(self.cameras))
        self._asked_ms.append((time.perf_counter() - began_s) * 1e3)
        self.heard(chunk)
        return chunk.steps

    def heard(self, chunk: ActionChunk) -> None:
        """A chunk came for what is to see now."""
        self.outcome.chunks += 1
        if self.recorder is not None:
            self.recorder.chunk(chunk, self.outcome.steps)

    def taken_over_by(self, teacher: Asked) -> None:
        """From here on another worker leads."""
        self.outcome.taken_over_at = self.outcome.steps
        if self.recorder is not None:
            self.recorder.taken_over(teacher.worker, teacher.spec, self.outcome.steps)

    @property
    def asked_s(self) -> float:
        """How long the last answer took."""
        return self._asked_ms[-1] / 1e3

    def step(self, action: FloatArray) -> None:
        """Carry out a step, unless the episode is over."""
        if self.over:
            return
        self._last = action
        if self.recorder is not None:
            seen = self.benchmark.observe(self.recorder.cameras)
            self.recorder.saw(seen, self.outcome.steps)
        self.outcome.success = bool(self.benchmark.step(action))
        if self.recorder is not None:
            self.recorder.moved(self.benchmark.observe([]), action, self.outcome.steps)
        self.outcome.steps += 1
        self.outcome.actions.append(np.array(action))

    def stand(self, steps: int) -> None:
        for _ in range(steps):
            self.step(standing_step(self.benchmark, self._last))

    def finish(self, began_s: float) -> EpisodeOutcome:
        out = self.outcome
        out.wall_s = time.perf_counter() - began_s
        p50, p95 = np.percentile(self._asked_ms or [0.0], (50, 95))
        out.ask_ms = (round(float(p50), 3), round(float(p95), 3))
        out.end = state_hash(self.benchmark)
        out.failure = "" if out.success else out.failure or "steps"
        return out


def state_hash(benchmark: Benchmark) -> str:
    """16 hex digits of the simulation's whole state; empty: the benchmark does not tell it."""
    physics: Callable[[], NDArray[np.float64]] | None = getattr(benchmark, "physics", None)
    if physics is None:
        return ""
    return hashlib.sha256(np.ascontiguousarray(physics()).tobytes()).hexdigest()[:16]
