"""Makes the pictures of the docs from the run folder of a demo, without a screen.

    vla-zenoh demo -o runs/demo
    python scripts/pictures.py runs/demo             # all of docs/images
    python scripts/pictures.py runs/demo view        # only docs/images/view.jpg
    python scripts/pictures.py runs/demo status_sim status_dry_run status_missing

The three of `status` start nodes of their own and do not use the run folder. `view` needs a Vulkan
driver: Debian's ``mesa-vulkan-drivers`` has one that does without a GPU.
`report`, `report_dark` and `report_phone` need ``chromium``.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr
from rerun.experimental import ViewerClient
from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console
from rich.terminal_theme import MONOKAI
from rich.text import Text
from vla_zenoh_view.paths import TIMELINE
from vla_zenoh_view.rerun_logger import APPLICATION, RerunLogger
from vla_zenoh_view.viewer import open_window

from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.profile import read_profile

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
VIEW_PX, REPORT_PX, PHONE_PX = (1600, 1000), (1500, 1330), (500, 1500)
AT_S = 4.2
"""The first brick is in the gripper."""
MOST_BYTES = 200_000
FILM_PX, FILM_HZ, FILM_BYTES = (800, 325), 7.5, 3_000_000
"""Of the moving picture."""
DARK = ("--force-dark-mode", "--blink-settings=preferredColorScheme=0")
STATUS_COLUMNS = 116
UP_WORDS = {"sim": (), "dry_run": ("--dry-run",), "missing": ("--host", "robot")}
LAB = """\
extends: panda_sim
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
"""
FAULTY = """\
cameras: {wrist: {source: "v4l2:/dev/video0"}}
workers: [scripted, reach, big]
models: {reach: ./reach.py, big: ./reach.py}
hosts:
  robot: {nodes: [router, sim, camera, command, worker], workers: [scripted, reach]}
  gpu: {nodes: [worker], workers: [big]}
"""
REACH = """\
from vla_zenoh.policy import ActionSpec, ModelSpec, ObservationSpec


class Reach:
    spec = ModelSpec(
        name="reach",
        observation=ObservationSpec(),
        action=ActionSpec(horizon=1, dt_s=0.2, rotation="rpy", gripper="none"),
    )

    def load(self):
        open("/data/reach/weights.pt")

    def infer(self, observation): ...
"""
PATIENCE_S = 120.0
SETTLED_S = 15.0
"""All that was sent is drawn, and the viewer's own notices have gone."""


def picture_view(run: Path, at_s: float, out: Path) -> None:
    """Rerun's window with `run`, `at_s` after the first activation."""
    file = open_recording(run)
    viewer = open_window("--headless", "--window-size", "{}x{}".format(*VIEW_PX))
    try:
        stream = rr.RecordingStream(APPLICATION)
        stream.connect_grpc(viewer.data_url)
        show = RerunLogger(read_profile(file.profile_yaml, str(run)), stream, keys=file.keys)
        for entry in file.entries(lambda key: not key.endswith("/raw")):
            show.log(entry)
        stream.disconnect()
        active_ns = next(e.received_ns for e in load_run(run).tasks if e.record.active)
        moment = np.datetime64(active_ns + int(at_s * 1e9), "ns")
        client = ViewerClient.connect(viewer.data_url)
        insist(lambda: client.set_time(TIMELINE, timestamp=moment, play_state="paused"))
        time.sleep(SETTLED_S)
        insist(lambda: client.save_screenshot(str(out)))
    finally:
        viewer.close()


def insist(ask: Callable[[], object]) -> None:
    """Ask until the viewer answers: in software it may take a while to draw."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            ask()
            return
        except (TimeoutError, ConnectionError, RuntimeError):
            if time.monotonic() > end_s:
                raise
            time.sleep(1.0)


def picture_report(run: Path, out: Path, size: tuple[int, int], *more: str) -> None:
    """The page of ``vla-zenoh eval -o report.html``."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit("no chromium on PATH")
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "report.html"
        words = [sys.executable, "-m", "vla_zenoh", "eval", str(run), "--output", str(page)]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        subprocess.run(
            [
                *(browser, "--headless", "--no-sandbox", "--hide-scrollbars", "--disable-gpu"),
                *(f"--window-size={size[0]},{size[1]}", "--virtual-time-budget=8000", *more),
                *(f"--user-data-dir={folder}/profile", f"--screenshot={out}", page.as_uri()),
            ],
            check=True,
            stderr=subprocess.DEVNULL,  # that it has no desktop
        )


def picture_status(state: str, out: Path) -> None:
    """``vla-zenoh status --once``: an arm that moves, a dry run, or a lab in which nodes miss."""
    with tempfile.TemporaryDirectory() as folder, socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        lab = Path(folder) / "lab.yaml"
        text = LAB.format(endpoint=f"tcp/127.0.0.1:{probe.getsockname()[1]}")
        probe.close()
        (lab.parent / "reach.py").write_text(REACH)
        lab.write_text(text + FAULTY * (state == "missing"))

        def run(*words: str) -> str:
            look = {"FORCE_COLOR": "1", "COLUMNS": str(STATUS_COLUMNS), "TERM": "xterm-256color"}
            done = subprocess.run(
                [sys.executable, "-m", "vla_zenoh", *words],
                env={**os.environ, **look, "VLA_ZENOH_PROFILE": str(lab)},
                capture_output=True,
                text=True,
            )
            if done.returncode:
                raise RuntimeError(done.stderr)
            return done.stdout

        words = ["up", str(lab), "--log-dir", folder, *UP_WORDS[state]]
        up = subprocess.Popen(
            [sys.executable, "-m", "vla_zenoh", *words], stdout=subprocess.DEVNULL
        )
        try:
            insist(lambda: run("prompt", "HARD: yaw left x50"))
            if state == "missing":
                insist(lambda: crashed(json.loads(run("status", "--json"))))
            else:
                insist(lambda: run("activate"))
            time.sleep(2.0)
            shown = run("status", "--once")
        finally:
            up.terminate()
            up.wait()
    screen = Console(record=True, width=STATUS_COLUMNS, file=io.StringIO())
    screen.print(Text.from_ansi(shown.rstrip()), soft_wrap=True)
    plain = re.sub(r"@font-face {{.*?}}", "", CONSOLE_SVG_FORMAT, flags=re.S)  # no downloads
    out.write_text(screen.export_svg(title="vla-zenoh status", code_format=plain, theme=MONOKAI))


def crashed(status: dict[str, Any]) -> None:
    """Raise until the model without weights has been given up."""
    if "crashed 6" not in status["nodes"]["worker-reach"]["why"]:
        raise RuntimeError("not yet")


def picture_demo(video: Path, out: Path) -> None:
    """The video of a demo as an animated WebP of at most `FILM_BYTES`."""
    source = cv2.VideoCapture(str(video))
    every = round(source.get(cv2.CAP_PROP_FPS) / FILM_HZ)
    frames: list[cv2.typing.MatLike] = []
    while source.grab():
        if source.get(cv2.CAP_PROP_POS_FRAMES) % every == 0:
            frames.append(cv2.resize(source.retrieve()[1], FILM_PX, interpolation=cv2.INTER_AREA))
    film = cv2.Animation()
    film.frames = frames
    film.durations = [round(1000 / FILM_HZ)] * len(frames)
    for quality in range(80, 20, -10):
        cv2.imwriteanimation(str(out), film, [cv2.IMWRITE_WEBP_QUALITY, quality])
        if out.stat().st_size <= FILM_BYTES:
            return
    sys.exit(f"{out} has {out.stat().st_size} bytes, at most {FILM_BYTES}")


def small(picture: Path, out: Path) -> None:
    """`picture` as JPEG of at most `MOST_BYTES`."""
    for quality in range(92, 20, -4):
        cv2.imwrite(str(out), cv2.imread(str(picture)), [cv2.IMWRITE_JPEG_QUALITY, quality])
        if out.stat().st_size <= MOST_BYTES:
            return
    sys.exit(f"{out} has {out.stat().st_size} bytes, at most {MOST_BYTES}")


def main() -> None:
    states = ("status_sim", "status_dry_run", "status_missing")
    names = ("demo", "tasks", "report", "report_dark", "report_phone", "view", *states)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="run folder of a demo")
    parser.add_argument("what", choices=[*names, []], nargs="*")
    parser.add_argument("--at", type=float, default=AT_S, help="s after activation")
    given = parser.parse_args()
    file = given.run / "run.mcap"
    with tempfile.TemporaryDirectory() as folder:
        png = Path(folder) / "picture.png"
        for name in given.what or names:
            if name in states:
                picture_status(name.removeprefix("status_"), IMAGES / f"{name}.svg")
                continue
            if name == "demo":
                picture_demo(given.run / "video.mp4", IMAGES / "demo.webp")
                print(IMAGES / "demo.webp")
                continue
            if name == "tasks":
                png.write_bytes((given.run / "tasks.jpg").read_bytes())
            elif name == "view":
                picture_view(file, given.at, png)
            elif name == "report":
                picture_report(file, png, REPORT_PX)
            elif name == "report_dark":
                picture_report(file, png, REPORT_PX, *DARK)
            else:
                picture_report(file, png, PHONE_PX, *DARK)
            small(png, IMAGES / f"{name}.jpg")
            print(IMAGES / f"{name}.jpg")


if __name__ == "__main__":
    main()
