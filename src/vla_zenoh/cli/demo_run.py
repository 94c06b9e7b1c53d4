"""What ``vla-zenoh demo`` does: nodes, bars, run folder, summary."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from vla_zenoh.cli.options import effective_profile
from vla_zenoh.cli.output import console, errors
from vla_zenoh.demo.analysis import Outcome, latencies
from vla_zenoh.demo.plot import plot_run
from vla_zenoh.demo.segments import Segment
from vla_zenoh.demo.tables import write_chunks, write_commands, write_poses
from vla_zenoh.demo.video import write_video
from vla_zenoh.errors import SessionError
from vla_zenoh.loader import find_model, make_policy
from vla_zenoh.nodes.demo import DemoResult, DemoRun
from vla_zenoh.nodes.launch import Host
from vla_zenoh.nodes.listener import Listener
from vla_zenoh.nodes.process import die_with_parent, stop_on_signals
from vla_zenoh.nodes.recorder import Recorder
from vla_zenoh.nodes.session import open_session
from vla_zenoh.profile import Profile, SessionProfile, override, to_yaml
from vla_zenoh.recording.run import Run, load_run, pictures
from vla_zenoh.types import NodeStatus

MAX_LOG_LINES = 20
RECORDING = "run.mcap"
HOLD = "hold"
KEPT = 400
"""States that the demo itself looks back on."""
PICTURE_NS = 60_000_000
"""Pictures of the video lie at least this far apart: twice as many as it shows."""


def run_demo(
    segments: list[Segment],
    rate: float,
    seconds: float | None,
    profile: str,
    json_file: Path | None,
    out: Path | None,
) -> None:
    """See ``vla-zenoh demo``."""
    stop = stop_on_signals()
    die_with_parent()
    loaded = own_address(effective_profile(profile))
    folder = out or Path("runs") / time.strftime("demo-%Y%m%d-%H%M%S")
    folder.mkdir(parents=True, exist_ok=True)
    screen = errors()  # progress is no result: stdout stays for the summary
    screen.print(
        f"profile {loaded.name}, router at {loaded.session.connect[0]}, run folder {folder}"
    )
    screen.print(
        f"watch it from another terminal: vla-zenoh status --connect {loaded.session.connect[0]}",
        style="dim",
    )
    result = _run(loaded, segments, rate, seconds, folder, stop, screen)
    run = load_run(folder / RECORDING)
    summary = _summary(loaded, rate, result, run)
    _write_folder(folder, loaded, summary, run, screen)
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps(summary, indent=2) + "\n", "utf-8")
    _show(summary, result, folder)
    if not summary["ok"]:
        raise typer.Exit(130 if result.interrupted else 1)


def own_address(profile: Profile) -> Profile:
    """The profile where nobody answers: a demo must never reach a lab's real robot."""
    if profile.robot.driver != "sim":
        raise typer.BadParameter(f"profile {profile.name} is of a real robot; demos are simulated")
    # It stays on this computer, and needs no certificates.
    plain = {"security": None, "insecure": False, "separate_links": False}
    if profile.session.security is not None:
        local = list(SessionProfile().connect)
        profile = override(profile, {"session": {**plain, "connect": local, "listen": local}})
    try:
        open_session(profile.session).close()
        port = _free_port()
        endpoints = (f"tcp/127.0.0.1:{port}",)
        errors().print("a router answers at the profile's address already; using another port")
    except SessionError:
        endpoints = profile.session.connect
    here = list(endpoints)
    return override(profile, {"session": {**plain, "connect": here, "listen": here}})


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _run(
    profile: Profile,
    segments: list[Segment],
    rate_hz: float,
    seconds: float | None,
    folder: Path,
    stop: threading.Event,
    screen: Console,
) -> DemoResult:
    lines: list[str] = []
    with (
        (folder / "nodes.log").open("w", encoding="utf-8") as log_file,
        Progress(
            TextColumn("{task.description:<24}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=screen,
        ) as bars,
    ):
        coming_up = bars.add_task("starting the nodes", total=None)

        def log(node: str, line: str) -> None:
            log_file.write(f"{node:>16} | {line}\n")
            lines.append(f"{node}: {line}")

        def progress(index: int, done: int) -> None:
            bars.update(coming_up, visible=False)
            while len(tasks) <= index:
                segment = segments[len(tasks)]
                tasks.append(bars.add_task(segment.prompt, total=segment.steps))
            bars.update(tasks[index], completed=done)

        tasks: list[Any] = []
        host = Host(profile, None, log=log, tell=log, own_router=True)
        try:
            with host as running:
                assert running.session is not None and running.client is not None
                recorder = Recorder(
                    profile, running.session, folder / RECORDING, expressions=recorded(profile)
                ).start()
                listener = Listener(running.session, profile.keys, profile.task.worker, keep=KEPT)

                def watch() -> None:
                    if not running.supervisor.watch():
                        stop.set()

                run = DemoRun(running.client, listener, stop, watch, progress)
                try:
                    result = run.run(segments, rate_hz, seconds)
                finally:
                    listener.close()
                    recorder.close()
        except Exception:
            screen.print("\n".join(lines[-MAX_LOG_LINES:]), style="dim", markup=False)
            raise
        for index, task in enumerate(tasks):
            if index < len(result.outcomes):
                bars.update(task, completed=segments[index].steps)
    return result


def _camera(profile: Profile) -> str | None:
    return "front" if "front" in profile.cameras else next(iter(profile.cameras), None)


def recorded(profile: Profile) -> tuple[str, ...]:
    """Everything, and the pictures of one camera: each more takes its share of the processor."""
    camera = _camera(profile)
    keys = profile.keys
    return (*keys.without_pictures, *([keys.camera_jpeg(camera)] if camera else []))


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


def refusals(statuses: Mapping[str, NodeStatus]) -> dict[str, int]:
    """What all nodes refused, by reason."""
    out: Counter[str] = Counter()
    for status in statuses.values():
        for name, count in status.counters.items():
            if name.startswith("refused."):
                out[name.removeprefix("refused.")] += count
    return dict(sorted(out.items()))


def _rate(entries: list[Any]) -> float:
    if len(entries) < 2:
        return 0.0
    span_s = (entries[-1].heard_ns - entries[0].heard_ns) / 1e9
    return round((len(entries) - 1) / span_s, 2) if span_s > 0 else 0.0


def _counter(result: DemoResult, node: str, name: str) -> int:
    status = result.statuses.get(node)
    return int(status.counters.get(name, 0)) if status else 0


def _write_folder(
    folder: Path, profile: Profile, summary: dict[str, Any], run: Run, screen: Console
) -> None:
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", "utf-8")
    (folder / "profile.yaml").write_text(to_yaml(profile), "utf-8")
    write_commands(folder / "commands.csv", run.commands)
    write_poses(folder / "poses.csv", run.poses)
    spec = make_policy(find_model(profile.task.worker)).spec
    worker = profile.task.worker
    first = run.first_commands()
    obeyed = {cause.chunk_seq for cause, _ in first if cause.worker == worker}
    chunks = [
        entry.record.steps
        for entry in run.chunks
        if entry.record.worker == worker and entry.header.seq in obeyed
    ]
    write_chunks(folder / "chunks.npz", spec, chunks)
    marks = [(at_ns, prompt) for at_ns, prompt in run.prompts() if prompt != HOLD]
    with Progress(
        TextColumn("{task.description:<24}"), BarColumn(), TimeElapsedColumn(), console=screen
    ) as bars:
        plotting = bars.add_task("drawing plot.png", total=1)
        plot_run(folder / "plot.png", profile, run.poses, run.commands, marks, first)
        bars.update(plotting, completed=1)
    film(folder, run, profile, marks, screen)


def film(
    folder: Path, run: Run, profile: Profile, marks: list[tuple[int, str]], screen: Console
) -> None:
    """Write front.mp4, with the prompts in it."""
    frames = _frames(run, _camera(profile))
    with Progress(
        TextColumn("{task.description:<24}"), BarColumn(), TimeElapsedColumn(), console=screen
    ) as bars:
        filming = bars.add_task("writing front.mp4", total=max(1, len(frames)))
        written = write_video(
            folder / "front.mp4",
            frames,
            marks,
            lambda done, total: bars.update(filming, completed=done, total=total),
        )
        if not written:
            bars.update(filming, description="no pictures, no video", completed=1, total=1)


def _frames(run: Run, camera: str | None) -> list[tuple[int, bytes]]:
    frames: list[tuple[int, bytes]] = []
    for picture in pictures(run.file, camera) if camera is not None else ():
        if not frames or picture.heard_ns - frames[-1][0] >= PICTURE_NS:
            frames.append((picture.heard_ns, picture.jpeg))
    return frames


def _show(summary: dict[str, Any], result: DemoResult, folder: Path) -> None:
    table = Table(title="asked and reached, measured at rest", title_justify="left")
    for column in ("prompt", "steps", "asked", "reached", "drift", "rotation drift", ""):
        table.add_column(column, justify="left" if column in ("prompt", "") else "right")
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
            "[red]" + "; ".join(faults) + "[/]" if faults else "[green]ok[/]",
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
    screen.print(
        f"run folder: {folder} (run.mcap, summary.json, commands.csv, poses.csv, plot.png, "
        "front.mp4)"
    )
    if result.interrupted:
        screen.print("[yellow]interrupted; the arm was braked[/]")
    elif summary["ok"]:
        screen.print("[bold green]the arm did what was asked[/]")
    else:
        screen.print("[bold red]the arm did not do what was asked[/]")


def _amounts(outcome: Outcome) -> tuple[str, str]:
    if outcome.asked_m:
        return f"{outcome.asked_m:.4f} m", f"{outcome.reached_m:.4f} m"
    if outcome.asked_rad:
        return f"{outcome.asked_rad:.4f} rad", f"{outcome.reached_rad:.4f} rad"
    if outcome.segment.motion is not None and outcome.segment.motion.axis == 6:
        return f"{outcome.asked_width_m * 1e3:.1f} mm", f"{outcome.reached_width_m * 1e3:.1f} mm"
    return "stand", "stood"
