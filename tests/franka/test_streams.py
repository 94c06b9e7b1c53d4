"""Ten minutes of random chunk streams on an FR3 that speaks FCI: prompts, rates, workers, stops.

    .venv/bin/python scripts/test_franka.py -s -m slow -k test_streams

Two workers infer all the time, one of them slowly; who is in control changes in motion.
"""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
from franka_lab import Lab, running_lab

from vla_zenoh.errors import SessionError
from vla_zenoh.guard.arm_guard import max_braking_time_s
from vla_zenoh.lab.demo.scripted_motions import HARD

STREAM_S = 60.0
SETTLES_S = 0.6
"""After its set-point stands: the arm is a spring, and commands take their way."""
MORE = """
workers: [scripted, slow]
models: {slow: scripted}
options: {slow: {camera: "", horizon: "50", dt_s: "0.05", delay_ms: "400", jitter: "0.5"}}
"""
OPTIONS = ("delay_ms=140", "jitter=0.3", "horizon=8", "dt_s=0.1")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: Any) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("fr3")
    with running_lab(folder, "joint", options=OPTIONS, more=MORE) as lab:
        yield lab


@pytest.mark.parametrize("seed", range(1, 11))
def test_random_streams_are_no_reflex_and_every_stop_is_within_its_bound(
    lab: Lab, seed: int
) -> None:
    rng, since, chain = random.Random(seed), len(lab.robot.lines), lab.chain
    bound_s = max_braking_time_s(chain.profile) + SETTLES_S
    prompts = [name for name, motion in HARD.items() if motion.axis < 6]
    done: Counter[str] = Counter()
    stops: list[float] = []
    chain.settle()
    chain.activate_when_ready()
    end_s = time.monotonic() + STREAM_S
    while time.monotonic() < end_s:
        what = rng.choices(("prompt", "rate", "worker", "speed", "stop", "off"), (9, 3, 4, 2, 2, 1))
        done[what[0]] += 1
        match what[0]:
            case "prompt":
                chain.client.set_prompt(f"HARD: {rng.choice(prompts)} within 0.1")
            case "rate":
                chain.client.set_rate(rng.choice([1.0, 2.0, 5.0, 10.0]))
            case "worker":
                try:
                    chain.client.set_worker(rng.choice(["scripted", "slow"]))
                except SessionError:  # it has published no chunk for long, at a low rate
                    done["rejected"] += 1
            case "speed":
                chain.client.set_speed(rng.choice([10, 50, 100]))
            case stop:
                stop_ns = time.time_ns()
                chain.client.stop() if stop == "stop" else chain.client.deactivate()
                chain.wait_still()
                stops.append(chain.recorder.track(stop_ns - 10**8).time_to_stand_s(stop_ns))
                lab.go_on()
                chain.recorder.forget()
        time.sleep(rng.uniform(0.05, 1.5))
    print(
        f"\nseed {seed}: {dict(done)}; longest stop {max(stops, default=0):.2f} of "
        f"{bound_s:.2f} s;",
        lab.share(since),
    )
    assert not lab.robot.aborts(since), lab.share(since)
    assert max(stops, default=0.0) < bound_s
