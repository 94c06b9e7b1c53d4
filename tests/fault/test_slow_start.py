"""`up` on a computer as slow as a Raspberry Pi: slow to start is not hung."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from camera_rig import free_endpoint, until
from test_supervisor import up

pytestmark = [
    pytest.mark.long,
    pytest.mark.realtime,
    pytest.mark.timeout(900),
    pytest.mark.skipif(sys.platform != "linux", reason="processes are kept on one core"),
]
BUSY = 3
PATIENCE_S = 300.0


@pytest.fixture
def one_busy_core() -> Iterator[None]:
    """One core for whatever is started here, beside `BUSY` others that compute."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    with ExitStack() as stack:
        for _ in range(BUSY):
            process = subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"])
            stack.enter_context(process)
            stack.callback(process.kill)
        yield
    os.sched_setaffinity(0, allowed)


@pytest.mark.usefixtures("one_busy_core")
def test_an_so101_on_a_quarter_of_a_core_becomes_ready_and_nothing_is_restarted(
    tmp_path: Path,
) -> None:
    path, at = tmp_path / "slow.yaml", free_endpoint()
    path.write_text(f"extends: so101_sim\nsession: {{listen: [{at}], connect: [{at}]}}\n")
    with up(str(path), "--log-dir", str(tmp_path)) as running:
        until("all nodes are ready", lambda: "ready: " in running.text, PATIENCE_S)
    said = running.text
    for word in ("killed", "exited", "starting again", "hangs", "silent"):
        assert word not in said, said
