"""Shared memory and processes that may lock little of it, and cameras that are restarted.

Nodes run in processes of their own: what a process maps it keeps until it ends.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from camera_rig import free_endpoint, until
from mcap.reader import make_reader

from vla_zenoh.bus.shared_memory import SENDER_BYTES, held_bytes, lockable_bytes

pytestmark = [
    pytest.mark.long,
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux"),
]
SENDER = Path(__file__).parent / "image_sender.py"
PROGRAM = (sys.executable, "-m", "vla_zenoh")
LITTLE = (
    *("setpriv", "--bounding-set", "-ipc_lock", "--inh-caps", "-ipc_lock", "--ambient-caps"),
    *("-all", "prlimit", "--memlock=8388608:8388608", "setpriv", "--reuid", "0"),
)
"""As an ordinary shell: 8 MiB, and no capability."""
as_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can take the capability away")
PATIENCE_S = 60.0


class Lab:
    """A router, a sender of images and recorders, each a process."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack, self._folder, self._size = stack, folder, 0
        self.endpoint = free_endpoint()

    def start(self, *words: str, prefix: tuple[str, ...] = ()) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [*prefix, *words],
            cwd=self._folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._stack.enter_context(process)
        self._stack.callback(process.kill)
        return process

    def router(self, prefix: tuple[str, ...] = ()) -> subprocess.Popen[str]:
        words = (*PROGRAM, "node", "router", "--listen", self.endpoint)
        return self.start(*words, prefix=prefix)

    def sender(self, *more: str) -> subprocess.Popen[str]:
        return self.start(sys.executable, str(SENDER), self.endpoint, *more)

    def recorder(
        self, name: str, *more: str, prefix: tuple[str, ...] = ()
    ) -> subprocess.Popen[str]:
        words = ("record", "-e", self.endpoint, "-o", f"{name}.mcap", "--name", name, *more)
        return self.start(*PROGRAM, *words, prefix=prefix)

    def grown(self) -> bool:
        """Whether the recording `reader` grew by some images since the last time it had."""
        path = self._folder / "reader.part.mcap"
        size = path.stat().st_size if path.exists() else 0
        if size < self._size + 2_000_000:
            return False
        self._size = size
        return True

    def ended(self, recorder: subprocess.Popen[str], name: str) -> tuple[int, str, int]:
        """Exit status, output, and images in the file."""
        said, _ = recorder.communicate(timeout=PATIENCE_S)
        with (self._folder / f"{name}.mcap").open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        counts = summary.statistics.channel_message_counts
        images = sum(n for i, n in counts.items() if "/jpeg" in summary.channels[i].topic)
        return recorder.returncode, said, images


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with ExitStack() as stack:
        yield Lab(stack, tmp_path)


def locked_bytes(pid: int) -> int:
    rows = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(row for row in rows if row.startswith("VmLck")).split()[1]) * 1024


@as_root
@pytest.mark.parametrize("limited", ["recorder", "router"])
def test_a_program_that_may_lock_little_records_as_many_images_as_one_that_may(
    lab: Lab, limited: str
) -> None:
    lab.router(LITTLE if limited == "router" else ())
    lab.sender()
    little = lab.recorder("little", "-s", "8", prefix=LITTLE)
    free = lab.recorder("free", "-s", "8")
    code, said, images = lab.ended(little, "little")
    other_code, _, other_images = lab.ended(free, "free")
    assert (code, other_code) == (0, 0), said
    assert "may lock 8 MiB of memory" in said
    assert images > 30
    assert abs(images - other_images) < 0.2 * images  # they begin at different times


@as_root
def test_a_recorder_that_gets_few_of_the_images_says_so_and_fails(lab: Lab) -> None:
    """A reader that keeps shared memory on although it may lock little, as any other program."""
    lab.router()
    lab.sender()
    keeps_it = (
        "from vla_zenoh.bus import session; session.obstacle = lambda: ''; import sys; "
        "from vla_zenoh.program.entry import main; main()"
    )
    words = ("record", "-e", lab.endpoint, "-o", "deaf.mcap", "-s", "10", "--json")
    deaf = lab.start(sys.executable, "-c", keeps_it, *words, prefix=LITTLE)
    code, said, images = lab.ended(deaf, "deaf")
    assert code == 1, said
    assert images < 10
    assert "--min-share 0.95" in said
    assert "camera/front/jpeg" in said
    assert "vla-zenoh doctor" in said


@pytest.mark.skipif(lockable_bytes() is not None, reason="this user may lock too little")
def test_cameras_that_are_killed_and_restarted_leave_no_more_than_the_bound(lab: Lab) -> None:
    router = lab.router()
    reader = lab.recorder("reader")
    before = held_bytes()
    bound = before + 3 * SENDER_BYTES
    for _ in range(10):
        sender = lab.sender(str(bound))
        until("images arrive", lab.grown, PATIENCE_S)
        sender.send_signal(signal.SIGKILL)
        sender.wait(PATIENCE_S)
    most = 4 * SENDER_BYTES
    assert SENDER_BYTES / 2 < locked_bytes(router.pid) < most
    assert locked_bytes(reader.pid) < most
    assert held_bytes() - before < most
