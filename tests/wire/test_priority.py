"""Who goes first on a busy computer: seen by the kernel's own word for each thread."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from camera_rig import free_endpoint, until

from vla_zenoh.bus.session import open_session
from vla_zenoh.profile import SessionProfile, load_profile
from vla_zenoh.runtime.process import (
    LINK_PRIORITY,
    PARENT_VARIABLE,
    realtime_links,
    realtime_thread,
)

pytestmark = pytest.mark.long

ZENOHS = ("rx-", "net-")
"""How Zenoh names the threads that carry what arrives."""
START_S = 30.0


def policy(thread_id: int = 0) -> int:
    return os.sched_getscheduler(thread_id) & ~os.SCHED_RESET_ON_FORK


def threads(pid: int) -> dict[int, str]:
    """Name of each thread of a process, by its id."""
    tasks = Path(f"/proc/{pid}/task")
    return {int(task.name): (task / "comm").read_text().strip() for task in tasks.iterdir()}


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


@contextmanager
def program(*words: str) -> Iterator[int]:
    """The process id of a program that runs under this one."""
    # Threads of numpy have no part in the GIL; with one there are none.
    environment = os.environ | {PARENT_VARIABLE: str(os.getpid()), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "vla_zenoh", "node", *words]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, env=environment) as node:
        try:
            yield node.pid
        finally:
            node.terminate()


def test_the_links_of_a_router_go_before_other_programs() -> None:
    endpoint = free_endpoint()
    with program("router", "--listen", endpoint) as router:
        open_session(SessionProfile(connect=(endpoint,)), wait_s=20.0).close()

        def carriers() -> dict[int, str]:
            return {i: n for i, n in threads(router).items() if n.startswith(ZENOHS)}

        until("Zenoh has threads", lambda: len(carriers()) >= len(ZENOHS))
        for thread_id, name in carriers().items():
            assert policy(thread_id) == os.SCHED_FIFO, name
            assert os.sched_getparam(thread_id).sched_priority == LINK_PRIORITY, name


@pytest.mark.parametrize("node", ["command", "sim"])
def test_no_thread_that_another_program_preempts_shares_the_gil_with_a_control_loop(
    node: str,
) -> None:
    endpoint = free_endpoint()
    with program("router", "--listen", endpoint):
        session = open_session(SessionProfile(connect=(endpoint,)), wait_s=20.0)
        with session, program(node, "--connect", endpoint) as pid:
            alive = load_profile("panda_sim").keys.alive(node)
            until("the node is there", lambda: list(session.liveliness().get(alive)), START_S)
            until("its loop runs", lambda: policy(pid) == os.SCHED_FIFO, START_S)
            late = {name for i, name in threads(pid).items() if policy(i) != os.SCHED_FIFO}
            assert late == set()
