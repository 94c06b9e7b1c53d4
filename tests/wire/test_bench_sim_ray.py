"""`bench sim --ray`: episodes on a cluster of two nodes, one of which is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from benchmark_rig import OWN_BENCHMARK, REACHER
from camera_rig import until as until_within
from chain import command_line

from vla_zenoh.lab.cli.loopback import free_port

pytest.importorskip("ray")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
PATIENCE_S, EPISODES = 240.0, 40
RAY = Path(sys.executable).with_name("ray")


@dataclass
class Cluster:
    """A head, and a node that can be killed."""

    address: str
    node: subprocess.Popen[bytes]


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    address = f"127.0.0.1:{free_port()}"
    one = ["--num-cpus=1", "--num-gpus=0", "--block", "--disable-usage-stats"]
    head = [f"--port={address.split(':')[1]}", "--head", "--include-dashboard=false"]
    begun: list[subprocess.Popen[bytes]] = []

    def start(*more: str) -> None:
        with (tmp_path / f"ray{len(begun)}.log").open("wb") as log:
            begun.append(
                subprocess.Popen(
                    [RAY, "start", *more, *one], stdout=log, stderr=log, start_new_session=True
                )
            )

    try:
        start(*head, f"--temp-dir=/tmp/vz-ray-{os.getpid()}")
        until("the head", lambda: nodes(address) == 1)
        start(f"--address={address}")
        until("the second node", lambda: nodes(address) == 2)
        yield Cluster(address, begun[1])
    finally:
        for each in reversed(begun):
            kill(each)


def test_a_node_of_the_cluster_is_killed_and_the_result_is_the_same(
    tmp_path: Path, cluster: Cluster
) -> None:
    model = tmp_path / "reacher.py"
    model.write_text(REACHER, "utf-8")
    words = ["bench", "sim", str(OWN_BENCHMARK), "--worker", str(model), "-n", str(EPISODES)]
    alone, spread = tmp_path / "alone", tmp_path / "spread"
    done = command_line(*words, "-o", str(alone), timeout_s=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    asked = [*words, "-o", str(spread), "--ray", cluster.address, "--processes", "2"]
    with subprocess.Popen([sys.executable, "-m", "vla_zenoh", *asked]) as begun:
        until("an episode", lambda: ended(begun) or (spread / "episodes.jsonl").exists())
        until("a benchmark there", lambda: ended(begun) or descends(cluster.node.pid))
        kill(cluster.node)
        assert begun.wait(PATIENCE_S) == 0
    one, two = result(alone), result(spread)
    assert two["begun_again"] >= 1
    assert outcomes(two) == outcomes(one)
    assert len(two["all"]) == 3 * EPISODES == len(set(map(str, outcomes(two))))


def until(what: str, ask: Callable[[], Any]) -> None:
    until_within(what, ask, PATIENCE_S)


def ended(process: subprocess.Popen[bytes]) -> bool:
    return process.poll() is not None


def outcomes(found: dict[str, Any]) -> list[tuple[object, ...]]:
    """What an episode is and how it ended."""
    names = ("task", "episode", "success", "steps", "end")
    return [tuple(each[name] for name in names) for each in found["all"]]


def result(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text("utf-8"))


def nodes(address: str) -> int:
    """Of the cluster, that are alive."""
    look = f"import ray; ray.init({address!r}, logging_level='ERROR', log_to_driver=False); "
    look += "print(sum(each['Alive'] for each in ray.nodes()))"
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True)
    return int(done.stdout) if done.returncode == 0 else 0


def kill(started: subprocess.Popen[bytes]) -> None:
    """SIGKILL to a node of Ray and all that it started."""
    for pid in (*descendants(started.pid), started.pid):
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
    started.wait()


def descends(pid: int) -> bool:
    """Whether a benchmark runs below a process."""
    said = (Path(f"/proc/{each}/cmdline") for each in descendants(pid))
    return any(b"lab.benchmark.process" in file.read_bytes() for file in said if file.exists())


def descendants(pid: int) -> list[int]:
    parents: dict[int, list[int]] = {}
    for each in Path("/proc").iterdir():
        if each.name.isdigit():
            try:
                stat = (each / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents.setdefault(int(stat[1]), []).append(int(each.name))
    out, left = [], [pid]
    while left:
        found = parents.get(left.pop(), [])
        out += found
        left += found
    return out
