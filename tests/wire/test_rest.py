"""The command node while the arm rests: fewer ticks and commands, and a chunk ends that at once."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from chain import Chain, running_chain, write_profile

from vla_zenoh.nodes.command.node import REST_S

REST_HZ = 1.0 / REST_S
WINDOW_S = 2.0
UNKNOWN = "a prompt that the scripted model does not know"
SLOW, FAST = 1.2, 0.5
"""Shares of a rate: the most at rest, and the least that a busy computer reaches."""
SAME_M = 1e-4


def commands_hz(chain: Chain) -> float:
    """Rate of the pose commands in the next `WINDOW_S`."""
    since_ns = time.time_ns()
    time.sleep(WINDOW_S)
    return len(chain.recorder.commands(since_ns)) / WINDOW_S


def loop_hz(chain: Chain) -> float:
    """Rate of the ticks, as status has it."""
    status = chain.client.status("command")
    return status.rates_hz["loop"] if status else 0.0


def hold_still(chain: Chain) -> None:
    """Activate, and let the model fall silent, until the command node ticks slowly."""
    chain.settle()
    chain.activate_when_ready()
    chain.client.set_prompt(UNKNOWN)
    chain.until("holding", lambda: chain.state() == "holding")
    chain.until("it rests", lambda: loop_hz(chain) < SLOW * REST_HZ)
    assert chain.detail("streaming")


@pytest.mark.long
def test_an_arm_that_rests_gets_fewer_commands_until_a_chunk_moves_it(chain: Chain) -> None:
    hold_still(chain)
    missed = chain.counter("command.missed_ticks")
    assert FAST * REST_HZ < commands_hz(chain) < SLOW * REST_HZ
    assert chain.counter("command.missed_ticks") - missed < SLOW * REST_HZ
    assert chain.go("up", 10) == pytest.approx(0.1, abs=0.005)
    chain.move()
    assert commands_hz(chain) > FAST * chain.profile.timing.command_hz
    chain.settle()


def test_a_motion_out_of_rest_begins_without_a_step(chain: Chain) -> None:
    hold_still(chain)
    since_ns = time.time_ns()
    chain.move()
    commands = chain.recorder.commands(since_ns)
    positions_m = np.array([pose.position_m for _, pose in commands])
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    began = int(np.argmax(steps_m > 0))
    # A busy computer may be late for the first tick: then it is as far as the jerk allows.
    headers = [header for header, _ in commands]
    apart_s = (headers[began + 1].stamp_wall_ns - headers[began].stamp_wall_ns) / 1e9
    jerk_m_s3 = chain.profile.limits.translation.jerk_m_s3
    assert steps_m[began] < max(SAME_M, jerk_m_s3 * apart_s**3 / 6)
    chain.settle()


def test_a_stop_is_obeyed_while_the_arm_rests(chain: Chain) -> None:
    hold_still(chain)
    chain.session.put(chain.profile.keys.stop, b"")
    chain.until("stopped", lambda: chain.state() == "stopped")
    chain.settle()


@pytest.mark.skipif((os.cpu_count() or 1) < 4, reason="1000 Hz and a simulator need four cores")
def test_at_1000_hz_chunks_are_planned_beside_the_ticks_and_the_arm_goes_as_far(
    tmp_path: Path,
) -> None:
    base = tmp_path / "base.yaml"
    base.write_text("extends: panda_sim\ntiming: {command_hz: 1000}\n")
    fast = write_profile(tmp_path, extends=str(base))
    with running_chain(tmp_path, profile_file=fast) as chain:
        chain.activate_when_ready()
        assert chain.go("up", 10) == pytest.approx(0.1, abs=0.005)
        assert chain.detail("chunk_us")  # planned outside of a tick
        chain.settle()
