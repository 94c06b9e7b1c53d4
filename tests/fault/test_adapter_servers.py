"""A policy server killed or stopped while the arm obeys it: brake, find it again, nothing stale."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from chain import MOVING_M_S, READY_PATIENCE_S, Chain, running_chain, write_profile
from peer_rig import ADAPTERS, KINDS, Server, free_port, of

BRAKE_S = 0.35
"""A jerk-limited stop from 0.1 m/s, and the arm's lag."""
BUSY_S = 0.25
CHUNK_S = 0.4
"""Four steps of 0.1 s: what was sent is carried out to its end."""
FOUND_AGAIN_S = 15.0
RUN_S = 0.6
STOPPED_S = 3.0
"""Longer than the adapter waits for an answer: its question is given up."""
WRONG_WAY_M = 0.005
"""The arm's overshoot when it turns back."""
TWIST = 1e-3
SLACK_S = 0.25


@contextmanager
def obeyed(folder: Path, name: str) -> Iterator[tuple[Chain, Server]]:
    """The arm obeys the adapter, which asks a real server."""
    kind = KINDS[name]
    port = free_port()
    profile = write_profile(
        folder,
        endpoint=f"tcp/127.0.0.1:{port}" if kind.model == "origami" else None,
        more=f"workers: [{kind.model}]\n",
    )
    profile.write_text(profile.read_text().replace("worker: scripted", f"worker: {kind.model}"))
    options = {kind.model: [f"{key}={value}" for key, value in kind.settings(port).items()]}
    server = Server(kind, port, listens=kind.model != "origami")
    if server.listens:
        server.start()
    try:
        with running_chain(folder, profile_file=profile, worker_options=options) as chain:
            if not server.listens:  # the router is one of the chain's nodes
                server.start(wait=False)
            chain.until("a command node", lambda: chain.state() == "inactive", READY_PATIENCE_S)
            yield chain, server
    finally:
        server.end()


def go(chain: Chain, prompt: str) -> None:
    chain.client.set_prompt(prompt)
    chain.activate_when_ready()
    chain.until("it moves", chain.moves, FOUND_AGAIN_S)
    time.sleep(RUN_S)
    chain.until("it moves still", chain.moves)
    chain.client.pop_events()


def watchdog_s(chain: Chain) -> float:
    """From a chunk's publishing until it is overdue, and the brake begins."""
    rate_hz = chain.profile.task.rate_hz
    return CHUNK_S + 1.0 / rate_hz + chain.profile.timing.watchdog_s


def assert_stopped(chain: Chain, since_ns: int) -> None:
    """It stands within the watchdog and a brake; the command node holds, the worker says why."""
    chain.until("it holds", lambda: chain.state() == "holding")
    chain.wait_still()
    stood_s = chain.recorder.track().time_to_stand_s(since_ns)
    limit_s = watchdog_s(chain) + BRAKE_S + BUSY_S
    print(f"stands {stood_s:.3f} s after the fault, at most {limit_s:.3f} s")
    assert stood_s <= limit_s

    def told() -> bool:
        events = list(chain.client.events)
        return any(event.what.startswith("peer_") for _, _, event in events)

    # A silent server is given up after its time-out, which may be later than the brake.
    chain.until("the worker says why", told)


def assert_nothing_stale(chain: Chain, since_ns: int) -> None:
    """What moved the arm since then was seen since then."""
    newest_ns = since_ns - int(SLACK_S * 1e9)
    oldest_s = chain.profile.timing.max_observation_age_s
    moved = 0
    for header, command in chain.recorder.commands(since_ns):
        if np.abs(command.twist).max() < TWIST or command.cause is None:
            continue
        moved += 1
        assert command.cause.observation_stamp_ns >= newest_ns
        late_s = (command.cause.published_ns - command.cause.observation_stamp_ns) / 1e9
        assert late_s <= oldest_s + SLACK_S
        assert header.stamp_wall_ns > since_ns
    assert moved > 0


@pytest.mark.long
@pytest.mark.parametrize("name", of(*ADAPTERS, quick=["openpi"]))
def test_a_killed_policy_server_brakes_the_arm_which_goes_on_when_it_is_there_again(
    name: str, tmp_path: Path
) -> None:
    with obeyed(tmp_path, name) as (chain, server):
        go(chain, "up")

        killed_ns = time.time_ns()
        server.kill()
        before = chain.recorder.track().between(killed_ns - 200_000_000, killed_ns)
        assert before.speed_m_s.mean() > MOVING_M_S
        assert_stopped(chain, killed_ns)
        stands_m = chain.reference_m().copy()
        time.sleep(0.5)
        assert np.abs(chain.reference_m() - stands_m).max() < 1e-3
        chain.client.set_prompt("down")
        started_ns = time.time_ns()
        server.start(wait=False)
        chain.until("it moves again", chain.moves, FOUND_AGAIN_S)
        time.sleep(RUN_S)
        assert chain.state() == "active", chain.detail("why")
        assert_nothing_stale(chain, started_ns)
        after = chain.recorder.track(started_ns)
        assert after.position_m[:, 2].max() <= stands_m[2] + WRONG_WAY_M


@pytest.mark.slow
@pytest.mark.parametrize("name", of(*ADAPTERS))
def test_what_a_stopped_policy_server_answers_when_it_goes_on_is_not_obeyed(
    name: str, tmp_path: Path
) -> None:
    with obeyed(tmp_path, name) as (chain, server):
        go(chain, "up")
        stopped_ns = time.time_ns()
        server.signal(signal.SIGSTOP)
        try:
            time.sleep(STOPPED_S)
            assert_stopped(chain, stopped_ns)
            stands_m = chain.reference_m().copy()
            chain.client.set_prompt("down")
            time.sleep(0.3)
        finally:
            server.signal(signal.SIGCONT)
        continued_ns = time.time_ns()
        chain.until("it moves again", chain.moves, FOUND_AGAIN_S)
        time.sleep(RUN_S)
        assert_nothing_stale(chain, continued_ns - int(1e9))
        after = chain.recorder.track(continued_ns)
        assert after.position_m[:, 2].max() <= stands_m[2] + WRONG_WAY_M
        assert after.position_m[-1, 2] < stands_m[2] - WRONG_WAY_M
