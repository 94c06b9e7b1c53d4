"""Who goes first on a busy computer: seen by the kernel's own word for each thread."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from camera_rig import free_endpoint, until

from vla_zenoh.bus.session import open_session
from vla_zenoh.profile import SessionProfile
from vla_zenoh.runtime.process import LINK_PRIORITY, realtime_links, realtime_thread

pytestmark = pytest.mark.long

ZENOHS = ("rx-", "net-")
"""How Zenoh names the threads that carry what arrives."""


def policy(thread_id: int = 0) -> int:
    return os.sched_getscheduler(thread_id) & ~os.SCHED_RESET_ON_FORK


@pytest.fixture(autouse=True)
def _allowed() -> None:
    with realtime_thread() as granted:
        if not granted:
            pytest.skip("no real-time priority for this user: `vla-zenoh doctor`")


def test_what_a_control_loop_starts_does_not_run_at_its_priority() -> None:
    before, inside = policy(), list[int]()
    with realtime_thread():
        assert policy() == os.SCHED_FIFO
        thread = threading.Thread(target=lambda: inside.append(policy()))
        thread.start()
        thread.join()
        tell = "import os; print(os.sched_getscheduler(0))"
        told = subprocess.run([sys.executable, "-c", tell], capture_output=True, check=True)
    assert inside == [os.SCHED_OTHER]
    assert int(told.stdout) == os.SCHED_OTHER
    assert policy() == before


def test_whoever_opens_links_keeps_his_own_priority() -> None:
    before = policy()
    with realtime_links() as granted:
        assert granted
    assert policy() == before


def test_the_links_of_a_router_go_before_other_programs() -> None:
    endpoint = free_endpoint()
    words = [sys.executable, "-m", "vla_zenoh", "node", "router", "--listen", endpoint]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL) as router:
        try:
            open_session(SessionProfile(connect=(endpoint,)), wait_s=20.0).close()

            def carriers() -> dict[str, int]:
                tasks = Path(f"/proc/{router.pid}/task")
                names = {int(task.name): (task / "comm").read_text() for task in tasks.iterdir()}
                return {n.strip(): t for t, n in names.items() if n.startswith(ZENOHS)}

            until("Zenoh has threads", lambda: len(carriers()) >= len(ZENOHS))
            for name, thread_id in carriers().items():
                assert policy(thread_id) == os.SCHED_FIFO, name
                assert os.sched_getparam(thread_id).sched_priority == LINK_PRIORITY, name
        finally:
            router.terminate()
