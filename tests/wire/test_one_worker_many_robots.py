"""One worker, three robots: each its own prompt, rate and episode, and none waits for another.

The robots here are what a worker knows of one: a task, states, and who reads its chunks.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import zenoh
from camera_rig import await_match, free_endpoint, until

from vla_zenoh.bus.buffers import bytes_of, header_of
from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, WorkerError
from vla_zenoh.nodes.worker.node import WorkerNode
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    ModelSpec,
    Observation,
    ObservationSpec,
    Policy,
)
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import Profile, as_robot, load_profile, override
from vla_zenoh.runtime.launch import Host
from vla_zenoh.types import ActionChunk, GripperState, Header, PoseState, Task

ROBOTS = ("a", "b", "c")
STATE_HZ = 50.0
RATE_HZ = 10.0
SLOW_S = 0.12
"""One inference of a slow model: longer than a request's period, so that requests meet."""
SLOWER_S, BEHIND_S, OLDEST_S = 0.15, 0.45, 0.55
"""An inference, and the age of what a robot sends, which together are more than is obeyed."""
IN_A_BATCH_S, OLDEST_OF_A_BATCH_S = 0.25, 0.6
"""What each robot adds to an inference, so that one for three robots is too late for all."""
LEAST_SHARE = 0.3
"""Of its rate that a robot must be given on a busy computer; a held-up one gets nothing."""
SAID_WHILE_LOADING = 10
"""Times that a robot says everything before a model is loaded."""
HEARD_S = 0.1
"""Until what was said is there."""
START_S = 40.0
"""From nothing to a worker that answers, on a busy computer."""
DOWN = np.array([1.0, 0.0, 0.0, 0.0])


class Robot:
    """Task and states of one robot, sent until `stop`; keeps the chunks it is sent."""

    def __init__(self, profile: Profile, session: zenoh.Session, worker: str) -> None:
        self.keys = profile.keys
        self.task = Task(1, True, "HARD: go up", worker, RATE_HZ)
        self.silent = False
        self.behind_s = 0.0
        """Age of its states when they are sent."""
        self.chunks: list[ActionChunk] = []
        self._session, self._seq = session, 0
        self._subscriber = session.declare_subscriber(
            self.keys.delta(worker), zenoh.handlers.Callback(self._take, indirect=False)
        )

    def _take(self, sample: zenoh.Sample) -> None:
        with suppress(CodecError):
            header_of(sample)
            self.chunks.append(records.decode(ActionChunk, bytes_of(sample.payload)))

    def say(self) -> None:
        """Everything once, stamped now."""
        if self.silent:
            return
        self._seq += 1
        z_m = 0.3 + 0.001 * (self._seq % 100)
        for key, source, record in (
            (self.keys.task, "command#1", self.task),
            (self.keys.state_pose, "sim#1", PoseState(np.array([0.4, 0, z_m]), DOWN, np.zeros(6))),
            (self.keys.state_gripper, "sim#1", GripperState(0.08, False, False)),
        ):
            behind_s = 0.0 if record is self.task else self.behind_s
            stamp_ns = time.time_ns() - int(behind_s * 1e9)
            header = records.encode_header(Header(stamp_ns, self._seq, source))
            self._session.put(key, records.encode(record), attachment=header)

    def asked(self, **changes: Any) -> None:
        """Another task, of the next episode."""
        self.task = replace(self.task, episode=self.task.episode + 1, **changes)

    def more(self, count: int) -> Callable[[], bool]:
        """Whether so many chunks came since this was asked for."""
        had = len(self.chunks)
        return lambda: len(self.chunks) >= had + count

    def said(self, times: int) -> Callable[[], bool]:
        """Whether it said everything so many times since this was asked for."""
        had = self._seq
        return lambda: self._seq >= had + times


class Together:
    """A model for many at once: what it gives a robot says whose turn it was.

    Args:
        slow_s: one inference, of one robot or of all.
        each_s: what every robot adds to it.
    """

    def __init__(self, slow_s: float = 0.0, each_s: float = 0.0) -> None:
        self.spec = ModelSpec(
            name="together",
            observation=ObservationSpec(cameras=(), state=("pose", "gripper"), prompt=True),
            action=ActionSpec(horizon=1, dt_s=0.1, gripper="none"),
        )
        self.batches: list[tuple[str, ...]] = []
        self.resets: list[str] = []
        self._slow_s, self._each_s = slow_s, each_s

    def reset(self, robot: str) -> None:
        self.resets.append(robot)

    def infer(self, observation: Observation) -> ActionSteps:
        return self.infer_batch([observation])[0]

    def infer_batch(self, observations: Sequence[Observation]) -> list[ActionSteps]:
        time.sleep(self._slow_s + self._each_s * len(observations))
        self.batches.append(tuple(seen.robot for seen in observations))
        return [self._one(seen) for seen in observations]

    def _one(self, seen: Observation) -> ActionSteps:
        if seen.prompt == "fail":
            raise ValueError("cannot")
        steps = np.zeros((1, 6))
        steps[0, 0] = float(seen.prompt)
        return ActionSteps(np.full((1, 6), np.nan) if seen.prompt == "0" else steps)


class Loading(Together):
    """Infers once it is `loaded`: whoever has asked by then is in its first inference."""

    def __init__(self, each_s: float) -> None:
        super().__init__(each_s=each_s)
        self.loaded = threading.Event()

    def load(self) -> None:
        assert self.loaded.wait(START_S)


@pytest.fixture(scope="module")
def profile() -> Profile:
    endpoint = free_endpoint()
    session = {"listen": [endpoint], "connect": [endpoint]}
    return override(load_profile("panda_sim"), {"session": session})


@pytest.fixture(scope="module")
def router(profile: Profile) -> Iterator[None]:
    with open_session(profile.session, mode="router"):
        yield


@contextmanager
def served(
    profile: Profile, policy: Policy, another: Callable[[], Policy] | None = None
) -> Iterator[dict[str, Robot]]:
    """Three robots that speak, and one worker that serves them."""
    name = policy.spec.name
    with open_session(profile.session) as own, open_session(profile.session) as theirs:
        robots = {
            robot: Robot(override(profile, {"robot": {"name": robot}}), theirs, name)
            for robot in ROBOTS
        }
        node = WorkerNode(profile, own, policy, name, robots=ROBOTS, another=another)
        stop = threading.Event()
        threads = [threading.Thread(target=node.run, args=(stop,))]
        for robot in robots.values():
            await_match(theirs, robot.keys.state_pose)

        def speak() -> None:
            while not stop.wait(1.0 / STATE_HZ):
                for robot in robots.values():
                    robot.say()

        threads.append(threading.Thread(target=speak))
        for thread in threads:
            thread.start()
        try:
            yield robots
        finally:
            stop.set()
            for thread in threads:
                thread.join(5.0)
            assert not any(thread.is_alive() for thread in threads)


@pytest.mark.long
def test_robots_that_are_ready_at_once_are_answered_in_one_batch(
    profile: Profile, router: None
) -> None:
    model = Together(SLOW_S)
    with served(profile, model) as robots:
        for number, robot in enumerate(robots.values(), 1):
            robot.asked(prompt=str(number))
        until("a batch of all", lambda: set(ROBOTS) in map(set, model.batches))
        began, counts = time.monotonic(), [robot.more(3) for robot in robots.values()]
        until("chunks for all", lambda: all(count() for count in counts))
        took_s = time.monotonic() - began
        for number, robot in enumerate(robots.values(), 1):
            assert {float(chunk.steps[0, 0]) for chunk in robot.chunks[-3:]} == {float(number)}
            assert robot.chunks[-1].episode == robot.task.episode
        # One by one it would have been three inferences for each round.
        assert took_s < 3 * len(ROBOTS) * SLOW_S / LEAST_SHARE
        assert max(map(len, model.batches)) == len(ROBOTS)
    assert set(ROBOTS) <= set(model.resets)


@pytest.mark.long
def test_a_robot_that_falls_silent_or_fails_holds_up_no_other(
    profile: Profile, router: None
) -> None:
    model = Together()
    with served(profile, model) as robots:
        a, b, c = robots.values()
        a.asked(prompt="1"), b.asked(prompt="2"), c.asked(prompt="3")
        until("chunks for all", lambda: all(robot.chunks for robot in robots.values()))
        a.silent = True
        until("the others go on", b.more(5))
        until("both of them", c.more(3))
        until("nobody asks for the silent one", lambda: "a" not in model.batches[-1])

        with open_session(profile.session) as session:
            looker = Client(override(profile, {"robot": {"name": "b"}}), session).subscribe()
            b.asked(prompt="fail")
            until("c goes on", c.more(5))
            counters = until("its status", lambda: looker.status("worker-together")).counters
            until(
                "b is told",
                lambda: looker.snapshot()["worker-together"][0].counters.get(
                    "refused.inference_failed"
                ),
            )
            b.asked(prompt="0")  # an answer that is no number
            until("c goes on again", c.more(5))
            until(
                "b is told why",
                lambda: looker.snapshot()["worker-together"][0].counters.get("refused.contract"),
            )
            assert counters is not None
        a.silent = False
        b.asked(prompt="5")
        for robot in robots.values():
            until("all again", robot.more(3))
        assert b.chunks[-1].steps[0, 0] == 5.0


def test_a_chunk_that_would_come_too_late_is_computed_when_it_keeps_no_other_robot_waiting(
    profile: Profile, router: None
) -> None:
    model = Together(SLOWER_S)
    oldest = override(profile, {"timing": {"max_observation_age_s": OLDEST_S}})
    with served(oldest, model) as robots:
        a, b, c = robots.values()
        a.behind_s = BEHIND_S
        for robot in (a, b, c):
            robot.asked(prompt="1", rate_hz=50.0)
        until("an inference has shown what it takes", lambda: len(model.batches) > 1)
        had = len(model.batches)
        until("the others go on", b.more(8))
        until("both of them", c.more(8))
        assert not any("a" in batch for batch in model.batches[had:])
        b.silent = c.silent = True
        until("it has its turn", lambda: model.batches[-1] == ("a",))
        with open_session(profile.session) as session:
            looker = Client(override(profile, {"robot": {"name": "a"}}), session).subscribe()
            status = until("its status", lambda: looker.status("worker-together"))
            assert status.detail["complaint"].startswith("too_late")


@pytest.mark.long
def test_where_a_batch_of_all_is_too_late_for_all_they_are_answered_in_smaller_ones(
    profile: Profile, router: None
) -> None:
    model = Loading(each_s=IN_A_BATCH_S)
    oldest = override(profile, {"timing": {"max_observation_age_s": OLDEST_OF_A_BATCH_S}})
    with served(oldest, model) as robots:
        for robot in robots.values():
            robot.asked(prompt="1", rate_hz=50.0)
        for robot in robots.values():
            until("all ask while it loads", robot.said(SAID_WHILE_LOADING))
        for robot in robots.values():
            robot.silent = True  # nobody is in the middle of a sentence when it begins
        time.sleep(HEARD_S)
        model.loaded.set()
        until("an inference", lambda: model.batches)
        assert set(model.batches[0]) == set(ROBOTS)
        for robot in robots.values():
            robot.silent = False
        had = {name: len(robot.chunks) for name, robot in robots.items()}

        def in_time(name: str) -> bool:
            return any(
                chunk.inference_end_ns - chunk.observation_stamp_ns < OLDEST_OF_A_BATCH_S * 1e9
                for chunk in robots[name].chunks[had[name] + 1 :]
            )

        until("chunks in time for every robot", lambda: all(map(in_time, ROBOTS)))
        # One of two leaves nothing for the network: more than a worker's share of the age.
        assert {len(batch) for batch in model.batches[1:]} == {1}


@pytest.mark.long
def test_each_robot_has_its_own_rate(profile: Profile, router: None) -> None:
    with served(profile, Together()) as robots:
        a, b, c = robots.values()
        a.asked(prompt="1", rate_hz=25.0), b.asked(prompt="1", rate_hz=3.0)
        c.asked(prompt="1", rate_hz=8.0)
        until("chunks for the slowest", b.more(2))
        began = [len(robot.chunks) for robot in (a, b, c)]
        until("some of the slowest", b.more(4))
        fast, slow, middle = (
            len(robot.chunks) - had for robot, had in zip((a, b, c), began, strict=True)
        )
        assert fast > middle > slow


@pytest.mark.long
def test_a_model_that_cannot_batch_is_there_once_for_each_robot(
    profile: Profile, router: None
) -> None:
    made: list[Policy] = []

    def make() -> Policy:
        made.append(make_policy(find_model("scripted"), {"camera": ""}))
        return made[-1]

    with served(profile, make(), make) as robots:
        for robot, direction in zip(robots.values(), ("go up", "go down", "yaw left"), strict=True):
            robot.asked(prompt=f"HARD: {direction} x4")
        assert len(made) == len(ROBOTS)
        for robot in robots.values():
            until(
                "its count is complete", lambda robot=robot: robot.chunks and robot.chunks[-1].done
            )
        axes = {
            name: int(np.abs(robot.chunks[0].steps[0]).argmax()) for name, robot in robots.items()
        }
        assert axes == {"a": 2, "b": 2, "c": 5}


@pytest.mark.long
def test_up_starts_a_worker_for_all_robots_that_the_profile_names() -> None:
    endpoint = free_endpoint()
    changes = {
        "robot": {"name": "b"},
        "serves": {"scripted": ROBOTS},
        "session": {"listen": [endpoint], "connect": [endpoint]},
        "hosts": {"gpu": {"nodes": ["router", "worker"]}},
    }
    profile = override(load_profile("panda_sim"), changes)
    lines: list[str] = []

    def log(node: str, line: str) -> None:
        lines.append(f"{node}: {line}")

    host = Host(profile, None, log=log, tell=log, worker_options={"scripted": ["camera="]})
    with host, open_session(host.profile.session) as session:
        robots = [Robot(as_robot(profile, name), session, "scripted") for name in ROBOTS]
        for number, robot in enumerate(robots, 2):
            robot.asked(prompt=f"HARD: go up x{number}")

        def told() -> bool:
            for robot in robots:
                robot.say()
            time.sleep(1 / STATE_HZ)
            return all(robot.chunks and robot.chunks[-1].done for robot in robots)

        until(f"the counts of all are complete: {lines}", told, START_S)
        assert host.supervisor.pids().keys() == {"router", "worker-scripted"}
    moving = [sum(chunk.steps.any() for chunk in robot.chunks) for robot in robots]
    assert moving == [2, 3, 4]


@pytest.mark.long
def test_a_model_that_cannot_say_whose_episode_begins_is_refused(
    profile: Profile, router: None
) -> None:
    class Forgetful(Together):
        def reset(self) -> None:  # pyright: ignore
            pass

    with (
        open_session(profile.session) as session,
        pytest.raises(WorkerError, match=r"reset\(robot\)"),
    ):
        WorkerNode(profile, session, Forgetful(), "forgetful", robots=ROBOTS)
