"""python -m benchmarks web: the operator's page in headless Chromium, at a simulated robot.

Measures from a touch on STOP to an arm that stands, how an arm brakes whose page vanishes, what the
page costs, and makes the screenshots of the docs. Needs Debian's ``chromium`` and
``chromium-driver``,
and ``pip install selenium`` beside the package ``vla-zenoh-web``.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Annotated, Any
from urllib.request import Request, urlopen

import cv2
import numpy as np
import typer
import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.cli.options import effective_profile
from vla_zenoh.cli.output import console, errors, new_table
from vla_zenoh.codec import records
from vla_zenoh.errors import NodeError, VlaZenohError
from vla_zenoh.lab.cli.loopback import free_port, own_address
from vla_zenoh.profile import Profile, override, to_yaml
from vla_zenoh.runtime.launch import Host
from vla_zenoh.types import PoseState

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
RATE_HZ = 20.0
FAST_M_S, MOVES_M_S, STANDS_M_S, WATCH_S = 0.18, 0.03, 0.002, 0.3
LOW_M, HIGH_M = 0.35, 0.5
PATIENCE_S, READY_S = 20.0, 60.0
TOKEN = "token-of-this-benchmark"
PICTURE_TRIES = 8
MOST_BYTES = 180_000
SHOTS = {
    # name -> width, height, dark
    "web_desktop": (1440, 1130, False),
    "web_tablet": (820, 1180, True),
    "web_phone": (390, 844, False),
    "web_desktop_dark": (1440, 1130, True),
    "web_tablet_light": (820, 1180, False),
    "web_phone_dark": (390, 844, True),
}
KEPT = ("web_desktop", "web_tablet", "web_phone")
"""Shown in the docs; the others are for inspection."""
SMALL = {name: {"width": 320, "height": 240, "rate_hz": 10} for name in ("front", "wrist")}
"""Images of the pictures: nothing is measured, and a busy computer keeps up with them."""
KEEP_OUT = {"post": {"centre_m": [0.62, -0.3, 0.35], "box_m": [0.06, 0.06, 0.7]}}


def web(
    times: Annotated[int, typer.Option("--times", min=1, help="Stops that are measured.")] = 30,
    seconds: Annotated[
        float, typer.Option("--seconds", min=5, help="How long each load is measured.")
    ] = 20.0,
    pictures: Annotated[
        Path | None, typer.Option("--pictures", help="Only make the pictures, into this folder.")
    ] = None,
) -> None:
    """Measure the operator's page in headless Chromium: stop, vanished pages, cost."""
    profile = override(
        own_address(effective_profile("panda_sim")),
        {
            **({} if pictures is None else {"cameras": SMALL}),
            "task": {"rate_hz": RATE_HZ},
            "limits": {"reach": {"keep_out": KEEP_OUT}},
            # A busy computer must not brake the arm before the stop does.
            "timing": {"command_timeout_s": 0.5, "state_timeout_s": 0.5},
        },
    )
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        host = stack.enter_context(Host(profile, None, log=lambda *_: None, tell=lambda *_: None))
        lab = Lab(profile, host, folder)
        stack.callback(lab.close)
        if pictures is not None:
            lab.pictures(pictures)
            return
        lab.measure_stops(times)
        lab.measure_vanishing()
        lab.measure_cost(seconds)


class Lab:
    """A simulated robot that goes up and down, and the server of its page."""

    def __init__(self, profile: Profile, host: Host, folder: Path) -> None:
        assert host.session is not None
        assert host.client is not None
        self.profile, self._client, self._up = profile, host.client, True
        self._host = host
        self._wanted_m_s = FAST_M_S
        self._speed_m_s, self._z_m, self._slow_since_s = 0.0, 0.0, 0.0
        self._subscriber = host.session.declare_subscriber(
            profile.keys.state_pose, zenoh.handlers.Callback(self._on_pose, indirect=False)
        )
        self._file, people = folder / "robot.yaml", folder / "people.yaml"
        self._file.write_text(to_yaml(profile), "utf-8")
        people.write_text(json.dumps({"anna": {"role": "operator", "token": TOKEN}}))
        people.chmod(0o600)
        self._port = free_port()
        words = ["web", "--profile", self._file, "--port", self._port, "--people", people]
        self._server = subprocess.Popen(
            [sys.executable, "-m", "vla_zenoh", *map(str, words)],
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder,
        )
        assert self._server.stderr is not None
        self._server.stderr.readline()
        self._until("a robot", lambda: "worker-scripted" in self._client.alive, READY_S)

    def close(self) -> None:
        """End the server."""
        self._server.send_signal(signal.SIGINT)
        self._server.wait(PATIENCE_S)

    def _on_pose(self, sample: zenoh.Sample) -> None:
        pose = records.decode(PoseState, bytes_of(sample.payload))
        self._z_m = float(pose.position_m[2])
        self._speed_m_s = float(np.linalg.norm(pose.twist[:3]))
        if self._speed_m_s > STANDS_M_S:
            self._slow_since_s = 0.0
        elif not self._slow_since_s:
            self._slow_since_s = time.time()

    def _stood_s(self) -> float:
        """When it came to rest, once it has been slow for a while."""
        since_s = self._slow_since_s
        return since_s if since_s and time.time() - since_s > WATCH_S else 0.0

    def _until(self, what: str, ask: Callable[[], Any], patience_s: float = PATIENCE_S) -> Any:
        give_up_s = time.monotonic() + patience_s
        while not (found := ask()):
            self._host.poll()
            if time.monotonic() > give_up_s:
                raise NodeError(f"waited for {what} for {patience_s:g} s")
            time.sleep(0.002)
        return found

    def _turn(self) -> None:
        """The prompt of the next motion, away from the nearer end."""
        self._up = self._z_m < (LOW_M + HIGH_M) / 2
        self._client.set_prompt("HARD: go up" if self._up else "HARD: go down")

    def _runs(self, begin: Callable[[], Any], again: Callable[[], Any]) -> None:
        """`begin` a motion until it is fast; `again` before another try."""
        for _ in range(10):
            self._client.publish(self._client.keys.reset, "reset")
            self._turn()
            begin()
            try:
                self._until("a motion", lambda: self._speed_m_s > self._wanted_m_s, 3.0)
                return
            except NodeError as error:
                errors().print(str(error), style="dim")
                again()
        raise NodeError(
            f"the arm does not get to {self._wanted_m_s:g} m/s: this computer is too busy"
        )

    # -- the browser --------------------------------------------------------------------------
    @contextmanager
    def browser(self, width: int = 1440, height: int = 1000) -> Iterator[Any]:
        """Headless Chromium with an open page."""
        try:
            from selenium import webdriver  # pyright: ignore[reportMissingImports]
            from selenium.webdriver.chrome.service import (  # pyright: ignore[reportMissingImports]
                Service,
            )
        except ImportError as error:
            raise NodeError(f"{error}: pip install selenium") from error
        options = webdriver.ChromeOptions()
        options.binary_location = "/usr/bin/chromium"
        for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--mute-audio"):
            options.add_argument(word)
        options.add_argument(f"--window-size={width},{height}")
        self._user_data = tempfile.mkdtemp(prefix="web-page-")  # identifies its processes
        options.add_argument(f"--user-data-dir={self._user_data}")
        driver = webdriver.Chrome(options=options, service=Service("/usr/bin/chromedriver"))
        try:
            self.open(driver)
            yield driver
        finally:
            driver.quit()
            for pid in self._chromium():  # what a killed driver leaves behind
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            shutil.rmtree(self._user_data, ignore_errors=True)

    def _chromium(self) -> list[int]:
        """The processes of the browser; it leaves its driver's family."""
        found: list[int] = []
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            with suppress(OSError):
                if f"--user-data-dir={self._user_data}".encode() in path.read_bytes():
                    found += _family(int(path.parent.name))
        return list(dict.fromkeys(found))

    def open(self, driver: Any) -> None:
        """Open the page in the tab of `driver`."""
        driver.get(f"http://127.0.0.1:{self._port}/#{TOKEN}")
        self._until("a page", lambda: "connected" in driver.find_element("id", "link").text)

    @staticmethod
    def _centre(driver: Any, name: str) -> dict[str, float]:
        box = driver.execute_script(
            f"const b = document.getElementById('{name}').getBoundingClientRect();"
            "return [b.x + b.width / 2, b.y + b.height / 2]"
        )
        return {"x": box[0], "y": box[1]}

    def _touch(self, driver: Any, name: str, kind: str) -> None:
        """A real touch: it goes through Chromium's own input."""
        points = [self._centre(driver, name)] if kind == "touchStart" else []
        driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    # -- measurements -------------------------------------------------------------------------
    def measure_stops(self, times: int) -> None:
        """From the touch to the measured arm at rest."""
        client, rows = self._client, []
        with self.browser() as driver:
            for _ in range(times):
                self._runs(lambda: self._try(client.activate), lambda: None)
                where = {"type": "touchStart", "touchPoints": [self._centre(driver, "stop")]}
                began_s = time.time()
                driver.execute_cdp_cmd("Input.dispatchTouchEvent", where)
                stood_s = self._until("an arm that stands", self._stood_s)
                self._touch(driver, "stop", "touchEnd")
                shown = self._until(
                    "the page's word",
                    lambda: driver.execute_script(
                        "const w = document.getElementById('stop-words');"
                        "return w.textContent.includes('stood at') && w.dataset.standsMs"
                    ),
                )
                rows.append((1e3 * (stood_s - began_s), float(shown)))
                driver.execute_script("document.getElementById('stop-words').textContent = ''")
        stands, shown = zip(*rows, strict=True)
        table = new_table("touch on STOP at 0.2 m/s", "times", "median ms", "worst ms")
        table.add_row("until the arm stands", str(times), *_figures(stands))
        table.add_row("until the page says so", str(times), *_figures(shown))
        console().print(table)

    @staticmethod
    def _try(call: Callable[[], Any]) -> None:
        try:
            call()
        except VlaZenohError as error:
            errors().print(str(error), style="dim")

    def _hold(self, driver: Any) -> None:
        """Touch the button and keep it, until the arm is fast."""

        def again() -> None:
            said = [driver.find_element("id", name).text for name in ("answer", "facts")]
            errors().print(f"{said}", style="dim")
            self._touch(driver, "hold", "touchEnd")

        self._runs(lambda: self._touch(driver, "hold", "touchStart"), again)

    def measure_vanishing(self, times: int = 10) -> None:
        """Hold the button, then lose the page; until the measured arm is at rest."""
        table = new_table("while held at 0.2 m/s", "times", "median ms", "worst ms")
        for what, number in (
            ("Chromium killed", signal.SIGKILL),
            ("Chromium frozen", signal.SIGSTOP),
        ):
            taken = []
            for _ in range(times):
                taken.append(self._vanish(number))
            table.add_row(f"{what}, until the arm stands", str(times), *_figures(taken))
        console().print(table)

    def _vanish(self, number: int) -> float:
        with self.browser() as driver:
            self._hold(driver)
            family = self._chromium()
            began_s = time.time()
            for pid in family:
                os.kill(pid, number)
            stood_s = self._until("an arm that stands", self._stood_s)
            for pid in family:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            return 1e3 * (stood_s - began_s)

    def measure_cost(self, seconds: float) -> None:
        """Images and processor time with one page and with five, and the arm's own loop."""
        table = new_table(
            "open pages", "pictures/s each", "ms old", "server, cores", "kbit/s each",
            "late ms p99", "worst", "missed ticks",
        )  # fmt: skip
        for pages in (0, 1, 5):
            with ExitStack() as stack:
                drivers = []
                if pages:
                    driver = stack.enter_context(self.browser())
                    for _ in range(pages - 1):
                        driver.switch_to.new_window("window")
                        self.open(driver)
                    drivers = [(driver, handle) for handle in driver.window_handles]
                table.add_row(str(pages), *self._cost(drivers, seconds))
        console().print(table)

    def _cost(self, pages: list[tuple[Any, str]], seconds: float) -> list[str]:
        self._try(lambda: (self._turn(), self._client.set_prompt("hold"), self._client.activate()))
        time.sleep(9.0)  # the window of the loop's distribution
        missed, cpu_s, sent = self._missed(), _cpu_s(self._server.pid), self._sent()
        time.sleep(seconds)
        cores = (_cpu_s(self._server.pid) - cpu_s) / seconds
        sent = (self._sent() - sent) / seconds
        status = self._client.status("command")
        late = status.detail.get("late_us", {}) if status is not None else {}
        missed = self._missed() - missed
        views = []
        for driver, handle in pages:
            driver.switch_to.window(handle)
            views += driver.execute_script("return [...shown.values()].map((v) => v.last)")
        self._client.publish(self._client.keys.active, "false")
        hz = [view["hz"] for view in views if view]
        old_ms = [view["ms"] for view in views if view]
        return [
            f"{median(hz):.0f} x {len(hz) // len(pages)}" if hz else "",
            f"{median(old_ms):.0f}" if old_ms else "",
            f"{cores:.2f}",
            f"{8e-3 * sent / len(pages):,.0f}" if pages else "",
            f"{late.get('p99', 0) / 1e3:.2f}",
            f"{late.get('max', 0) / 1e3:.2f}",
            str(missed),
        ]

    def _sent(self) -> float:
        """Bytes of images sent so far, by the server's own metrics."""
        asked = Request(f"http://127.0.0.1:{self._port}/metrics")
        asked.add_header("Authorization", f"Bearer {TOKEN}")
        with urlopen(asked) as answer:
            lines = answer.read().decode().splitlines()
        named = "vla_zenoh_web_sent_bytes_total{"
        return sum(float(line.split()[-1]) for line in lines if line.startswith(named))

    def _missed(self) -> int:
        status = self._client.status("command")
        return status.counters.get("command.missed_ticks", 0) if status is not None else 0

    # -- pictures -----------------------------------------------------------------------------
    def pictures(self, folder: Path) -> None:
        """The page in every size of `SHOTS`; those in `KEPT` also as JPEG for the docs."""
        folder.mkdir(parents=True, exist_ok=True)
        self._wanted_m_s = MOVES_M_S
        with self.browser() as driver:
            driver.get_screenshot_as_png()  # the first one holds the page up, which ends a hold
            for name, (width, height, dark) in SHOTS.items():
                size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
                driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
                scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
                driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
                png = self._picture(driver)
                (folder / f"{name}.png").write_bytes(png)
                if name in KEPT:
                    _save_jpeg(cv2.imdecode(np.frombuffer(png, np.uint8), 1), folder, name)
                errors().print(f"{folder / name}.png")

    def _picture(self, driver: Any) -> bytes:
        """The page while the arm moves; again where making the picture held the page up."""
        for _ in range(PICTURE_TRIES):
            self._hold(driver)
            time.sleep(0.7)
            png = driver.get_screenshot_as_png()
            held = driver.execute_script("return holding !== 0 && state.state === 'active'")
            self._touch(driver, "hold", "touchEnd")
            if held:
                return png
        raise NodeError("making a picture ends the hold: this computer is too busy")


def _save_jpeg(image: Any, folder: Path, name: str) -> None:
    data = b""
    for quality in range(92, 30, -4):
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= MOST_BYTES:
            break
    (folder / f"{name}.jpg").write_bytes(data)


def _figures(values: Any) -> tuple[str, str]:
    return f"{median(values):.0f}", f"{max(values):.0f}"


def _family(pid: int) -> list[int]:
    """A process and all below it."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    children = [child for task in tasks for child in task.read_text().split()]
    return [one for child in children for one in _family(int(child))] + [pid]


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
