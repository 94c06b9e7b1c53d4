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
from vla_zenoh.cli.output import Screen, errors
from vla_zenoh.lab.cli.bench_file import running_nodes
from vla_zenoh.lab.cli.loopback import own_address
from vla_zenoh.lab.cli.output import progress_bars
from vla_zenoh.lab.cli.output_path import RUNS, output_folder
from vla_zenoh.lab.evaluation.mcap_file import evaluate_parts
from vla_zenoh.lab.evaluation.plot_image import write_plot
from vla_zenoh.lab.recording.film import Film, write_film
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.recording.run import Run, load_run
from vla_zenoh.profile import Profile, to_yaml
from vla_zenoh.runtime.launch import Host
from vla_zenoh.runtime.process import die_with_parent, stop_on_signals
from vla_zenoh.types import NodeStatus


@dataclass(frozen=True, slots=True)
class Stage:
    """A profile at an address of its own, and the run folder. Made by `open_stage`.

    Args:
        screen: for progress; stdout is for the summary.
        facts: for the end of the recording, such as the verdicts.
    """

    profile: Profile
    folder: Path
    name: str
    stop: threading.Event
    screen: Screen
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def recording(self) -> Path:
        """The recording, from which all other files are made."""
        return self.folder / "run.mcap"

    @contextmanager
    def nodes(self, width: int) -> Iterator[tuple[Host, Progress]]:
        """Run and record all nodes, with progress bars; a failure shows the end of their log."""
        with progress_bars(width, self.screen) as bars:
            coming_up = bars.add_task("starting the nodes", total=None)
            with running_nodes(self.profile, self.folder / "nodes.log") as running:
                assert running.session is not None
                bars.update(coming_up, visible=False)
                recorder = Recorder(
                    self.profile,
                    running.session,
                    self.recording,
                    about={"command": shlex.join(["vla-zenoh", *sys.argv[1:]])},
                ).start()
                try:
                    yield running, bars
                finally:
                    recorder.close(self.facts)

    def recorded(self) -> Run:
        return load_run(self.recording)

    def write(self, summary: Mapping[str, Any]) -> None:
        (self.folder / "profile.yaml").write_text(to_yaml(self.profile), "utf-8")
        text = json.dumps(summary, indent=2) + "\n"
        (self.folder / "summary.json").write_text(text, "utf-8")

    def film(self, run: Run, verdicts: Sequence[tuple[int, str, bool]] = ()) -> None:
        """Write video.mp4 with `verdicts` (ns, text, success) in it."""
        with progress_bars(24, self.screen, counted=False) as bars:
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

    def draw(self, run: Run) -> None:
        """Write plot.png; of a robot of parts plot_PART.png of each."""
        with progress_bars(24, self.screen, counted=False) as bars:
            drawing = bars.add_task("drawing plots", total=len(run.part_names))
            for part, found in zip(run.part_names, evaluate_parts(run), strict=True):
                found.name = f"{self.name}/{part}" if part else self.name
                path = f"plot_{part}.png" if part else "plot.png"
                write_plot(self.folder / path, found)
                bars.update(drawing, advance=1)


@contextmanager
def open_stage(profile: str, folder: Path, *, force: bool) -> Iterator[Stage]:
    """A stage for a profile; `folder` appears when the block has ended without an exception.

    Raises:
        OutputError: the folder cannot be had; see `output_folder`.
    """
    loaded = own_address(effective_profile(profile))
    with output_folder(folder, force=force) as part:
        stop = stop_on_signals()
        die_with_parent()
        screen, here = errors(), loaded.session.connect[0]
        screen.print(f"profile {loaded.name}, router at {here}, run folder {folder}")
        watch = f"watch it from another terminal: vla-zenoh status --connect {here}"
        screen.print(watch, style="dim")
        yield Stage(loaded, part, folder.name, stop, screen)


def run_folder(given: Path | None) -> Path:
    """`given`, else a folder named by the time."""
    return given or RUNS / time.strftime("demo-%Y%m%d-%H%M%S")


def latency_line(latency: Mapping[str, Any]) -> str:
    """The latency of a run, see `vla_zenoh.lab.demo.segments.latencies`, in one line."""
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


def refusals(statuses: Mapping[str, NodeStatus]) -> dict[str, int]:
    """Rejections of all nodes, by reason."""
    out: Counter[str] = Counter()
    for status in statuses.values():
        for name, count in status.counters.items():
            if name.startswith("refused."):
                out[name.removeprefix("refused.")] += count
    return dict(sorted(out.items()))
