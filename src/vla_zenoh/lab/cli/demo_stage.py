"""Stage of a demo: its address, run folder, nodes, recording and video."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import Progress

from vla_zenoh.cli.options import effective_profile
from vla_zenoh.cli.output import Screen, errors, progress_bars
from vla_zenoh.lab.cli.loopback import own_address
from vla_zenoh.lab.demo.video import write_video
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.lab.recording.run import Run, load_run, pictures
from vla_zenoh.profile import Profile, to_yaml
from vla_zenoh.runtime.launch import Host
from vla_zenoh.runtime.process import die_with_parent, stop_on_signals
from vla_zenoh.types import NodeStatus

MAX_LOG_LINES = 20
IMAGE_NS = 60_000_000
"""Least time between images of the video: twice its frame rate."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A profile at an address of its own, and the run folder. Made by `prepare`.

    Args:
        profile: effective.
        folder: of the run.
        stop: set by Ctrl-C.
        screen: for progress; stdout is for the summary.
    """

    profile: Profile
    folder: Path
    stop: threading.Event
    screen: Screen

    @property
    def camera(self) -> str | None:
        """The camera that is recorded; None: there is none."""
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

            # Images of one camera only: each more costs processor time.
            images = [profile.keys.camera_jpeg(self.camera)] if self.camera else []
            try:
                with Host(profile, None, log=log, tell=log, own_router=True) as running:
                    assert running.session is not None
                    bars.update(coming_up, visible=False)
                    recorder = Recorder(
                        profile,
                        running.session,
                        self.recording,
                        expressions=(*profile.keys.without_images, *images),
                    ).start()
                    try:
                        yield running, bars
                    finally:
                        recorder.close()
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

    def film(self, run: Run, marks: list[tuple[int, str]]) -> None:
        """Write front.mp4 with `marks` (ns, text) in it."""
        frames = self._frames(run)
        with progress_bars(24, self.screen, counted=False) as bars:
            filming = bars.add_task("writing front.mp4", total=max(1, len(frames)))
            written = write_video(
                self.folder / "front.mp4",
                frames,
                marks,
                lambda done, total: bars.update(filming, completed=done, total=total),
            )
            if not written:
                bars.update(filming, description="no images, no video", completed=1, total=1)

    def _frames(self, run: Run) -> list[tuple[int, bytes]]:
        frames: list[tuple[int, bytes]] = []
        for picture in pictures(run.file, self.camera) if self.camera is not None else ():
            if not frames or picture.received_ns - frames[-1][0] >= IMAGE_NS:
                frames.append((picture.received_ns, picture.jpeg))
        return frames


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
