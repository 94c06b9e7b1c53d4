"""Ray Serve itself, 2.60: two replicas of a model serve two arms; one is killed in motion."""

from __future__ import annotations

import itertools
import json
import operator
import os
import signal
import time
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh
from camera_rig import until
from chain import Chain
from ray_rig import ray_worker, replicas
from two_robots import BOUNCE, two_robots, write_bouncer

from vla_zenoh.codec.records import decode
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.types import ActionChunk, InferenceDebug

HORIZON, DT_S, SLOW_S = 5, 0.1, 0.05
START_S, BACK_S = 180.0, 120.0
BEFORE_S, AFTER_S = 3.0, 3.0
BOTH = """\
extends: ./one.yaml
workers: [scripted, shared]
models: {shared: ray_serve}
options: {shared: {model: MODEL, replicas: "2"}}
serves: {shared: [one, two]}
"""

pytestmark = pytest.mark.timeout(600)


class Arrived(NamedTuple):
    """A chunk, and when it came."""

    at_ns: int
    chunk: ActionChunk

    @property
    def ends_ns(self) -> int:
        """When its last step is over."""
        return self.chunk.observation_stamp_ns + round(HORIZON * DT_S * 1e9)


class Answers:
    """What a worker gave a robot, and which replica answered; on the wall clock."""

    def __init__(self, chain: Chain, worker: str) -> None:
        self.every: list[Arrived] = []
        self._replicas: list[tuple[int, str]] = []
        keys = chain.profile.keys
        self._subscribers = [
            chain.session.declare_subscriber(key, zenoh.handlers.Callback(take, indirect=False))
            for key, take in (
                (keys.delta(worker), self._chunk),
                (keys.seen_record(worker), self._replica),
            )
        ]

    def _chunk(self, sample: zenoh.Sample) -> None:
        self.every.append(Arrived(time.time_ns(), decode(ActionChunk, sample.payload.to_bytes())))

    def _replica(self, sample: zenoh.Sample) -> None:
        seen = decode(InferenceDebug, sample.payload.to_bytes())
        self._replicas.append((time.time_ns(), seen.raw["replica"]))

    def between(self, since_ns: int, until_ns: int) -> list[Arrived]:
        return [one for one in self.every if since_ns < one.at_ns < until_ns]

    def processes(self, since_ns: int, until_ns: int) -> set[int]:
        """Those that answered."""
        names = {name for at_ns, name in self._replicas if since_ns < at_ns < until_ns}
        return {int(name.rpartition(":")[2]) for name in names}

    def longest_gap_s(self, since_ns: int, until_ns: int) -> float:
        """Between two chunks."""
        came_ns = [one.at_ns for one in self.between(since_ns, until_ns)]
        return max(map(operator.sub, came_ns[1:], came_ns)) / 1e9

    def longest_without_s(self, since_ns: int, until_ns: int) -> float:
        """From the end of a chunk's last step until the next chunk; not positive: never without."""
        pairs = itertools.pairwise(self.between(since_ns, until_ns))
        return max(after.at_ns - before.ends_ns for before, after in pairs) / 1e9


def test_a_replica_is_killed_in_motion_and_no_arm_is_left_without_chunks(tmp_path: Path) -> None:
    write_bouncer(tmp_path / "own.py", horizon=HORIZON, slow_s=SLOW_S)
    (tmp_path / "both.yaml").write_text(BOTH.replace("MODEL", str(tmp_path / "own.py")))
    spec_hash = make_policy(find_model(str(tmp_path / "own.py")), {}).spec.hash
    watchdog_s = load_profile("panda_sim").timing.watchdog_s
    with two_robots(tmp_path) as both, ray_worker(tmp_path, tmp_path / "both.yaml", "shared"):
        answers = [Answers(chain, "shared") for chain in both]
        for chain, given in zip(both, answers, strict=True):
            until("chunks", lambda given=given: given.every, START_S)
            chain.client.set_worker("shared")
            chain.client.set_prompt(BOUNCE)
            chain.activate_when_ready()
        for chain in both:
            chain.until("it moves", chain.moves)
            chain.client.pop_events()
        until("both replicas", lambda: len(replicas(tmp_path)) == 2, START_S)
        old, began_ns = replicas(tmp_path), time.time_ns()
        time.sleep(BEFORE_S)

        killed, killed_ns = min(old), time.time_ns()
        os.kill(killed, signal.SIGKILL)
        until(
            "another replica is added",
            lambda: len(now := replicas(tmp_path)) == 2 and now - old,
            BACK_S,
        )
        (added,), added_ns = replicas(tmp_path) - old, time.time_ns()

        def answered(process: int) -> bool:
            return any(process in each.processes(killed_ns, time.time_ns()) for each in answers)

        until("the new replica answers", lambda: answered(added), BACK_S)
        time.sleep(AFTER_S)
        ended_ns = time.time_ns()
        spans = ((began_ns, killed_ns), (killed_ns, added_ns), (added_ns, ended_ns))
        figures = {
            chain.profile.robot.name: {
                "gaps_ms": [round(1e3 * given.longest_gap_s(*span)) for span in spans],
                "without_ms": [round(1e3 * given.longest_without_s(*span)) for span in spans],
            }
            for chain, given in zip(both, answers, strict=True)
        }
        print(json.dumps({**figures, "added_after_s": round((added_ns - killed_ns) / 1e9, 1)}))
        for chain, given in zip(both, answers, strict=True):
            every = given.between(began_ns, ended_ns)
            assert given.longest_without_s(began_ns, ended_ns) < watchdog_s, chain.story()
            assert {one.chunk.spec_hash for one in every} == {spec_hash}
            assert {one.chunk.worker for one in every} == {"shared"}
            seen_ns = [one.chunk.observation_stamp_ns for one in every]
            assert all(before < after for before, after in itertools.pairwise(seen_ns))
            assert chain.state() == "active"
            assert not chain.events("active->inactive")
            chain.until("it moves on", chain.moves)
        before = {each for one in answers for each in one.processes(began_ns, killed_ns)}
        assert before == old
