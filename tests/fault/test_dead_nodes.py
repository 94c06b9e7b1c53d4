"""Any node killed or hung while the arm moves: it brakes, comes back, and waits to be activated."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest
import zenoh
from chain import MOVING_M_S, READY_PATIENCE_S, Chain, Track

from vla_zenoh.bus.name_check import NEW_S
from vla_zenoh.codec import message
from vla_zenoh.runtime.supervisor import HANG_S
from vla_zenoh.types import Event

BRAKE_S = 0.35
"""A jerk-limited stop from 0.15 m/s takes 0.17 s, the rest is the arm's lag."""
BUSY_S = 0.15
"""What a busy machine may add to any of it."""
COMMAND_TOLERANCE = 1.1
"""What is commanded keeps to the profile, sampled as it is."""
ARM_TOLERANCE = 2.7
"""The robot's side may brake by itself at twice that, commands come late on a busy machine, and the
measured arm follows with a spring. A step in velocity would be ten times as much."""
STEPS, STEP_M, WAY_TOLERANCE_M = 5, 0.01, 0.001
JUMP_M = 0.003
"""Between two references, 5 ms apart: 0.5 m/s would be 0.0025."""
RUN_S = 0.5
STEPS_BEFORE_NS = 300_000_000
SOME_STATES = 20


def assert_gentle(chain: Chain, since_ns: int = 0) -> None:
    """Neither what was commanded nor the arm itself changed its velocity in a step."""
    limit = chain.profile.limits.translation.acceleration_m_s2
    track = chain.recorder.track(since_ns)
    assert chain.recorder.hardest_command(since_ns) <= limit * COMMAND_TOLERANCE
    assert track.hardest_change() <= limit * ARM_TOLERANCE
    assert track.largest_step_m() <= JUMP_M


def move_a_while(chain: Chain) -> None:
    """Until the arm has been moving all the time that a test looks back at."""

    def moved() -> bool:
        chain.move()  # the other way, where a busy computer let it come to the end of this one
        time.sleep(RUN_S)
        since_ns = time.time_ns() - STEPS_BEFORE_NS
        speed_m_s = chain.recorder.track(since_ns).between(since_ns).speed_m_s
        return len(speed_m_s) > 0 and bool(speed_m_s.mean() > MOVING_M_S)

    chain.until("it moves still", moved, READY_PATIENCE_S)
    chain.client.pop_events()


def kill_in_motion(chain: Chain, node: str) -> tuple[int, int]:
    """Kill it; returns its process number and the time (ns)."""
    move_a_while(chain)
    pid = chain.pid(node)
    at_ns = time.time_ns()
    os.kill(pid, signal.SIGKILL)
    return pid, at_ns


def time_to_stand_s(chain: Chain, since_ns: int) -> float:
    """From `since_ns` until the arm stands: its track is complete once it has been seen to."""
    chain.wait_still()
    return chain.recorder.track().time_to_stand_s(since_ns)


def assert_restarted(chain: Chain, node: str, old_pid: int) -> None:
    chain.until(
        f"{node} runs again",
        lambda: chain.host.supervisor.pids().get(node, old_pid) != old_pid,
        READY_PATIENCE_S,
    )
    chain.until(
        f"{node} says so itsel",
        lambda: (status := chain.client.status(node)) is not None and status.pid != old_pid,
        READY_PATIENCE_S,
    )
    assert any(name == node and "SIGKILL" in line for name, line in chain.told)


def await_states(chain: Chain) -> Track:
    """The arm's next states: a node that starts again says so before the first of them."""
    since_ns = time.time_ns()

    def states() -> Track | None:
        track = chain.recorder.track(since_ns)
        return track if len(track.stamp_ns) > SOME_STATES else None

    return chain.until("its states come", states, READY_PATIENCE_S)


def endings(chain: Chain) -> list[Event]:
    """Ends of the activation.

    A computer that is busy may take longer to bury a node than the watchdog waits.
    """
    return chain.events("active->inactive") or chain.events("holding->inactive")


def assert_waits_and_works_again(chain: Chain) -> None:
    """Nothing moves before it is activated; then it does as told, from where it stands."""
    chain.until(
        "everything is there, only inactive",
        lambda: chain.state() == "inactive" and chain.state("worker-scripted") == "inferring",
        READY_PATIENCE_S,
    )
    await_states(chain)
    began_ns = time.time_ns()
    time.sleep(0.5)
    still = chain.recorder.track(began_ns)
    assert len(still.stamp_ns) > SOME_STATES
    assert still.speed_m_s.max() < MOVING_M_S
    assert chain.state() == "inactive"
    assert chain.client.task is not None
    assert not chain.client.task.active

    chain.activate_when_ready()
    direction, sign = ("up", 1) if chain.height_m() < 0.4 else ("down", -1)
    way_m = chain.go(direction, STEPS)
    assert way_m == pytest.approx(sign * STEPS * STEP_M, abs=WAY_TOLERANCE_M)
    assert_gentle(chain, began_ns)


# A worker that is killed is in tests/wire/test_workers.py, and a camera that is gone in
# tests/unit/control/test_commander.py.
def test_a_killed_command_node_brakes_the_arm_and_needs_a_new_activation(chain: Chain) -> None:
    pid, killed_ns = kill_in_motion(chain, "command")
    assert_restarted(chain, "command", pid)

    stood_s = time_to_stand_s(chain, killed_ns)
    track = chain.recorder.track()
    before = track.between(killed_ns - STEPS_BEFORE_NS, killed_ns)  # the speed goes with the steps
    assert before.speed_m_s.mean() > MOVING_M_S
    print(f"{before.speed_m_s.mean():.3f} m/s to rest in {stood_s:.3f} s")
    assert stood_s <= chain.profile.timing.watchdog_s + BRAKE_S + BUSY_S
    assert_gentle(chain)
    chain.until("it says why", lambda: chain.detail("why") == "not activated yet")
    assert chain.events("running->braking")
    assert_waits_and_works_again(chain)


def test_a_killed_simulator_is_noticed_and_starts_again_at_home(chain: Chain) -> None:
    pid, killed_ns = kill_in_motion(chain, "sim")
    (event,) = chain.until("it is noticed", lambda: endings(chain))
    assert event.why == "node 'sim' is gone"
    assert_restarted(chain, "sim", pid)
    # There is no arm to be measured: what would have been sent to one is.
    commands = [(h, c) for h, c in chain.recorder.commands() if h.stamp_wall_ns > killed_ns]
    moving = [h.stamp_wall_ns for h, c in commands if np.abs(c.twist).max() > 1e-3]
    stood_s = (max(moving) - killed_ns) / 1e9
    print(f"sim: the commanded pose stands after {stood_s:.3f} s")
    assert stood_s <= chain.profile.timing.state_timeout_s + BRAKE_S + BUSY_S
    chain.recorder.forget()
    assert_waits_and_works_again(chain)


def test_a_killed_router_stops_the_arm_and_all_find_each_other_again(chain: Chain) -> None:
    pid, killed_ns = kill_in_motion(chain, "router")
    at_kill = chain.recorder.track().between(0, killed_ns)
    assert_restarted(chain, "router", pid)
    nodes = ("sim", "camera", "command", "worker-scripted")

    def all_speak() -> bool:
        heard = chain.client.snapshot()  # with those of the tests before
        return chain.client.alive >= set(nodes) and all(heard[n][1] < 1.0 for n in nodes)

    chain.until("all speak again", all_speak, READY_PATIENCE_S)
    # Nobody hears the arm while there is no router. Afterwards it stands, near where it was.
    stands = await_states(chain)
    assert stands.speed_m_s.max() < MOVING_M_S
    speed_m_s = float(at_kill.speed_m_s[-20:].mean())
    went_m = float(np.linalg.norm(stands.position_m[-1] - at_kill.position_m[-1]))
    timeout_s = chain.profile.timing.command_timeout_s
    print(f"router: {speed_m_s:.3f} m/s, {went_m * 1e3:.1f} mm on")
    assert went_m <= speed_m_s * (timeout_s + BRAKE_S + BUSY_S)
    chain.until("its silence counts", lambda: chain.counter("sim.stream_silences", "sim") >= 1)
    chain.until("it says why", lambda: "is gone" in str(chain.detail("why")))
    chain.recorder.forget()
    assert_waits_and_works_again(chain)


def test_a_command_node_at_work_goes_on_when_another_one_answers_to_its_name(
    chain: Chain,
) -> None:
    key, there = chain.profile.keys.clock("command"), {"heard_ns": 0, "said_ns": 0}

    def reply(query: zenoh.Query) -> None:
        query.reply(key, message.pack(there))

    move_a_while(chain)
    chain.until("it is no longer new", lambda: command_age_s(chain) > NEW_S)
    handler = zenoh.handlers.Callback(reply, indirect=False)
    another = chain.session.declare_queryable(key, handler)
    pid = chain.pid("command")
    move_a_while(chain)
    another.undeclare()
    assert not endings(chain)
    assert chain.pid("command") == pid


def command_age_s(chain: Chain) -> float:
    status = chain.client.status("command")
    return 0.0 if status is None else (time.time_ns() - status.started_wall_ns) / 1e9


def hang_in_motion(chain: Chain, node: str, seconds: float) -> int:
    move_a_while(chain)
    pid = chain.pid(node)
    at_ns = time.time_ns()
    os.kill(pid, signal.SIGSTOP)
    try:
        time.sleep(seconds)
    finally:
        os.kill(pid, signal.SIGCONT)
    return at_ns


# A watchdog that runs out and a worker that is gone are in tests/unit/control/test_commander.py;
# here it hangs for two leases and a half.
@pytest.mark.long
def test_a_hung_worker_lets_the_arm_hold_and_then_lose_it(chain: Chain) -> None:
    lease_s = chain.profile.session.lease_ms / 1e3
    at_ns = hang_in_motion(chain, "worker-scripted", 2.5 * lease_s)
    timing = chain.profile.timing
    stood_s = time_to_stand_s(chain, at_ns)
    patience_s = 1.0 / chain.profile.task.rate_hz + timing.watchdog_s
    print(f"hung worker: to rest in {stood_s:.3f} s")
    assert stood_s <= patience_s + BRAKE_S + BUSY_S
    assert_gentle(chain)
    (event,) = chain.until("it is noticed", lambda: chain.events("holding->inactive"))
    assert chain.events("active->holding")
    assert event.why == "node 'worker-scripted' is gone"
    assert_waits_and_works_again(chain)


def test_a_hung_command_node_is_braked_by_the_robot_and_comes_back_inactive(chain: Chain) -> None:
    lease_s = chain.profile.session.lease_ms / 1e3
    at_ns = hang_in_motion(chain, "command", 1.5 * lease_s)
    stood_s = time_to_stand_s(chain, at_ns)
    print(f"hung command node: to rest in {stood_s:.3f} s")
    assert stood_s <= chain.profile.timing.command_timeout_s + BRAKE_S + BUSY_S
    assert_gentle(chain)
    chain.until("it says why", lambda: "stood still" in str(chain.detail("why")))
    assert_waits_and_works_again(chain)


@pytest.mark.slow
@pytest.mark.parametrize("node", ["camera", "router"])
def test_a_node_that_hangs_for_good_is_ended_and_started_again(chain: Chain, node: str) -> None:
    chain.move()
    pid, told = chain.pid(node), len(chain.told)
    os.kill(pid, signal.SIGSTOP)
    chain.until(
        f"{node} runs again",
        lambda: chain.host.supervisor.pids().get(node, pid) != pid,
        HANG_S + READY_PATIENCE_S,
    )
    assert_restarted(chain, node, pid)
    chain.recorder.forget()
    assert_waits_and_works_again(chain)
    assert [name for name, line in chain.told[told:] if "hangs" in line] == [node]
