"""What a soak found out, and how it is told."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields
from typing import Any

from rich.console import Console
from rich.table import Table


@dataclass(slots=True)
class Found:
    """What a soak found out."""

    seed: int
    minutes: float = 0.0
    actions: Counter[str] = field(default_factory=Counter)
    killed: Counter[str] = field(default_factory=Counter)
    refused: dict[str, Counter[str]] = field(default_factory=dict)
    unexplained: list[str] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)
    leaks: list[str] = field(default_factory=list)
    recovery_s: dict[str, list[float]] = field(default_factory=dict)
    fastest_m_s: float = 0.0
    hardest_m_s2: float = 0.0
    stalls: int = 0
    worst_stall_s: float = 0.0
    held: dict[str, Any] = field(default_factory=dict)
    latency: dict[str, Any] = field(default_factory=dict)
    failure: str = ""

    def to_dict(self) -> dict[str, Any]:
        """All of it, as JSON takes it."""
        # Not dataclasses.asdict: of a counter it makes one that counts its pairs.
        return {part.name: getattr(self, part.name) for part in fields(self)} | {"code": self.code}

    @property
    def code(self) -> int:
        """The exit code."""
        if self.failure:
            return 2
        return 1 if self.unexplained or self.violations or self.leaks else 0


def table(found: Found) -> Table:
    """The result for people."""
    out = Table("what", "start", "end", title=f"{found.minutes:g} minutes, seed {found.seed}")
    start, end = found.held.get("start"), found.held.get("end")
    for name in sorted(start["nodes"]) if start and end else ():
        if name in end["nodes"]:
            pair = [
                "MiB {heap_mib:g}, {pss_mib:g}, {rss_mib:g}; {handles}; {threads}".format(
                    **held["nodes"][name]
                )
                for held in (start, end)
            ]
            out.add_row(name, *pair)
    if start and end:
        out.add_row(
            "/dev/shm",
            *(
                "{} segments, {} MiB, {} that nobody maps".format(*held["segments"])
                for held in (start, end)
            ),
        )
    before, after = found.latency.get("start"), found.latency.get("end")
    for name in before["stages_ms"] if before and after else ():
        pair = [when["stages_ms"].get(name, [0.0, 0.0]) for when in (before, after)]
        out.add_row(f"{name} p50, p95", *(f"{low:.1f}, {high:.1f} ms" for low, high in pair))
    for name in ("tick_us", "late_us") if before and after else ():
        pair = [when[name] or {} for when in (before, after)]
        out.add_row(
            f"{name} p50, p99", *(f"{each.get('p50')}, {each.get('p99')} us" for each in pair)
        )
    return out


def line(found: Found) -> str:
    """The result as a row of the table in docs/explanation/reliability.md."""
    back_s = sorted(found.recovery_s.get("kill", []))
    killed = str(sum(found.killed.values()))
    if back_s:
        killed += f", back after {back_s[len(back_s) // 2]:.1f} s, at most {back_s[-1]:.1f} s"
    refused = {action: sum(counts.values()) for action, counts in found.refused.items()}
    ends = [found.latency.get(when, {}).get("stages_ms", {}) for when in ("start", "end")]
    latency = [
        "{:.1f}, {:.1f}".format(*stages["end_to_end"]) if "end_to_end" in stages else "-"
        for stages in ends
    ]
    cells = (
        f"{found.seed}, {found.minutes:g}",
        sum(found.actions.values()),
        killed,
        f"{sum(refused.values())} ({refused.get('junk', 0)})",
        len(found.unexplained),
        len(found.violations),
        len(found.leaks),
        f"{found.fastest_m_s:.3f} m/s, {found.hardest_m_s2:.2f} m/s²",
        f"{'; '.join(latency)} ms",
        found.code,
    )
    return f"| {' | '.join(map(str, cells))} |"


def show(found: Found) -> None:
    """Print it for people."""
    screen = Console(highlight=False, width=130)
    screen.print("nodes: private, PSS, RSS; handles; threads")
    screen.print(table(found))
    for name, count in found.actions.most_common():
        times = sorted(found.recovery_s[name])
        middle, worst = times[len(times) // 2], times[-1]
        refused = found.refused.get(name, Counter())
        screen.print(
            f"{name:<8}{count:>5} times, back after {middle:.1f} s, at most {worst:.1f} s; "
            f"refusals {refused.total()}, of {len(refused)} kinds",
            markup=False,
        )
    screen.print(f"killed: {dict(found.killed)}", markup=False)
    screen.print(
        f"fastest {found.fastest_m_s:.3f} m/s, hardest {found.hardest_m_s2:.2f} m/s^2; the "
        f"computer stalled in {found.stalls} windows, {found.worst_stall_s * 1e3:.0f} ms at worst"
    )
    for title, lines in (
        ("refusals without a cause", found.unexplained),
        ("limits broken", found.violations),
        ("leaks", found.leaks),
    ):
        screen.print(f"{title}: {len(lines)}")
        for line in lines[:20]:
            screen.print(f"  {line}", markup=False)
    if found.failure:
        screen.print(f"it could not go on: {found.failure}", markup=False)
