"""Results as a map for JSON and as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table

from benchmarks.chain.rounds import Interval, Summary, summarise
from benchmarks.chain.ways import REFERENCE, Load, ServingWay
from vla_zenoh.errors import how_to_install

CHUNK, POSE, TICK_WAIT, ROUND_TRIP = "chunk", "pose", "tick_wait", "round_trip"
POSE_WITHOUT_WAIT = "pose_without_tick_wait"
STAGES = {
    "picture_to_worker": "picture published -> taken by the worker",
    "worker": "worker: observation, model, chunk",
    "chunk_to_command": "chunk published -> at the command node",
    TICK_WAIT: "waiting for the command node's next tick",
    "tick_to_pose": "tick -> pose command received",
}
"""Their sum is `POSE`."""
LINES: Mapping[str, tuple[tuple[str, str], ...]] = {
    "chain": (
        (CHUNK, "picture -> worker -> chunk back"),
        (POSE, "picture -> worker -> command -> pose back"),
        (POSE_WITHOUT_WAIT, "the same without waiting for the tick"),
    ),
    "echo": ((ROUND_TRIP, "picture -> 7 floats back"),),
    "peer": ((ROUND_TRIP, "picture -> 7 floats back"),),
}


@dataclass(frozen=True, slots=True)
class Result:
    """Results of a benchmark.

    Args:
        ways: in the order of the table.
        rounds: way -> slot, one map per round.
        machine: what it ran on.
        load: of every way in every round.
    """

    ways: Sequence[ServingWay]
    rounds: Sequence[Mapping[str, Interval]]
    machine: Mapping[str, Any]
    load: Load

    def summary(self, way: ServingWay, figure: str) -> Summary | None:
        """One line of the table."""
        return summarise(self.rounds, way.name, figure, (REFERENCE, CHUNK))

    def stages_ms(self, way: ServingWay) -> dict[str, float]:
        """Stage -> median in ms, of a chain."""
        found = {stage: self.summary(way, stage) for stage in STAGES}
        return {stage: summary.p50 for stage, summary in found.items() if summary}

    def standing_cpu(self, way: ServingWay) -> float:
        """Share of one core while idle, mean of the rounds."""
        shares = [slots[way.name].standing_cpu for slots in self.rounds if way.name in slots]
        return sum(shares) / len(shares) if shares else 0.0

    def lost(self, way: ServingWay) -> int:
        """Requests without an answer."""
        return sum(slots[way.name].lost for slots in self.rounds if way.name in slots)

    def to_dict(self) -> dict[str, Any]:
        """Plain types. Times in ms."""
        return {
            "machine": dict(self.machine),
            "rounds": len(self.rounds),
            **asdict(self.load),
            "reference": f"{REFERENCE}.{CHUNK}",
            "ways": {way.name: self._way(way) for way in self.ways},
        }

    def _way(self, way: ServingWay) -> dict[str, Any]:
        told: dict[str, Any] = {"title": way.title, "missing": list(way.missing())}
        if told["missing"]:
            return told
        for figure, _ in LINES[way.kind]:
            summary = self.summary(way, figure)
            told[figure] = asdict(summary) if summary else None
        if way.kind == "chain":
            told["stages"] = self.stages_ms(way)
            told["standing_cpu"] = self.standing_cpu(way)
        return told | {"lost": self.lost(way)}


def main_table(result: Result) -> Table:
    """The comparison."""
    load = result.load
    what = f"{load.cameras} picture{'s' * (load.cameras > 1)} of {load.size[0]}x{load.size[1]}"
    table = Table(title=f"{what} there, seven floats back. ms", header_style="bold")
    table.add_column("way", overflow="fold")
    for name in ("p50", "p95", "p99", "p50 by round", "CPU", "x ours"):
        table.add_column(name, justify="right", no_wrap=True)
    for way in result.ways:
        table.add_section()
        if way.missing():
            table.add_row(way.title, *[""] * 6)
            table.add_row(f"  not installed: {how_to_install('bench')}", *[""] * 6, style="yellow")
            continue
        if way.kind == "chain":
            table.add_row(way.title, *[""] * 6, style="bold")
        for figure, words in LINES[way.kind]:
            title = f"  {words}" if way.kind == "chain" else way.title
            table.add_row(title, *_cells(result.summary(way, figure)))
    return table


def _cells(summary: Summary | None) -> list[str]:
    if summary is None:
        return ["-"] * 6
    return [
        f"{summary.p50:.2f}",
        f"{summary.p95:.2f}",
        f"{summary.p99:.2f}",
        f"{summary.low:.2f} .. {summary.high:.2f}",
        "" if summary.cpu is None else f"{summary.cpu:.2f}",
        "" if summary.ratio is None else f"{summary.ratio:.2f}",
    ]


def stage_table(result: Result) -> Table | None:
    """Where the time of our chains goes; None when none was measured."""
    chains = [(way, found) for way in result.ways if (found := result.stages_ms(way))]
    if not chains:
        return None
    table = Table(title="Where it goes: median of each stage. ms", header_style="bold")
    table.add_column("stage")
    for way, _ in chains:
        table.add_column(f"{way.command_hz:g} Hz", justify="right")
    for stage, words in STAGES.items():
        table.add_row(words, *(f"{found[stage]:.3f}" for _, found in chains))
    return table


def notes(result: Result) -> list[str]:
    """Notes for reading the tables."""
    machine = result.machine
    pace = "one every 12 to 20 ms at most"
    if not result.load.pause:
        pace = "without a pause; ours 100 a second, the highest rate of a worker"
    told = [
        f"{len(result.rounds)} rounds of {result.load.requests} requests each, ways in turns, "
        f"{pace}. {machine.get('cores', '?')} cores, load {machine.get('load', '?')} at the start.",
        "A command node answers at its next tick: half a period on average, shown apart. The other "
        "ways end with the floats; what would follow to move an arm is not in them.",
        "CPU: of one request in all its processes, without that of ticks and states.",
        "Other users of a shared machine show in p95 and p99; compare ratios, and runs only when "
        "the medians of the rounds are near each other.",
    ]
    for way in result.ways:
        if way.kind == "chain" and not way.missing() and result.standing_cpu(way):
            share = 100 * result.standing_cpu(way)
            told.append(f"{way.title}: takes {share:.0f} % of one core without images, at rest.")
        if result.lost(way):
            told.append(f"{way.title}: {result.lost(way)} requests were not answered.")
    return told
