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
from vla_zenoh.cli.output import Screen, errors, progress_bars
from vla_zenoh.lab.cli.loopback import own_address
from vla_zenoh.lab.evaluation.mcap_file import evaluate_loaded
from vla_zenoh.lab.evaluation.plot_image import write_plot
from vla_zenoh.lab.recording.film import Film, write_film
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.recording.run import Run, load_run
from vla_zenoh.profile import Profile, to_yaml
from vla_zenoh.runtime.launch import Host
from vla_zenoh.runtime.process import die_with_parent, stop_on_signals
from vla_zenoh.types import NodeStatus

MAX_LOG_LINES = 20


@dataclass(frozen=True, slots=True)
class Stage:
    """A profile at an address of its own, and the run folder. Made by `prepare`.

    Args:
        profile: effective.
        folder: of the run.
        stop: set by Ctrl-C.
        screen: for progress; stdout is for the summary.
        facts: for the end of the recording, such as the verdicts.
    """

    profile: Profile
    folder: Path
    stop: threading.Event
    screen: Screen
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def camera(self) -> str | None:
        """The camera whose images show a task; None: there is none."""
        cameras = self.profile.cameras
        return "front" if "front" in cameras else next(iter(cameras), None)

    @property
    def recording(self) -> Path:
        """The recording, from which all other files are made."""
        return self.folder / "run.mcap"

    @contextmanager
    def nodes(self, width: int) -> Iterator[tuple[Host, Progress]]:
        """Run and record all nodes, with progress bars; a failure shows the end of their log.

        Args:
            width: of the descriptions of the bars, in characters.
        """
        profile, lines = self.profile, []
        with (
            (self.folder / "nodes.log").open("w", encoding="utf-8") as log_file,
            progress_bars(width, self.screen) as bars,
        ):
            coming_up = bars.add_task("starting the nodes", total=None)

            def log(node: str, line: str) -> None:
                log_file.write(f"{node:>16} | {line}\n")
                lines.append(f"{node}: {line}")

            try:
                with Host(profile, None, log=log, tell=log, own_router=True) as running:
                    assert running.session is not None
                    bars.update(coming_up, visible=False)
                    recorder = Recorder(
                        profile,
                        running.session,
                        self.recording,
                        about={"command": shlex.join(["vla-zenoh", *sys.argv[1:]])},
                    ).start()
                    try:
                        yield running, bars
                    finally:
                        recorder.close(self.facts)
            except Exception:
                last = "\n".join(lines[-MAX_LOG_LINES:])
                self.screen.print(last, style="dim")
                raise

    def recorded(self) -> Run:
        """Load the recording."""
        return load_run(self.recording)

    def write(self, summary: Mapping[str, Any], json_file: Path | None) -> None:
        """Write profile.yaml and summary.json, the latter also to `json_file`."""
        (self.folder / "profile.yaml").write_text(to_yaml(self.profile), "utf-8")
        text = json.dumps(summary, indent=2) + "\n"
        for path in (self.folder / "summary.json", json_file):
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, "utf-8")

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
        """Write plot.png."""
        with progress_bars(24, self.screen, counted=False) as bars:
            drawing = bars.add_task("drawing plot.png", total=1)
            write_plot(self.folder / "plot.png", evaluate_loaded(run))
            bars.update(drawing, completed=1)


def prepare(profile: str, out: Path | None) -> Stage:
    """Make a stage for a profile, in the folder `out` or one named by the time."""
    stop = stop_on_signals()
    die_with_parent()
    loaded = own_address(effective_profile(profile))
    folder = out or Path("runs") / time.strftime("demo-%Y%m%d-%H%M%S")
    folder.mkdir(parents=True, exist_ok=True)
    screen, here = errors(), loaded.session.connect[0]
    screen.print(f"profile {loaded.name}, router at {here}, run folder {folder}")
    screen.print(f"watch it from another terminal: vla-zenoh status --connect {here}", style="dim")
    return Stage(loaded, folder, stop, screen)


def refusals(statuses: Mapping[str, NodeStatus]) -> dict[str, int]:
    """Rejections of all nodes, by reason."""
    out: Counter[str] = Counter()
    for status in statuses.values():
        for name, count in status.counters.items():
            if name.startswith("refused."):
                out[name.removeprefix("refused.")] += count
    return dict(sorted(out.items()))
