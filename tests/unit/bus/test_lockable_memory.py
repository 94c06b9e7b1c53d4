"""A process uses shared memory only where it may lock it, and a host's segments are bounded."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from vla_zenoh.bus.shared_memory import LOCK_BYTES, held_bytes, lockable_bytes

LIMITED = ["prlimit", "--memlock=8388608:8388608"]
WITHOUT_CAPABILITY = (
    ["setpriv", "--bounding-set", "-ipc_lock", "--inh-caps", "-ipc_lock", "--ambient-caps", "-all"]
    if os.getuid() == 0
    else []
)
SHOW = """
from vla_zenoh.bus import shared_memory
shared_memory.held_bytes = lambda: 0  # what other tests hold meanwhile is theirs
from vla_zenoh.bus.session import session_config
from vla_zenoh.bus.shared_memory import obstacle
from vla_zenoh.profile import SessionProfile
print(session_config(SessionProfile())["transport"]["shared_memory"]["enabled"], obstacle())
"""
linux = pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")


def shown(*prefix: str) -> str:
    words = [*prefix, sys.executable, "-c", SHOW]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


@linux
def test_a_process_that_may_lock_too_little_uses_no_shared_memory_and_says_why() -> None:
    # The user is set once more: an exec as root would else get the capability back.
    again = ["setpriv", "--reuid", "0"] if WITHOUT_CAPABILITY else []
    enabled, _, why = shown(*WITHOUT_CAPABILITY, *LIMITED, *again).partition(" ")
    assert enabled == "False"
    assert "8 MiB" in why
    assert "ulimit -l" in why


@linux
@pytest.mark.skipif(os.getuid() != 0, reason="only root has the capability")
def test_a_capability_outweighs_the_limit() -> None:
    assert shown(*LIMITED) == "True"


def test_the_limit_of_this_process_is_known() -> None:
    found = lockable_bytes()
    assert found is None or found >= 0


def test_segments_that_nobody_holds_are_not_counted(tmp_path: Path) -> None:
    for name, size in (("1.zenoh", 5000), ("2.zenoh", 7000), ("3.txt", 900)):
        (tmp_path / name).write_bytes(bytes(size))
    assert held_bytes(tmp_path) == 0
    with (tmp_path / "2.zenoh").open() as held:
        fcntl.flock(held, fcntl.LOCK_SH)
        assert held_bytes(tmp_path) == 7000
    assert held_bytes(tmp_path) == 0
    assert held_bytes(tmp_path / "absent") == 0
    assert held_bytes(tmp_path, tmp_path / "no locks") == 0


def test_what_a_host_may_hold_can_be_locked_twice() -> None:
    from vla_zenoh.bus.shared_memory import HOST_BYTES, SENDER_BYTES

    assert LOCK_BYTES >= HOST_BYTES + SENDER_BYTES
