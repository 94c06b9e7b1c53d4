"""Promotion of a canary on several robots, and the way back.

Who is obeyed is the setting ``worker``, as for `vla-zenoh use`: the command node of an active arm
checks the other worker first, and its plan goes on until a chunk of that worker takes its place.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from vla_zenoh.bus.buffers import CallbackRing, bytes_of, header_of
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, SessionError
from vla_zenoh.policy import ModelSpec
from vla_zenoh_canary.judge import Present
from vla_zenoh_canary.record import CanaryRecord, Promoted

SPEC_PATIENCE_S, TASK_PATIENCE_S = 2.5, 3.0
"""A worker publishes its spec, and the command node its task, once a second or more often."""
CONFIRM_S = 10.0
"""Longer than any plan goes on without a new chunk."""


def present(client: Client, workers: tuple[str, ...]) -> Present:
    """What the nodes of a robot say now."""
    task = client.wait_for(lambda: client.task, TASK_PATIENCE_S)
    rings = {name: CallbackRing(1) for name in workers}
    subscribers = [
        ring.subscribe(client.session, client.keys.spec(name)) for name, ring in rings.items()
    ]
    specs: dict[str, tuple[str, str]] = {}

    def complete() -> bool:
        for name, ring in rings.items():
            for arrival in ring.drain():
                try:
                    spec = records.decode(ModelSpec, bytes_of(arrival.sample.payload))
                    specs[name] = (spec.hash, header_of(arrival.sample).source)
                except CodecError:
                    continue  # the command node counts and reports it
        return len(specs) == len(rings)

    client.wait_for(complete, SPEC_PATIENCE_S)
    for subscriber in subscribers:
        subscriber.undeclare()
    return Present(client.alive, None if task is None else task.worker, specs)


class Switched(NamedTuple):
    """One robot after a switch.

    Args:
        why: it failed; empty: it did not.
        in_motion: the arm was active.
        after_s: until a chunk of the new worker was in force; None: the arm was not active.
    """

    robot: str
    before: str
    worker: str
    why: str = ""
    in_motion: bool = False
    after_s: float | None = None


def switch(client: Client, worker: str) -> Switched:
    """Have a robot obey `worker`, and wait until an active arm follows a chunk of it."""
    robot, task = client.keys.robot, client.task
    before, active = ("", False) if task is None else (task.worker, task.active)
    began_s = time.monotonic()
    try:
        client.set_worker(worker)
    except SessionError as error:
        return Switched(robot, before, worker, str(error), active)
    if not active or before == worker:
        return Switched(robot, before, worker, "", active)

    def follows() -> str | None:
        status = client.status_since("command", began_s)
        if status is None or status.detail.get("worker") != worker:
            return None
        if status.state not in ("active", "holding"):
            return status.state
        return "follows" if status.detail.get("accepted_chunks") else None

    found = client.wait_for(follows, CONFIRM_S)
    if found == "follows":
        return Switched(robot, before, worker, "", True, time.monotonic() - began_s)
    why = client.why_inactive() if found else f"no chunk of {worker!r} in {CONFIRM_S:g} s"
    return Switched(robot, before, worker, f"the arm does not follow it: {why}", True)


def switch_all(
    clients: Mapping[str, Client],
    record: CanaryRecord,
    keep: Callable[[Mapping[str, Promoted]], None],
) -> list[Switched]:
    """Have every robot obey the canary, one after the other.

    Where one does not, it and those before it obey their worker again, and nothing is promoted.
    `keep` gets what is promoted before each switch, so that nothing is lost if this is interrupted.
    """
    done: list[Switched] = []
    promoted: dict[str, Promoted] = {}
    for robot, client in clients.items():
        status, task = client.status("command"), client.task
        counters = dict(status.counters) if status else {}
        before = record.robots[robot].other.worker if task is None else task.worker
        promoted[robot] = Promoted(before, time.time_ns(), counters)
        keep(promoted)
        found = switch(client, record.new)
        done.append(found)
        if found.why:
            undone = [switch(clients[each.robot], each.before) for each in reversed(done)]
            failed = {each.robot for each in undone if each.why}
            keep({name: each for name, each in promoted.items() if name in failed})
            return [*done, *undone]
    return done


def take_back(clients: Mapping[str, Client], record: CanaryRecord) -> Iterator[Switched]:
    """Have every promoted robot obey the worker from before; one that fails keeps no other."""
    for robot, client in clients.items():
        before = record.promoted[robot].before
        task = client.wait_for(lambda client=client: client.task, TASK_PATIENCE_S)
        if task is not None and task.worker not in (record.new, before):
            why = f"it obeys {task.worker!r}, which this promotion did not choose: left as it is"
            yield Switched(robot, task.worker, before, why, task.active)
            continue
        yield switch(client, before)


def since_promotion(client: Client, record: CanaryRecord, robot: str) -> dict[str, Any]:
    """What a robot's nodes say of the time since the promotion: rejections, latencies, state."""
    then = record.promoted[robot]
    status = client.status("command")
    counters = status.counters if status else {}
    restarted = any(counters.get(name, 0) < count for name, count in then.counters.items())
    rejected = {
        name.removeprefix("refused."): count - then.counters.get(name, 0)
        for name, count in counters.items()
        if name.startswith("refused.") and count > then.counters.get(name, 0)
    }
    latencies = {}
    for worker in (record.new, then.before):
        said = client.status(f"worker-{worker}")
        latencies[worker] = said.latency_ms.get("inference") if said else None
    return {
        "seconds": round((time.time_ns() - then.at_ns) / 1e9, 1),
        "rejected": None if status is None or restarted else rejected,
        "inference_ms": latencies,
        "chunk_to_arm_ms": status.latency_ms.get("end_to_end") if status else None,
        "state": status.state if status else None,
        "why": status.detail.get("why") if status else None,
    }
