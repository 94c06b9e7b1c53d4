"""Fuzzes command node, guard and a perfect arm: ``make fuzz-motion MINUTES=10``.

Runs of all families of `motion_case.FAMILIES`, and of the smoother by itself, one seed after the
other, each judged by `motion_judge`. A violation is told at once, with the command that repeats its
run; at the end there is a table. The exit code is 1 where something did not hold.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

from motion_case import FAMILIES, make_case
from motion_judge import Judge, Violation
from motion_rig import Rig
from motion_smoother import run_smoother

SMOOTHER = "smoother"
CYCLE = (*FAMILIES, SMOOTHER)
TICKS = 20_000
LEAST_TICKS = 500


class Run(NamedTuple):
    """What came of a run.

    Args:
        family: of `CYCLE`.
        seed: of everything random in it.
        label: how the arm was commanded.
        ticks: calls of the commander, or of the smoother.
        seconds: of processor time it took.
        violations: what did not hold.
    """

    family: str
    seed: int
    label: str
    ticks: int
    seconds: float
    violations: list[Violation]


def run(family: str, seed: int, ticks: int = TICKS) -> Run:
    """One run, judged."""
    begun_s = time.process_time()
    if family == SMOOTHER:
        label, (done, found) = SMOOTHER, run_smoother(seed, ticks)
    else:
        case = make_case(family, seed)
        trace = Rig(case).run(ticks)
        label, done, found = case.label, len(trace.ticks), Judge(case, trace).judge()
    return Run(family, seed, label, done, time.process_time() - begun_s, found)


def command(one: Run, ticks: int) -> str:
    """What repeats a run."""
    return (
        "PYTHONPATH=tests python tests/fuzz_motion/fuzz_motion.py "
        f"--case {one.family.replace(' ', '-')} "
        f"--seed {one.seed} --runs 1 --ticks {ticks}"
    )


def told(one: Run, found: Violation) -> str:
    """A violation in one line."""
    size = f"{found.size:.4g} {found.unit}".strip()
    note = f" ({found.note[:120]})" if found.note else ""
    where = "case" if one.family == SMOOTHER else "tick"
    return f"{found.name}: {size} at {where} {found.tick}, {found.count} times{note}"


def table(runs: list[Run]) -> list[str]:
    """Every property that did not hold, in how many runs, and the worst one."""
    kinds: dict[tuple[str, str], list[tuple[float, Run, Violation]]] = defaultdict(list)
    many: dict[str, int] = defaultdict(int)
    for one in runs:
        mode = one.label.split("/")[0]
        many[mode] += 1
        for found in one.violations:
            kinds[found.name, mode].append((float(found.size), one, found))
    rows = [f"{'property':44} {'mode':9} {'runs':>9} {'worst':>22}  family, seed @tick"]
    for (name, mode), bad in sorted(kinds.items()):
        size, one, found = max(bad, key=lambda each: each[0])
        share = f"{len(bad)}/{many[mode]}"
        rows.append(
            f"{name:44} {mode:9} {share:>9} {size:>10.4g} {found.unit:11}  "
            f"{one.family} {one.seed} ({one.label}) @{found.tick}"
        )
    return rows if kinds else []


def _judged(job: tuple[str, int, int]) -> Run:
    return run(*job)


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _runs(jobs: Iterator[tuple[str, int, int]], many: int, end_s: float) -> Iterator[Run]:
    """The runs of `jobs`, so many at a time, until there are none or the time is over."""
    if many == 1:
        for job in jobs:
            if time.monotonic() >= end_s:
                return
            yield _judged(job)
        return

    def in_time() -> Iterator[tuple[str, int, int]]:
        for job in jobs:
            if time.monotonic() >= end_s:
                return
            yield job

    context = multiprocessing.get_context("spawn")
    with context.Pool(many, initializer=_begin) as pool:
        waiting = [pool.apply_async(_judged, (job,)) for job in itertools.islice(jobs, many)]
        rest = in_time()
        while waiting:
            for one in waiting:
                if one.ready():
                    break
            else:
                waiting[0].wait(0.05)
                continue
            waiting.remove(one)
            yield one.get()
            waiting += [pool.apply_async(_judged, (job,)) for job in itertools.islice(rest, 1)]


def main(arguments: list[str] | None = None) -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description="Fuzzes command node and guard.")
    parser.add_argument("--minutes", type=float, default=1.0, help="for so long")
    parser.add_argument("--runs", type=int, help="so many runs, however long they take")
    parser.add_argument("--seed", type=int, default=1, help="of the first run")
    parser.add_argument("--ticks", type=int, default=TICKS, help="of one run")
    known = sorted({name.replace(" ", "-") for name in CYCLE})
    parser.add_argument("--case", choices=known, action="append", help="only this family, or these")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="at a time")
    options = parser.parse_args(arguments)
    if options.ticks < LEAST_TICKS or options.jobs < 1:
        parser.error(f"--ticks has to be {LEAST_TICKS} at least and --jobs 1")
    families = tuple(name.replace("-", " ") for name in options.case or CYCLE)
    jobs: Iterator[tuple[str, int, int]] = (
        (families[n % len(families)], seed, options.ticks)
        for n, seed in enumerate(itertools.count(options.seed))
    )
    begun_s = time.monotonic()
    end_s = begun_s + 60 * options.minutes
    if options.runs is not None:
        jobs, end_s = itertools.islice(jobs, options.runs), float("inf")
    done: list[Run] = []
    print(f"seeds {options.seed} and on, {options.ticks} ticks each, {options.jobs} at a time")
    try:
        for one in _runs(jobs, options.jobs, end_s):
            done.append(one)
            rate = one.ticks / one.seconds
            verdict = f"{len(one.violations)} violations" if one.violations else "ok"
            print(f"{one.family} {one.seed} {one.label}: {rate:.0f} ticks/s, {verdict}", flush=True)
            for found in one.violations:
                print(f"    {told(one, found)}")
            if one.violations:
                print(f"    {command(one, options.ticks)}", flush=True)
    except KeyboardInterrupt:
        print("interrupted")
    ticks, seconds = sum(one.ticks for one in done), time.monotonic() - begun_s
    bad = [one for one in done if one.violations]
    print(
        f"\n{len(done)} runs, {ticks} ticks in {seconds:.0f} s "
        f"({ticks / max(seconds, 1e-9):.0f} a second), {len(bad)} runs with violations"
    )
    print("\n".join(table(done)))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
