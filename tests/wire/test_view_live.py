"""`vla-zenoh view` beside a robot at work, and its viewer's process."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from camera_rig import until
from chain import LONG_PATIENCE_S, READY_PATIENCE_S, Chain, command_line
from view_rig import Shown
from vla_zenoh_view.listener import ViewListener
from vla_zenoh_view.viewer import open_window

from vla_zenoh.errors import NodeError

pytestmark = pytest.mark.long

ROBOT_PATIENCE_S = LONG_PATIENCE_S
END_PATIENCE_S = 30.0
STEPS, STEP_M = 5, 0.01
REACHED_M = 0.002


class Command:
    """`vla-zenoh view` in a process, and the lines it says on stderr."""

    def __init__(self, *words: str, profile: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "vla_zenoh", "view", *words],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "VLA_ZENOH_PROFILE": str(profile), "NO_COLOR": "1"},
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        self.lines += self.process.stderr

    def said(self, words: str) -> str:
        """The line that says `words`, once it is there; empty before."""
        return next((line for line in list(self.lines) if words in line), "")

    def end(self) -> int:
        """Press Ctrl-C; the exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(END_PATIENCE_S)

    def close(self) -> None:
        """End it in any case."""
        self.process.kill()
        self.process.wait()
        self._reader.join(END_PATIENCE_S)
        assert self.process.stderr is not None
        self.process.stderr.close()


@contextmanager
def view(*words: str, chain: Chain) -> Iterator[Command]:
    command = Command(*words, profile=chain.profile_file)
    try:
        yield command
    finally:
        command.close()


def two_free_ports() -> int:
    """A port, free as is the next one."""
    while True:
        with socket.socket() as first, socket.socket() as second:
            first.bind(("127.0.0.1", 0))
            port = first.getsockname()[1]
            try:
                second.bind(("127.0.0.1", port + 1))
            except (OSError, OverflowError):
                continue
            return port


def answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_a_robot_at_work_is_written_for_rerun(chain: Chain, tmp_path: Path) -> None:
    path = tmp_path / "live.rrd"
    with view("--output", str(path), chain=chain) as command:
        until("it looks", lambda: bool(command.said("viewing robot")), READY_PATIENCE_S)
        chain.client.set_prompt(f"HARD: go up x{STEPS}")
        chain.client.activate()
        chain.until("the steps are done", lambda: bool(chain.detail("policy_done")))
        chain.wait_still()
        assert command.end() == 0
    assert command.said("samples of"), command.lines
    assert not command.said("not shown"), command.lines
    shown = Shown(path)
    heights = [row[0][2] for row in shown.values("world/pose/measured", "Transform3D:translation")]
    assert heights[-1] - heights[0] == pytest.approx(STEPS * STEP_M, abs=REACHED_M)
    assert {"camera/front", "world/robot/panda_hand", "plot/latency/inference"} <= shown.paths
    assert len(shown.values("world/chunk/scripted", "LineStrips3D:strips")) >= STEPS
    assert f"HARD: go up x{STEPS}" in shown.texts("text/now")[-1]
    assert f"prompt: HARD: go up x{STEPS}" in shown.texts("events/settings")


def test_what_it_cannot_keep_is_counted(chain: Chain) -> None:
    listener = ViewListener(chain.session, chain.profile, queue_bytes=100)
    until("something is left out", lambda: listener.dropped.total() > 10)
    listener.close()
    assert sum(len(sample.payload) for sample in listener.take()) <= 100
    assert listener.take() == []


def test_without_a_screen_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(NodeError, match=r"no screen here.*--serve.*-o FILE\.rrd"):
        open_window()


@pytest.mark.slow
def test_the_served_view_ends_with_ctrl_c_and_leaves_no_process(chain: Chain) -> None:
    port = two_free_ports()
    with view("--serve", "--port", str(port), chain=chain) as command:
        until("it looks", lambda: bool(command.said("viewing robot")), READY_PATIENCE_S)
        assert f"http://127.0.0.1:{port}/?url=rerun%2Bhttp" in command.said("open in a browser")
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=10) as page:
            assert b"rerun" in page.read().lower()
        taken = command_line("view", "--serve", "--port", str(port), profile=chain.profile_file)
        assert taken.returncode == 1
        assert "cannot be listened at" in taken.stderr
        assert command.end() == 0
    assert not answers(port)
    assert not answers(port + 1)


@pytest.mark.slow
def test_it_ends_when_the_viewer_is_closed(chain: Chain) -> None:
    port = two_free_ports()
    with view("--serve", "--port", str(port), chain=chain) as command:
        until("it looks", lambda: bool(command.said("viewing robot")), READY_PATIENCE_S)
        (viewer,) = children(command.process.pid)
        os.kill(viewer, signal.SIGKILL)
        assert command.process.wait(END_PATIENCE_S) == 0


def children(pid: int) -> list[int]:
    folders = Path(f"/proc/{pid}/task").iterdir()
    return [int(word) for folder in folders for word in (folder / "children").read_text().split()]
