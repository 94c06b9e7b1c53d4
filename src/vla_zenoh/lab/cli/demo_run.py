"""``vla-zenoh demo --prompt "HARD: ..."``: a fixed motion, compared with what its prompt asks."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import typer

from vla_zenoh.cli.output import console, new_table
from vla_zenoh.keys import worker_node
from vla_zenoh.lab.cli.bench_file import counts
from vla_zenoh.lab.cli.demo_stage import Stage, latency_line, open_stage
from vla_zenoh.lab.cli.options import DemoOptions
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.demo.runner import MotionRunner
from vla_zenoh.lab.demo.segments import DemoSegment, SegmentOutcome, latencies
from vla_zenoh.lab.evaluation.result import TASKS
from vla_zenoh.lab.recording.run import Run
from vla_zenoh.policy.loader import find_worker, make_policy


def run_demo(segment: DemoSegment, profile: str, given: DemoOptions) -> None:
    """Run a fixed motion and show how far it came."""
    if given.seconds is not None:
        segment = replace(segment, steps=max(round(given.seconds * given.rate_hz), 1))
    with open_stage(profile, given) as stage:
        stage.profile.require_one_arm("fixed motions of demo")
        outcome = _run(stage, segment, given.rate_hz)
        run = stage.recorded()
        summary = _summary(stage, given.rate_hz, outcome, run)
        stage.write(summary)
        _write_chunks(stage, run)
        stage.draw(run)
    if given.as_json:
        print_json({**summary, "folder": stage.path})
    else:
        _show(summary, outcome, stage)
    if not summary["ok"]:
        raise typer.Exit(130 if outcome is None else 1)


def _run(stage: Stage, segment: DemoSegment, rate_hz: float) -> SegmentOutcome | None:
    """What became of the segment; None: it was interrupted."""
    with stage.nodes(24) as (running, client, bars):
        run = MotionRunner(client, stage.stop, running.poll)
        run.begin(rate_hz)
        bar = bars.add_task(segment.prompt, total=segment.steps)
        outcome = run.run_segment(segment, rate_hz, lambda done: bars.update(bar, completed=done))
        bars.update(bar, completed=segment.steps)
        stage.facts[TASKS] = [_fact(outcome)]
        return outcome
    return None


def _summary(
    stage: Stage, rate_hz: float, outcome: SegmentOutcome | None, run: Run
) -> dict[str, Any]:
    profile, statuses = stage.profile, stage.statuses
    worker, command = statuses.get(worker_node(profile.task.worker)), statuses.get("command")
    return {
        **({"ok": False} if outcome is None else outcome.to_dict()),
        "profile": profile.name,
        "rate_hz": rate_hz,
        "latency_ms": latencies(run.first_commands()),
        "rates_hz": {
            "command": _rate(run.commands or run.joint_commands),
            "state": _rate(run.poses),
            "chunks": worker.rates_hz.get("chunks", 0.0) if worker else 0.0,
        },
        "missed_ticks": command.counters.get("command.missed_ticks", 0) if command else 0,
        "refusals": stage.refusals(),
    }


def _fact(outcome: SegmentOutcome) -> dict[str, Any]:
    faults = outcome.faults()
    return {
        "prompt": outcome.segment.prompt,
        "success": not faults,
        "said": "; ".join(faults) or "done",
        "time_s": round(outcome.duration_s, 2),
    }


def _rate(entries: list[Any]) -> float:
    """Rate of a stream while it is not thinned out, as that of commands is at rest."""
    gaps_ns = np.diff([entry.header.stamp_wall_ns for entry in entries])
    gap_ns = float(np.quantile(gaps_ns, 0.25)) if len(gaps_ns) else 0.0
    return round(1e9 / gap_ns, 2) if gap_ns > 0 else 0.0


def _write_chunks(stage: Stage, run: Run) -> None:
    """Chunk file for ``vla-zenoh worker replay``: spec, steps (N, H, D), length (N,)."""
    profile = stage.profile
    worker = profile.task.worker
    spec = make_policy(find_worker(worker, profile.models)[1], profile.options.get(worker)).spec
    obeyed = {cause.chunk_seq for cause, _ in run.first_commands() if cause.worker == worker}
    chunks = [
        entry.record.steps
        for entry in run.chunks
        if entry.record.worker == worker and entry.header.seq in obeyed
    ]
    steps = np.zeros((len(chunks), spec.action.horizon, spec.action.dimension), np.float32)
    for index, chunk in enumerate(chunks):
        steps[index, : len(chunk)] = chunk
    length = np.array([len(chunk) for chunk in chunks], np.int32)
    file = stage.folder / "chunks.npz"
    np.savez_compressed(file, spec=json.dumps(spec.to_dict()), steps=steps, length=length)


def _show(summary: dict[str, Any], outcome: SegmentOutcome | None, stage: Stage) -> None:
    screen = console()
    if outcome is not None:
        columns = ("prompt", "steps", "asked", "reached", "drift", "rotation drift")
        title = "asked and reached, measured at rest"
        table = new_table(*columns, title=title, left=("prompt",))
        table.add_row(
            outcome.segment.prompt,
            f"{outcome.steps_done}/{outcome.segment.steps}",
            *_amounts(outcome),
            f"{outcome.drift_mm:.2f} mm",
            f"{outcome.drift_rad * 1e3:.2f} mrad",
        )
        screen.print(table)
    screen.print(latency_line(summary["latency_ms"]))
    rates = ", ".join(f"{name} {value:.1f} Hz" for name, value in summary["rates_hz"].items())
    screen.print(f"rates: {rates}; rejections: {counts(summary['refusals']) or 'none'}")
    files = "run.mcap, summary.json, chunks.npz, report.html, video.mp4"
    screen.print(f"run folder: {stage.path} ({files})")
    if outcome is None:
        screen.print("interrupted; the arm braked", style="yellow")
    elif summary["ok"]:
        screen.print("the arm did what was asked", style="bold green")
    else:
        faults = "; ".join(outcome.faults())
        screen.print(f"the arm did not do what was asked: {faults}", style="bold red")


def _amounts(outcome: SegmentOutcome) -> tuple[str, str]:
    if outcome.asked_m:
        return f"{outcome.asked_m:.4f} m", f"{outcome.reached_m:.4f} m"
    if outcome.asked_rad:
        return f"{outcome.asked_rad:.4f} rad", f"{outcome.reached_rad:.4f} rad"
    if outcome.segment.motion is not None and outcome.segment.motion.axis == 6:
        return f"{outcome.asked_width_m * 1e3:.1f} mm", f"{outcome.reached_width_m * 1e3:.1f} mm"
    return "stand", "stood"
