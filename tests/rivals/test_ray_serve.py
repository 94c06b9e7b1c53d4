"""Ray Serve itself, 2.60: two replicas of a model serve two arms; one is killed in motion."""

from __future__ import annotations

import itertools
import json
import os
import signal
import time
from pathlib import Path

import pytest
import zenoh
from camera_rig import until
from chain import Chain
from ray_rig import ray_worker, replicas
from two_robots import BOUNCE, two_robots, write_bouncer

from vla_zenoh.profile import load_profile

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


class Arrivals:
    """When chunks came to a robot, on the monotonic clock."""

    def __init__(self, chain: Chain, worker: str) -> None:
        self.at_s: list[float] = []
        self._subscriber = chain.session.declare_subscriber(
            chain.profile.keys.delta(worker), zenoh.handlers.Callback(self._take, indirect=False)
        )

    def _take(self, _: zenoh.Sample) -> None:
        self.at_s.append(time.monotonic())

    def longest_s(self, since_s: float, until_s: float) -> float:
        """The longest time without a chunk."""
        own = [at_s for at_s in self.at_s if since_s < at_s < until_s]
        every = [since_s, *own, until_s]
        return max(after - before for before, after in itertools.pairwise(every))


def test_a_replica_is_killed_in_motion_and_no_arm_is_left_without_chunks(tmp_path: Path) -> None:
    write_bouncer(tmp_path / "own.py", horizon=HORIZON, slow_s=SLOW_S)
    (tmp_path / "both.yaml").write_text(BOTH.replace("MODEL", str(tmp_path / "own.py")))
    watchdog_s = load_profile("panda_sim").timing.watchdog_s
    with two_robots(tmp_path) as both, ray_worker(tmp_path, tmp_path / "both.yaml", "shared"):
        arrivals = [Arrivals(chain, "shared") for chain in both]
        for chain, came in zip(both, arrivals, strict=True):
            until("chunks", lambda came=came: came.at_s, START_S)
            chain.client.set_worker("shared")
            chain.client.set_prompt(BOUNCE)
            chain.activate_when_ready()
        for chain in both:
            chain.until("it moves", chain.moves)
            chain.client.pop_events()
        until("both replicas", lambda: len(replicas(tmp_path)) == 2, START_S)
        began_s = time.monotonic()
        time.sleep(BEFORE_S)

        old = replicas(tmp_path)
        killed_s = time.monotonic()
        os.kill(min(old), signal.SIGKILL)
        time.sleep(AFTER_S)
        until(
            "another replica is added",
            lambda: len(now := replicas(tmp_path)) == 2 and now - old,
            BACK_S,
        )
        again_s = time.monotonic()
        time.sleep(AFTER_S)
        ended_s = time.monotonic()
        gaps_ms = {
            chain.profile.robot.name: [
                round(1e3 * came.longest_s(*span))
                for span in ((began_s, killed_s), (killed_s, again_s), (again_s, ended_s))
            ]
            for chain, came in zip(both, arrivals, strict=True)
        }
        print(json.dumps({"gaps_ms": gaps_ms, "added_after_s": round(again_s - killed_s, 1)}))
        for chain, came in zip(both, arrivals, strict=True):
            # From the last step of a chunk to the next chunk: the command node brakes after that.
            without_s = came.longest_s(began_s, ended_s) - HORIZON * DT_S
            assert without_s < watchdog_s, (gaps_ms, chain.story())
            assert chain.state() == "active"
            assert not chain.events("active->inactive")
            chain.until("it moves on", chain.moves)
