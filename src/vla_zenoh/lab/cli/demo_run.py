"""``vla-zenoh demo --tour``: fixed motions, compared with what their prompts ask."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from vla_zenoh.cli.output import console, new_table, print_json, styled
from vla_zenoh.lab.cli.demo_options import DemoOptions
from vla_zenoh.lab.cli.demo_stage import Stage, open_stage, refusals, run_folder
from vla_zenoh.lab.demo.chunk_file import write_chunks
from vla_zenoh.lab.demo.runner import DemoResult, DemoRunner
from vla_zenoh.lab.demo.segments import DemoSegment, SegmentOutcome, latencies
from vla_zenoh.lab.evaluation.result import TASKS
from vla_zenoh.lab.recording.run import Run
from vla_zenoh.lab.recording.stream_listener import StreamListener
from vla_zenoh.policy.loader import find_worker, make_policy
from vla_zenoh.profile import Profile

KEPT = 400
"""States that the demo keeps."""


def run_demo(segments: list[DemoSegment], profile: str, given: DemoOptions) -> None:
    """Run fixed motions and show how far each came."""
    folder = run_folder(given.output)
    with open_stage(profile, folder, force=given.force) as stage:
        result = _run(stage, segments, given.rate_hz, given.seconds)
        run = stage.recorded()
        summary = _summary(stage.profile, given.rate_hz, result, run)
        stage.write(summary)
        _write_files(stage, run)
    if given.as_json:
        print_json({**summary, "folder": folder})
    else:
        _show(summary, result, folder)
    if not summary["ok"]:
        raise typer.Exit(130 if result.interrupted else 1)


def _run(
    stage: Stage, segments: list[DemoSegment], rate_hz: float, seconds: float | None
) -> DemoResult:
    profile, stop = stage.profile, stage.stop
    with stage.nodes(24) as (running, bars):
        assert running.session is not None and running.client is not None
        tasks: list[Any] = []

        def progress(index: int, done: int) -> None:
            while len(tasks) <= index:
                segment = segments[len(tasks)]
                tasks.append(bars.add_task(segment.prompt, total=segment.steps))
            bars.update(tasks[index], completed=done)

        def watch() -> None:
            if not running.supervisor.poll():
                stop.set()

        listener = StreamListener(running.session, profile.keys, profile.task.worker, keep=KEPT)
        try:
            run = DemoRunner(running.client, listener, stop, watch, progress)
            result = run.run(segments, rate_hz, seconds)
            stage.facts[TASKS] = [_fact(outcome) for outcome in result.outcomes]
        finally:
            listener.close()
        for index, task in enumerate(tasks):
            if index < len(result.outcomes):
                bars.update(task, completed=segments[index].steps)
    return result


def _summary(profile: Profile, rate_hz: float, result: DemoResult, run: Run) -> dict[str, Any]:
    outcomes = [outcome.to_dict() for outcome in result.outcomes]
    commands = run.commands or run.joint_commands
    only = outcomes[0] if len(outcomes) == 1 else {}
    return {
        "ok": bool(outcomes) and not result.interrupted and all(o["ok"] for o in outcomes),
        "profile": profile.name,
        "rate_hz": rate_hz,
        **{key: only[key] for key in ("prompt", "steps", "steps_done", "asked", "reached") if only},
        "drift_mm": max((o["drift_mm"] for o in outcomes), default=None),
        "rotation_drift_rad": max((o["rotation_drift_rad"] for o in outcomes), default=None),
        "latency_ms": latencies(run.first_commands()),
        "rates_hz": {
            "command": _rate(commands),
            "state": _rate(run.poses),
            "chunks": result.statuses[f"worker-{profile.task.worker}"].rates_hz.get("chunks", 0.0)
            if f"worker-{profile.task.worker}" in result.statuses
            else 0.0,
        },
        "missed_ticks": _counter(result, "command", "command.missed_ticks"),
        "refusals": refusals(result.statuses),
        "segments": outcomes,
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
    if len(entries) < 2:
        return 0.0
    span_s = (entries[-1].received_ns - entries[0].received_ns) / 1e9
    return round((len(entries) - 1) / span_s, 2) if span_s > 0 else 0.0


def _counter(result: DemoResult, node: str, name: str) -> int:
    status = result.statuses.get(node)
    return int(status.counters.get(name, 0)) if status else 0


def _write_files(stage: Stage, run: Run) -> None:
    folder, profile = stage.folder, stage.profile
    worker = profile.task.worker
    spec = make_policy(find_worker(worker, profile.models)[1], profile.options.get(worker)).spec
    first = run.first_commands()
    obeyed = {cause.chunk_seq for cause, _ in first if cause.worker == worker}
    chunks = [
        entry.record.steps
        for entry in run.chunks
        if entry.record.worker == worker and entry.header.seq in obeyed
    ]
    write_chunks(folder / "chunks.npz", spec, chunks)
    stage.draw(run)
    stage.film(run)


def _show(summary: dict[str, Any], result: DemoResult, folder: Path) -> None:
    columns = ("prompt", "steps", "asked", "reached", "drift", "rotation drift", "verdict")
    title = "asked and reached, measured at rest"
    table = new_table(*columns, title=title, left=("prompt", "verdict"))
    for outcome in result.outcomes:
        asked, reached = _amounts(outcome)
        faults = outcome.faults()
        table.add_row(
            outcome.segment.prompt,
            f"{outcome.steps_done}/{outcome.segment.steps}",
            asked,
            reached,
            f"{outcome.drift_mm:.2f} mm",
            f"{outcome.drift_rad * 1e3:.2f} mrad",
            styled("; ".join(faults), "red") if faults else styled("ok", "green"),
        )
    screen = console()
    screen.print(table)
    latency = summary["latency_ms"]
    if latency.get("p50") is not None:
        stages = ", ".join(
            f"{name.replace('_', ' ')} {values['p50']:.1f}"
            for name, values in latency["stages"].items()
        )
        screen.print(
            f"latency, camera stamp to pose command: p50 {latency['p50']:.1f} ms, "
            f"p95 {latency['p95']:.1f} ms ({stages})"
        )
    rates = ", ".join(f"{name} {value:.1f} Hz" for name, value in summary["rates_hz"].items())
    refused = ", ".join(f"{reason} {count}" for reason, count in summary["refusals"].items())
    screen.print(f"rates: {rates}; refusals: {refused or 'none'}")
    screen.print(f"run folder: {folder} (run.mcap, summary.json, chunks.npz, plot.png, video.mp4)")
    if result.interrupted:
        screen.print("interrupted; the arm braked", style="yellow")
    elif summary["ok"]:
        screen.print("the arm did what was asked", style="bold green")
    else:
        screen.print("the arm did not do what was asked", style="bold red")


def _amounts(outcome: SegmentOutcome) -> tuple[str, str]:
    if outcome.asked_m:
        return f"{outcome.asked_m:.4f} m", f"{outcome.reached_m:.4f} m"
    if outcome.asked_rad:
        return f"{outcome.asked_rad:.4f} rad", f"{outcome.reached_rad:.4f} rad"
    if outcome.segment.motion is not None and outcome.segment.motion.axis == 6:
        return f"{outcome.asked_width_m * 1e3:.1f} mm", f"{outcome.reached_width_m * 1e3:.1f} mm"
    return "stand", "stood"
