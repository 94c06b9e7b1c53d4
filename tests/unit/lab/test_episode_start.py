"""Before an episode: whom a command that starts the nodes waits for."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any, cast

import pytest

from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import CRASHED
from vla_zenoh.lab import episode
from vla_zenoh.lab.episode import COMMAND, EpisodeRunner
from vla_zenoh.lab.newest_records import NewestRecords
from vla_zenoh.types import NodeStatus

WHY = "crashed 2 times: no option 'colour'; it is started again"


def status(node: str, state: str, **detail: Any) -> NodeStatus:
    return NodeStatus(node, state, "here", 1, 1, detail=detail)


def runner(worker_states: list[str], watch: Any) -> EpisodeRunner:
    """Of a robot whose command node is up, and whose worker has each state once, then the last."""
    nodes = {COMMAND: status(COMMAND, "inactive")}

    def found(node: str) -> NodeStatus | None:
        if node != COMMAND:
            state = worker_states.pop(0) if len(worker_states) > 1 else worker_states[0]
            nodes[node] = status(node, state, complaint=WHY)
        return nodes[node]

    def snapshot() -> dict[str, Any]:
        return {name: (each, 0.0, True) for name, each in nodes.items()}

    client = SimpleNamespace(status=found, snapshot=snapshot)
    return EpisodeRunner(cast(Client, client), threading.Event(), watch)


RECEIVED = cast(NewestRecords, SimpleNamespace(missing=lambda *_: []))


def test_a_worker_that_crashed_is_waited_for_until_it_is_given_up() -> None:
    looks = iter(range(3))

    def watch() -> None:
        if next(looks, None) is None:
            raise NodeError("worker-riser keeps crashing")

    with pytest.raises(NodeError, match="worker-riser keeps crashing"):
        runner([CRASHED], watch).wait_until_ready("riser", RECEIVED)


def test_a_worker_that_crashed_once_is_waited_for_until_it_infers() -> None:
    looks: list[int] = []
    states = [CRASHED, CRASHED, "inferring"]
    runner(states, lambda: looks.append(1)).wait_until_ready("riser", RECEIVED)
    assert len(looks) >= 2


def test_a_crash_that_nobody_gives_up_is_told_in_the_workers_own_words(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(episode, "READY_PATIENCE_S", 0.2)
    with pytest.raises(NodeError, match=r"worker-riser is crashed .*no option 'colour'"):
        runner([CRASHED], lambda: None).wait_until_ready("riser", RECEIVED)
