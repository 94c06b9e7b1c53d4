"""Which nodes are ended because they hang."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from vla_zenoh.runtime.supervisor import (
    HANG_S,
    HEARD_S,
    START_S,
    SilenceMeter,
    ThreadTime,
    hung_nodes,
    is_hearing,
    thread_time,
)

RUNNING = {
    "router": ("router", 1),
    "sim": ("sim", 2),
    "command": ("command", 3),
    "worker-big": ("worker", 4),
}
FRESH_S, LONG_S = 0.3, HANG_S + 1.0


def said(**ages_s: float) -> dict[str, tuple[int, float]]:
    """Everybody was heard just now, but those named."""
    heard = {name: FRESH_S for name in RUNNING}
    heard.update({name.replace("_", "-"): age_s for name, age_s in ages_s.items()})
    return {name: (RUNNING[name][1], age_s) for name, age_s in heard.items()}


def test_nobody_hangs_while_all_speak() -> None:
    assert hung_nodes(RUNNING, said(), LONG_S) == []


def test_a_node_that_is_silent_while_others_speak_hangs() -> None:
    assert hung_nodes(RUNNING, said(sim=LONG_S), LONG_S) == ["sim"]
    assert hung_nodes(RUNNING, said(sim=HANG_S - 1.0), LONG_S) == []


def test_a_worker_may_think_as_long_as_it_likes() -> None:
    assert hung_nodes(RUNNING, said(worker_big=600.0), LONG_S) == []


def test_a_node_that_was_started_anew_is_not_blamed_for_what_ran_before() -> None:
    before = {**said(), "sim": (17, LONG_S)}
    assert hung_nodes(RUNNING, before, LONG_S) == []


def test_a_node_that_has_said_nothing_yet_is_starting() -> None:
    heard = said()
    del heard["command"]
    assert hung_nodes(RUNNING, heard, LONG_S) == []


def test_when_nobody_is_heard_the_router_is_ended_alone() -> None:
    silence = said(router=LONG_S, sim=LONG_S, command=LONG_S, worker_big=LONG_S)
    assert hung_nodes(RUNNING, silence, 0.0) == ["router"]


def test_when_nobody_is_heard_and_the_router_is_elsewhere_nothing_is_ended() -> None:
    silence = said(router=LONG_S, sim=LONG_S, command=LONG_S, worker_big=LONG_S)
    here = {name: RUNNING[name] for name in ("sim", "command")}
    assert hung_nodes(here, silence, 0.0) == []


def test_when_the_router_comes_back_the_first_that_speaks_makes_nobody_hang() -> None:
    back = said(sim=LONG_S, command=LONG_S)
    assert hung_nodes(RUNNING, back, FRESH_S) == []
    assert hung_nodes(RUNNING, back, HANG_S) == []
    assert hung_nodes(RUNNING, back, LONG_S) == ["command", "sim"]


def test_only_a_live_node_that_spoke_lately_shows_that_the_router_is_there() -> None:
    lost = {"command": (None, LONG_S, False), "sim": (None, HEARD_S, True)}
    assert not is_hearing({})
    assert not is_hearing(lost)
    assert not is_hearing({**lost, "camera": (None, FRESH_S, False)}), "`up` speaks for it"
    assert is_hearing({**lost, "camera": (None, FRESH_S, True)})


class Process:
    """Processor times of a process that is looked at ten times a second."""

    def __init__(self, *, starting: bool) -> None:
        self.now_s = self.age_s = 0.0
        self.ran_s = self.waited_s = 0.0
        self.starting, self.silent_s = starting, 0.0
        self.meter = SilenceMeter(lambda _: ThreadTime(self.ran_s, self.waited_s))

    def spend(self, seconds: float, *, runs: float = 0.0, waits: float = 0.0) -> float:
        """Let time pass, of which it gets these shares; its silence at the end."""
        for _ in range(round(seconds * 10)):
            self.now_s += 0.1
            self.age_s += 0.1
            self.ran_s += 0.1 * runs
            self.waited_s += 0.1 * waits
            self.silent_s = self.meter.silent_s(
                "command", 3, self.age_s, self.now_s, starting=self.starting
            )
        return self.silent_s

    def speak(self) -> None:
        self.age_s, self.starting = 0.0, False


@pytest.mark.parametrize(("runs", "waits"), [(0.05, 0.95), (0.02, 0.0), (0.2, 0.8)])
def test_a_start_that_gets_little_of_a_processor_is_slow_and_does_not_hang(
    runs: float, waits: float
) -> None:
    assert Process(starting=True).spend(120.0, runs=runs, waits=waits) < 1.0


def test_a_start_that_does_nothing_hangs() -> None:
    assert Process(starting=True).spend(START_S + HANG_S + 0.5) > HANG_S


def test_a_start_that_computes_for_ever_hangs() -> None:
    process = Process(starting=True)
    assert process.spend(START_S - 1.0, runs=1.0) < 1.0
    assert process.spend(2.0, runs=1.0) > HANG_S


def test_a_running_node_may_wait_for_a_processor_but_not_compute_or_sleep_in_silence() -> None:
    process = Process(starting=False)
    process.spend(0.5)
    process.speak()
    assert process.spend(60.0, runs=0.05, waits=0.95) < HANG_S
    assert process.spend(0.5, waits=1.0) < HANG_S
    process.speak()
    assert process.spend(HANG_S + 1.0, runs=1.0) > HANG_S
    process.speak()
    assert process.spend(HANG_S + 1.0) > HANG_S


def test_without_figures_of_the_system_a_start_only_has_longer() -> None:
    meter = SilenceMeter(lambda _: None)
    assert meter.silent_s("command", 3, START_S, 50.0, starting=True) == 0.0
    assert meter.silent_s("command", 3, 4.0, 50.0, starting=False) == 4.0


@pytest.mark.realtime
def test_the_system_tells_a_thread_that_computes_from_one_that_sleeps() -> None:
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    idle = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        time.sleep(0.5)
        before = thread_time(busy.pid), thread_time(idle.pid)
        time.sleep(1.0)
        after = thread_time(busy.pid), thread_time(idle.pid)
    finally:
        busy.kill()
        idle.kill()
        busy.wait()
        idle.wait()
    if before[0] is None:
        pytest.skip("no schedstat on this system")
    spent = [sum(b) - sum(a) for a, b in zip(before, after, strict=True) if a and b]
    assert spent[0] > 0.7
    assert spent[1] < 0.3
    assert thread_time(busy.pid) is None, "the process is gone"
