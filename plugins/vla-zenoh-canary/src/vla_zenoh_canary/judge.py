"""Reasons against the promotion of a canary: all of them, each with a name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from vla_zenoh.keys import worker_node
from vla_zenoh_canary.figures import RobotFigures, WorkerFigures


class Refusal(NamedTuple):
    """One reason: the robot, a stable short name, and a sentence."""

    robot: str
    name: str
    why: str


@dataclass(frozen=True)
class Demands:
    """What figures must show. None: not asked for.

    Args:
        seconds: that every robot was watched.
        pairs: of chunks that were compared.
        rejected_percent: most of the answers of the canary that no robot would have executed.
        apart_mm, apart_mrad: most of the 95th percentile of how far the chunks end apart.
        age_ms: most of the 95th percentile of the age of the canary's chunks.
    """

    seconds: float = 30.0
    pairs: int = 50
    rejected_percent: float = 1.0
    apart_mm: float | None = None
    apart_mrad: float | None = None
    age_ms: float | None = None


class Present(NamedTuple):
    """What a robot's nodes say now.

    Args:
        alive: names of live nodes.
        obeyed: the chosen worker; None: its command node is silent.
        specs: worker -> hash of its spec, and its source.
    """

    alive: frozenset[str]
    obeyed: str | None
    specs: Mapping[str, tuple[str, str]]


def refusals(
    robot: str, found: RobotFigures | None, present: Present, demands: Demands
) -> Iterator[Refusal]:
    """Reasons against a promotion on one robot.

    Args:
        robot: its name.
        found: its figures; None: it was not watched.
        present: what is so now.
        demands: what the figures must show.
    """
    if found is None:
        yield Refusal(robot, "figures_missing", "it was not watched: name it to `canary watch`")
        return
    for name, why in (*_missing(found, demands), *_changed(found, present), *_poor(found, demands)):
        yield Refusal(robot, name, why)


def _missing(found: RobotFigures, demands: Demands) -> Iterator[tuple[str, str]]:
    if found.seconds < demands.seconds:
        yield (
            "figures_missing",
            f"watched for {found.seconds:.0f} s, wanted {demands.seconds:g} s: watch it longer",
        )
    apart = found.apart
    if apart.pairs < demands.pairs:
        more = f", {apart.uncompared} more could not be compared" if apart.uncompared else ""
        yield (
            "figures_missing",
            f"{apart.pairs} pairs of chunks of {found.new.worker!r} and {found.other.worker!r}"
            f"{more}; wanted {demands.pairs}: watch it longer",
        )
    for worker in (found.new, found.other):
        silent_s, allowed_s = worker.longest_silence_s, worker.silence_allowed_s
        if not worker.chunks or silent_s > allowed_s:
            yield (
                "shadow_absent" if worker is found.new else "obeyed_absent",
                f"worker {worker.worker!r} gave {worker.chunks} chunks and was silent for "
                f"{silent_s:.1f} s while they were asked for, at most {allowed_s:.1f} s",
            )


def _changed(found: RobotFigures, present: Present) -> Iterator[tuple[str, str]]:
    new, other = found.new, found.other
    if found.obeyed_changed or found.obeyed != other.worker:
        yield (
            "obeyed_differs",
            f"worker {other.worker!r} was not the obeyed one all the time; watch it again",
        )
    elif present.obeyed != other.worker:
        now = "nobody says which one is" if present.obeyed is None else f"{present.obeyed!r} is"
        yield (
            "obeyed_differs",
            f"the figures are against worker {other.worker!r}, which was obeyed; now {now}",
        )
    for worker in (new, other):
        absent = "shadow_absent" if worker is new else "obeyed_absent"
        if worker_node(worker.worker) not in present.alive:
            yield absent, f"worker {worker.worker!r} is not alive; start it and watch it again"
            continue
        said = present.specs.get(worker.worker)
        if said is None:
            yield absent, f"worker {worker.worker!r} publishes no spec"
        else:
            yield from _process(worker, *said)


def _process(worker: WorkerFigures, spec: str, source: str) -> Iterator[tuple[str, str]]:
    name = worker.worker
    if spec != worker.spec:
        yield (
            "spec_differs",
            f"worker {name!r} has spec {spec}, the figures are of {worker.spec or 'none'}; watch "
            "it again",
        )
    elif worker.restarts or source != worker.source:
        yield (
            "restarted",
            f"worker {name!r} was restarted, perhaps with other weights; watch it again",
        )


def _poor(found: RobotFigures, demands: Demands) -> Iterator[tuple[str, str]]:
    new, apart = found.new, found.apart
    if new.rejected_percent > demands.rejected_percent:
        reasons = {**new.rejected, **new.failed}
        counts = ", ".join(f"{name} {count}" for name, count in reasons.items())
        yield (
            "rejected",
            f"{new.rejected_percent:.1f} % of its answers would not be executed ({counts}), at "
            f"most {demands.rejected_percent:g} %",
        )
    for name, spread, most, unit in (
        ("apart", apart.distance_mm, demands.apart_mm, "mm apart"),
        ("apart", apart.angle_mrad, demands.apart_mrad, "mrad apart"),
        ("late", new.age_ms, demands.age_ms, "ms old"),
    ):
        if spread is not None and most is not None and spread[1] > most:
            yield name, f"p95 is {spread[1]:.4g} {unit}, at most {most:g}"
