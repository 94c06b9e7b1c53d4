"""The rolling record of a real lab whose nodes are killed: it goes on, and says what is missing."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from chain import READY_PATIENCE_S, Chain, running_chain
from vla_zenoh_rolling.settings_log import entries_of

from vla_zenoh.keys import ROLLING
from vla_zenoh.lab.recording.run import load_run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("rolling")


@pytest.fixture(scope="module")
def lab(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    with running_chain(tmp_path_factory.mktemp("lab"), rolling=folder) as chain:
        chain.until("it records", lambda: pid_of(chain) > 0)
        yield chain


def pid_of(chain: Chain, node: str = ROLLING) -> int:
    return chain.host.supervisor.pids().get(node, 0)


def records(chain: Chain) -> bool:
    status = chain.client.status(ROLLING)
    return status is not None and status.pid == pid_of(chain) and status.state == "recording"


def kill(chain: Chain, node: str) -> None:
    pid = pid_of(chain, node)
    os.kill(pid, signal.SIGKILL)
    chain.until(f"{node} is there again", lambda: pid_of(chain, node) not in (0, pid))
    chain.until("it records", lambda: records(chain))


def test_a_killed_record_goes_on_and_its_log_says_that_something_is_missing(
    lab: Chain, folder: Path
) -> None:
    lab.until("it records", lambda: records(lab))
    lab.client.publish(lab.client.keys.prompt, "HARD: go up")
    lab.until("it is logged", lambda: "HARD: go up" in puts(folder))
    kill(lab, ROLLING)
    lab.client.publish(lab.client.keys.prompt, "HARD: go down")
    lab.until("it is logged", lambda: "HARD: go down" in puts(folder))
    assert [each["what"] for each in entries_of(folder)].count("after_gap") == 1


def test_whatever_node_is_killed_the_record_is_whole(lab: Chain, folder: Path) -> None:
    for node in ("camera", "worker-scripted", "sim", "command"):
        kill(lab, node)
    heard = lab.client.task
    lab.until("the command node is back", lambda: lab.client.task is not heard, READY_PATIENCE_S)
    saved = folder / "saved"
    lab.client.publish(lab.client.keys.save, "all were killed")
    lab.until("it is saved", lambda: any(saved.glob("*all-were-killed")))
    (last,) = saved.glob("*all-were-killed")
    run = load_run(last)
    assert run.problems == []
    writers = {entry.header.source for entry in run.tasks}
    assert len(writers) == 2, "the command node before and after"


def puts(folder: Path) -> list[str]:
    return [each["text"] for each in entries_of(folder) if each["what"] == "put"]
