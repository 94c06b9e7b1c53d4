"""Stage of a demo: its address, run folder, nodes, recording and video."""

from __future__ import annotations

import json
import shlex
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.progress import Progress

from vla_zenoh.cli.options import effective_profile
from vla_zenoh.cli.output import console, errors
from vla_zenoh.client.client import Client
from vla_zenoh.lab.cli.demo_capacity import measure_capacity, small
from vla_zenoh.lab.cli.loopback import own_address
from vla_zenoh.lab.cli.options import DemoOptions
from vla_zenoh.lab.cli.output import progress_bars
from vla_zenoh.lab.cli.output_path import RUNS, output_folder
from vla_zenoh.lab.cli.running_nodes import running_nodes
from vla_zenoh.lab.episode import Interrupted
from vla_zenoh.lab.evaluation.mcap_file import evaluate_parts
from vla_zenoh.lab.evaluation.report import page
from vla_zenoh.lab.evaluation.result import Evaluation
from vla_zenoh.lab.recording.film import Film, write_film
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.recording.run import Run, load_run
from vla_zenoh.lab.statistics import percentiles
from vla_zenoh.profile import Profile, to_yaml
from vla_zenoh.runtime.launch import Host
from vla_zenoh.runtime.process import die_with_parent, stop_on_signals
from vla_zenoh.types import LATENCY_STAGES, NodeStatus


@dataclass(frozen=True, slots=True)
class Stage:
    """A profile at an address of its own, and the run folder. Made by `open_stage`.

    Args:
        folder: to fill; it becomes `path` at the end.
        facts: for the end of the recording, such as the verdicts.
        statuses: the last one of every node, once the nodes have ended.
    """

    profile: Profile
    folder: Path
    path: Path
    stop: threading.Event
    facts: dict[str, Any] = field(default_factory=dict)
    statuses: dict[str, NodeStatus] = field(default_factory=dict)

    @contextmanager
    def nodes(self, width: int) -> Iterator[tuple[Host, Client, Progress]]:
        """Run and record all nodes, with progress bars; a failure shows the end of their log.

        At the end the arm brakes, also after Ctrl-C, which ends the block and nothing else.
        """
        with progress_bars(width) as bars:
            coming_up = bars.add_task("starting the nodes", total=None)
            with running_nodes(self.profile, self.folder / "nodes.log") as running:
                session, client = running.session, running.client
                assert session is not None and client is not None
                bars.update(coming_up, visible=False)
                recorder = Recorder(
                    self.profile,
                    session,
                    self.folder / "run.mcap",
                    about={"command": shlex.join(["vla-zenoh", *sys.argv[1:]])},
                ).start()
                try:
                    yield running, client, bars
                except Interrupted:
                    pass
                finally:
                    found = client.snapshot().items()
                    self.statuses.update({name: status for name, (status, _, _) in found})
                    try:
                        client.deactivate()
                    finally:
                        recorder.close(self.facts)

    def refusals(self) -> dict[str, int]:
        """Rejections of all nodes, by reason."""
        out: Counter[str] = Counter()
        for status in self.statuses.values():
            for name, count in status.counters.items():
                if name.startswith("refused."):
                    out[name.removeprefix("refused.")] += count
        return dict(sorted(out.items()))

    def recorded(self) -> Run:
        return load_run(self.folder / "run.mcap")

    def write(self, summary: Mapping[str, Any]) -> None:
        (self.folder / "profile.yaml").write_text(to_yaml(self.profile), "utf-8")
        text = json.dumps(summary, indent=2) + "\n"
        (self.folder / "summary.json").write_text(text, "utf-8")

    def draw(
        self, run: Run, verdicts: Sequence[tuple[int, str, bool]] = ()
    ) -> Sequence[Evaluation]:
        """Write report.html, and video.mp4 with `verdicts` in it; returns what is on the page.

        Args:
            verdicts: ns, text, success.
        """
        with progress_bars(24, counted=False) as bars:
            reporting = bars.add_task("writing report.html", total=None)
            parts = evaluate_parts(run)
            for name, part in zip(run.part_names, parts, strict=True):
                part.name = f"{self.path.name}/{name}" if name else self.path.name
            (self.folder / "report.html").write_text(page(parts, {}), "utf-8")
            bars.update(reporting, completed=1, total=1)
            filming = bars.add_task("writing video.mp4", total=None)
            written = write_film(
                self.folder / "video.mp4",
                run,
                Film(),
                verdicts,
                lambda done, total: bars.update(filming, completed=done, total=total),
            )
            if not written:
                bars.update(filming, description="no images, no video", completed=1, total=1)
        return parts


@contextmanager
def open_stage(profile: str, given: DemoOptions) -> Iterator[Stage]:
    """A stage for a profile; its folder appears when the block has ended without an exception.

    Raises:
        OutputError: the folder cannot be had; see `output_folder`.
    """
    loaded = own_address(effective_profile(profile))
    capacity = measure_capacity()
    if not capacity.enough:
        loaded = small(loaded)
    path = given.output or RUNS / time.strftime("demo-%Y%m%d-%H%M%S")
    with output_folder(path, force=given.force) as part:
        stop = stop_on_signals()
        die_with_parent()
        screen, here = errors(), loaded.session.connect[0]
        screen.print(f"profile {loaded.name}, router at {here}, run folder {path}")
        watch = f"watch it from another terminal: vla-zenoh status --connect {here}"
        screen.print(watch, style="dim")
        if not capacity.enough:
            screen.print(capacity.said(), style="yellow")
        yield Stage(loaded, part, path, stop)


def latencies(run: Run) -> dict[str, Any]:
    """Latency from the camera's stamp to the first pose command of a chunk, and its stages, ms."""
    rows = [cause.latency_ms(stamp_ns) for cause, stamp_ns in run.first_commands()]
    stages = {name: percentiles([row[name] for row in rows]) for name in LATENCY_STAGES}
    return {**stages.pop("end_to_end"), "chunks": len(rows), "stages": stages}


def print_end(stage: Stage, summary: Mapping[str, Any], *files: str) -> None:
    """Print the latency of a run, and where its files are."""
    console().print(_latency_line(summary["latency_ms"]))
    names = ", ".join(["run.mcap", "summary.json", *files, "report.html", "video.mp4"])
    console().print(f"run folder: {stage.path} ({names})")


def _latency_line(latency: Mapping[str, Any]) -> str:
    if latency.get("p50") is None:
        return "latency: no chunk was executed"
    stages = ", ".join(
        f"{name.replace('_', ' ')} {values['p50']:.1f}"
        for name, values in latency["stages"].items()
        if values
    )
    return (
        f"latency, camera stamp to pose command: p50 {latency['p50']:.1f} ms, "
        f"p95 {latency['p95']:.1f} ms ({stages})"
    )
