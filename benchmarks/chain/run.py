"""Measures all ways in turn: round after round, so that a busy moment affects all of them."""

from __future__ import annotations

import gc
import itertools
import os
import platform
import random
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

from numpy.typing import NDArray
from vla_zenoh_benchmarks.command_runner import cpu_s

from benchmarks import peers
from benchmarks.chain import report
from benchmarks.chain.echo import EchoClient
from benchmarks.chain.our_chain import RATE_HZ, WORKER, Chain
from benchmarks.chain.process import START_PATIENCE_S, Server, free_port
from benchmarks.chain.report import Result
from benchmarks.chain.rounds import Interval
from benchmarks.chain.ways import Load, ServingWay
from vla_zenoh import __version__
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import worker_node

PERIOD_S = (0.012, 0.020)
"""From one request to the next, evenly drawn: two ticks of 250 Hz wide, so that every phase of the
tick is equally frequent, and slower than the worker's highest rate."""
WARM_UP = 20
QUIET_S = 1.0
REST_AFTER_S, REST_S = 2.5, 2.0
"""The command node ticks at its rate for this long after a chunk; then its arm rests."""
AWAKE_S = 0.05
MAX_LOST = 10

Ask = Callable[[peers.Pictures], Mapping[str, float]]


class Running(NamedTuple):
    """A running way.

    Args:
        ask: one request; gives its figures in ms.
        cpu_s: process -> CPU time so far.
        parts: figure -> the processes whose CPU time it takes.
        check: raises when a process has died.
        awake: keeps the command node ticking at its rate for `AWAKE_S` without an image.
    """

    ask: Ask
    cpu_s: Callable[[], dict[str, float]]
    parts: Mapping[str, Sequence[str]]
    check: Callable[[], None]
    awake: Callable[[], None] = lambda: None


@contextmanager
def _chain(way: ServingWay, pictures: peers.Pictures) -> Iterator[Running]:
    with Chain(way.command_hz, pictures) as chain:
        to_chunk = ("camera", "router", worker_node(WORKER))
        everybody = (*to_chunk, "command")
        parts = {
            report.CHUNK: to_chunk,
            report.POSE: everybody,
        }

        def ask(them: peers.Pictures) -> Mapping[str, float]:
            return chain.request(them).figures_ms

        yield Running(ask, chain.cpu_s, parts, chain.rest, chain.awake)


@contextmanager
def _echo(way: ServingWay, pictures: peers.Pictures) -> Iterator[Running]:
    port = free_port()
    endpoint, count = f"tcp/127.0.0.1:{port}", str(len(pictures))
    with ExitStack() as up:
        servers: dict[str, Server] = {}
        if way.routed:
            servers["router"] = up.enter_context(Server("router", endpoint))
            servers["router"].await_port(port)
            servers["echo"] = up.enter_context(Server("echo", endpoint, "connect", count))
        else:
            servers["echo"] = up.enter_context(Server("echo", endpoint, "listen", count))
            servers["echo"].await_port(port)
        client = EchoClient(endpoint, len(pictures))
        up.callback(client.close)
        client.await_server(START_PATIENCE_S)
        yield _round_trips(client.request, servers)


@contextmanager
def _peer(way: ServingWay, _: peers.Pictures) -> Iterator[Running]:
    port = free_port()
    with Server("peer", way.name, str(port)) as server:
        server.await_port(port)
        client = peers.load(way.name).Client(port)
        try:
            yield _round_trips(client.request, {"server": server})
        finally:
            client.close()


def _round_trips(
    request: Callable[[peers.Pictures], NDArray[Any]], servers: Mapping[str, Server]
) -> Running:
    def ask(pictures: peers.Pictures) -> dict[str, float]:
        began_ns = time.monotonic_ns()
        answer = request(pictures)
        took_ms = (time.monotonic_ns() - began_ns) / 1e6
        if len(answer) != len(peers.ACTION):
            raise NodeError(f"a server of the benchmark answers {answer!r}")
        return {report.ROUND_TRIP: took_ms}

    def spent() -> dict[str, float]:
        return {name: cpu_s(server.pid) for name, server in servers.items()} | {
            "client": time.process_time()
        }

    def check() -> None:
        for server in servers.values():
            server.check()

    return Running(ask, spent, {report.ROUND_TRIP: (*servers, "client")}, check)


_START = {"chain": _chain, "echo": _echo, "peer": _peer}


def measure(way: ServingWay, load: Load, seed: int) -> Interval:
    """Start one way, send it ``load.requests`` requests, stop it.

    Raises:
        NodeError: it does not start, dies, or leaves too many requests unanswered.
    """
    # No camera shows the same image twice.
    pictures, requests = [load.pictures(0), load.pictures(1)], load.requests
    shown = itertools.cycle(pictures)
    draw = random.Random(seed)
    pause_s = (0.0, 0.0) if way.kind != "chain" else (1 / RATE_HZ, 1 / RATE_HZ)
    if load.pause:
        pause_s = PERIOD_S
    figures: dict[str, list[float]] = defaultdict(list)
    with _START[way.kind](way, pictures[0]) as running:
        for _ in range(WARM_UP):
            _paced(running, next(shown), draw.uniform(*pause_s))
        gc.collect()
        standing = _spent_in(running, lambda: _stay_awake(running))
        # The first request after the pause is not measured.
        _paced(running, next(shown), draw.uniform(*pause_s))
        lost = 0

        def ask_all() -> None:
            nonlocal lost
            for _ in range(requests):
                got = _paced(running, next(shown), draw.uniform(*pause_s))
                if got is None:
                    lost += 1
                    if lost > MAX_LOST:
                        raise NodeError(f"{way.title}: more than {MAX_LOST} requests were lost")
                    continue
                for figure, value_ms in got.items():
                    figures[figure].append(value_ms)

        began = time.monotonic()
        busy = _spent_in(running, ask_all)
        took_s = time.monotonic() - began
        resting: dict[str, float] = {}
        if way.kind == "chain":
            time.sleep(REST_AFTER_S)
            resting = _spent_in(running, lambda: time.sleep(REST_S))
    share = {name: spent_s / QUIET_S for name, spent_s in standing.items()}
    cpu_ms = {
        figure: max(sum(busy[p] - share[p] * took_s for p in parts), 0.0) / requests * 1e3
        for figure, parts in running.parts.items()
    }
    return Interval(way.name, dict(figures), cpu_ms, sum(resting.values()) / REST_S, lost)


def _stay_awake(running: Running) -> None:
    for _ in range(round(QUIET_S / AWAKE_S)):
        running.awake()
        time.sleep(AWAKE_S)


def _spent_in(running: Running, act: Callable[[], None]) -> dict[str, float]:
    before = running.cpu_s()
    act()
    after = running.cpu_s()
    return {name: after[name] - before[name] for name in before}


def _paced(
    running: Running, pictures: peers.Pictures, period_s: float
) -> Mapping[str, float] | None:
    """One request and the rest of its period; None when it was lost."""
    next_s = time.monotonic() + period_s
    try:
        got = running.ask(pictures)
    except TimeoutError:
        running.check()
        return None
    time.sleep(max(next_s - time.monotonic(), 0.0))
    return got


def run(
    ways: Sequence[ServingWay], rounds: int, load: Load, progress: Callable[[ServingWay], None]
) -> Result:
    """Measure all of `ways` that are installed, in turns.

    Args:
        ways: what to measure.
        rounds: how often each has its turn; the first one changes from round to round.
        load: of each turn.
        progress: called before each turn.

    Raises:
        NodeError: a way does not work on this computer.
    """
    installed = [way for way in ways if not way.missing()]
    machine = _machine()
    done: list[dict[str, Interval]] = []
    for number in range(rounds):
        first = number % max(len(installed), 1)
        slots: dict[str, Interval] = {}
        for way in installed[first:] + installed[:first]:
            progress(way)
            slots[way.name] = measure(way, load, seed=number)
        done.append(slots)
    return Result(ways, done, machine, load)


def _machine() -> dict[str, Any]:
    return {
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 2),
        "architecture": platform.machine(),
        "kernel": platform.release(),
        "python": platform.python_version(),
        "vla_zenoh": __version__,
    }
