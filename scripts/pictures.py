"""Makes the pictures of the docs from a recording, without a screen.

    .venv/bin/python scripts/pictures.py view RUN.mcap [--at SECONDS]    docs/images/view.png
    .venv/bin/python scripts/pictures.py report RUN...                   docs/images/report.png

`view` needs a Vulkan driver: Debian's ``mesa-vulkan-drivers`` has one that does without a GPU.
`report` needs ``chromium``.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.experimental import ViewerClient

from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.view.paths import TIMELINE
from vla_zenoh.lab.view.rerun_logger import APPLICATION, RerunLogger
from vla_zenoh.lab.view.viewer import open_headless
from vla_zenoh.profile import read_profile

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
VIEW_PX, REPORT_PX = (1600, 1000), (1500, 1720)
PATIENCE_S = 120.0
SETTLED_S = 15.0
"""All that was sent is drawn, and the viewer's own notices have gone."""


def picture_view(run: Path, at_s: float | None, out: Path) -> None:
    """Rerun's window with `run`, `at_s` after its beginning (half-way without it)."""
    file = open_recording(run)
    viewer = open_headless(*VIEW_PX)
    try:
        stream = rr.RecordingStream(APPLICATION)
        stream.connect_grpc(viewer.data_url)
        show = RerunLogger(read_profile(file.profile_yaml, str(run)), stream, keys=file.keys)
        began_ns = ended_ns = 0
        for entry in file.entries(lambda key: not key.endswith("/raw")):
            began_ns, ended_ns = began_ns or entry.received_ns, entry.received_ns
            show.log(entry)
        stream.disconnect()
        offset_ns = (ended_ns - began_ns) // 2 if at_s is None else int(at_s * 1e9)
        moment = np.datetime64(began_ns + offset_ns, "ns")
        client = ViewerClient.connect(viewer.data_url)
        insist(lambda: client.set_time(TIMELINE, timestamp=moment, play_state="paused"))
        time.sleep(SETTLED_S)
        insist(lambda: client.save_screenshot(str(out)))
    finally:
        viewer.close()


def insist(ask: Callable[[], None]) -> None:
    """Ask until the viewer answers: in software it may take a while to draw."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return ask()
        except (TimeoutError, ConnectionError, RuntimeError):
            if time.monotonic() > end_s:
                raise
            time.sleep(1.0)


def picture_report(runs: list[Path], out: Path) -> None:
    """The page of ``vla-zenoh eval -o report.html``."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit("no chromium on PATH")
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "report.html"
        words = [sys.executable, "-m", "vla_zenoh", "eval", *map(str, runs), "--output", str(page)]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        subprocess.run(
            [
                *(browser, "--headless", "--no-sandbox", "--hide-scrollbars"),
                *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
                *(f"--window-size={REPORT_PX[0]},{REPORT_PX[1]}", "--virtual-time-budget=15000"),
                *(f"--user-data-dir={folder}/profile", f"--screenshot={out}", page.as_uri()),
            ],
            check=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("view", "report"))
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--at", type=float, help="seconds after the beginning")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    out = (given.out or IMAGES / f"{given.what}.png").resolve()
    if given.what == "view":
        picture_view(given.runs[0], given.at, out)
    else:
        picture_report(given.runs, out)
    print(out)


if __name__ == "__main__":
    main()
