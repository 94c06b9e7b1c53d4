"""``vla-zenoh activate --hold``: the arm obeys while the program lives, whatever ends it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from chain import MOVING_M_S, Chain, FloatArray

pytestmark = pytest.mark.long

BRAKE_S = 0.35
"""A jerk-limited stop from 0.15 m/s takes 0.17 s, the rest is the arm's lag."""
BUSY_S = 0.3
"""What a busy machine may add: the router buries the program's connection first."""
FROZEN_EXTRA_S = 3.0
"""A program that stands still is given up by the router, see session.lease_ms."""
ENDS_S = 15.0
SOME_STATES = 20


@contextmanager
def holding(chain: Chain) -> Iterator[subprocess.Popen[str]]:
    """A person's program that holds the arm active, in motion."""
    chain.settle()
    chain.client.set_prompt("HARD: go up" if chain.height_m() < 0.4 else "HARD: go down")
    words = [sys.executable, "-m", "vla_zenoh", "activate", "--hold"]
    environment = {**os.environ, "VLA_ZENOH_PROFILE": str(chain.profile_file), "COLUMNS": "200"}
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    )
    try:
        chain.until("it moves", lambda: process.poll() is not None or chain.moves(), ENDS_S)
        assert process.poll() is None, process.communicate()[0]
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def ready(chain: Chain) -> Chain:
    """Whatever is missing for a moment is there."""
    chain.activate_when_ready()
    return chain


def test_killed_it_takes_the_arm_with_it_and_the_arm_waits(ready: Chain) -> None:
    with holding(ready) as process:
        assert str(ready.detail("held_by")).startswith("person-")
        process.kill()
        killed_ns = time.time_ns()
        ready.until("it is inactive", lambda: ready.state() == "inactive")
    ready.wait_still()
    assert ready.recorder.track().time_to_stand_s(killed_ns) <= BRAKE_S + BUSY_S
    assert re.fullmatch(r"deadman 'person-[^']+' is gone", str(ready.detail("why")))
    time.sleep(0.5)
    assert ready.state() == "inactive"
    since_ns = time.time_ns() - 300_000_000

    def speeds_m_s() -> FloatArray:
        return ready.recorder.track(since_ns).speed_m_s

    ready.until("its states come", lambda: len(speeds_m_s()) > SOME_STATES)
    assert speeds_m_s().max() < MOVING_M_S


def test_frozen_it_takes_the_arm_with_it_too(ready: Chain) -> None:
    with holding(ready) as process:
        os.kill(process.pid, signal.SIGSTOP)
        lease_s = ready.profile.session.lease_ms / 1e3
        ready.until(
            "it is inactive", lambda: ready.state() == "inactive", 2 * lease_s + FROZEN_EXTRA_S
        )
        assert re.fullmatch(r"deadman 'person-[^']+' is gone", str(ready.detail("why")))
        os.kill(process.pid, signal.SIGCONT)


def test_ctrl_c_brakes_first_and_says_so(ready: Chain) -> None:
    with holding(ready) as process:
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=ENDS_S)
        assert process.returncode == 130, said
        assert "inactive, the arm stands" in said
    assert ready.detail("why") == "deactivated"


def test_a_stop_by_somebody_else_ends_it_with_the_reason(ready: Chain) -> None:
    with holding(ready) as process:
        ready.client.publish(ready.client.keys.stop, "stop")
        said, _ = process.communicate(timeout=ENDS_S)
        assert process.returncode == 1
        assert "the arm is no longer active: emergency stop" in said
