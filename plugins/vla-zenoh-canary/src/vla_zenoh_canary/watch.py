"""Watching a robot: what comes on its keys goes into a `RobotWatch`."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import cache
from typing import Any

from vla_zenoh.bus.buffers import (
    CallbackRing,
    ReceivedSample,
    SampleBuffer,
    ZenohRing,
    bytes_of,
    header_of,
)
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import worker_node
from vla_zenoh.kinematics.kinematics import Kinematics, make_kinematics
from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import ActionChunk, GripperState, JointState, PoseState, Stamped
from vla_zenoh_canary.figures import RobotFigures, RobotWatch

PERIOD_S = 0.02
CHUNKS, SPECS = 256, 8


class WatchedRobot:
    """Subscriptions to both workers and the states of one robot; close it."""

    def __init__(self, client: Client, new: str, other: str) -> None:
        self.client = client
        profile, self._open = client.profile, ExitStack()

        @cache
        def arm_of(part: str) -> Kinematics:
            return make_kinematics(profile.of_part(part))

        self._watch = RobotWatch(profile, new, other, arm_of, time.monotonic())
        self._workers = {
            name: (
                self._subscribe(client.keys.spec(name), CallbackRing(SPECS)),
                self._subscribe(client.keys.delta(name), CallbackRing(CHUNKS)),
            )
            for name in (new, other)
        }
        self._states = {
            part: tuple(
                self._subscribe(key, ZenohRing(1, SMALL_BYTES))
                for key in (keys.state_pose, keys.state_joint, keys.state_gripper)
            )
            for part in profile.part_names
            for keys in [client.keys.of_part(part)]
        }
        self._newest: dict[tuple[str, int], Any] = {}

    def _subscribe(self, key: str, buffer: SampleBuffer) -> Any:
        self._open.callback(buffer.subscribe(self.client.session, key).undeclare)
        return buffer

    def poll(self) -> None:
        """Take what came since the last call."""
        task, now_s = self.client.task, time.monotonic()
        for part, streams in self._states.items():
            self._poll_states(part, streams)
        for name, (specs, chunks) in self._workers.items():
            worker = self._watch.workers[name]
            for stamped in filter(None, (_read(ModelSpec, one) for one in specs.drain())):
                worker.take_spec(stamped.record, stamped.header.source)
            for stamped in filter(None, (_read(ActionChunk, one) for one in chunks.drain())):
                if task is not None:
                    worker.take_chunk(stamped, task, now_s)
            status = self.client.status(worker_node(name))
            if status is not None:
                worker.take_counters(status.counters)
        self._watch.tick(task, now_s)

    def _poll_states(self, part: str, streams: tuple[ZenohRing, ...]) -> None:
        for index, kind in enumerate((PoseState, JointState, GripperState)):
            for arrival in streams[index].drain():
                self._newest[part, index] = _read(kind, arrival)
        pose = self._newest.pop((part, 0), None)
        if pose is not None:
            joint, gripper = self._newest.get((part, 1)), self._newest.get((part, 2))
            self._watch.take_state(part, pose, joint and joint.record, gripper and gripper.record)

    def figures(self) -> RobotFigures:
        """What is known by now."""
        return self._watch.figures(time.monotonic())

    def close(self) -> None:
        """End the subscriptions."""
        self._open.close()


def _read(kind: type[Any], arrival: ReceivedSample) -> Stamped[Any] | None:
    """A record with its header; None: it cannot be decoded, which the nodes count and report."""
    try:
        header = header_of(arrival.sample)
        return Stamped(header, records.decode(kind, bytes_of(arrival.sample.payload)), 0)
    except CodecError:
        return None


def watch_robots(
    clients: Mapping[str, Client],
    new: str,
    others: Mapping[str, str],
    seconds: float,
    stopped: Callable[[], bool],
) -> dict[str, RobotFigures]:
    """Figures of the worker `new` beside that of `others` on every robot, after `seconds`, or
    sooner once it is `stopped`."""
    with ExitStack() as opened:
        robots: dict[str, WatchedRobot] = {}
        for name, client in clients.items():
            robots[name] = WatchedRobot(client, new, others[name])
            opened.callback(robots[name].close)
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s and not stopped():
            for robot in robots.values():
                robot.poll()
            time.sleep(PERIOD_S)
        return {name: robot.figures() for name, robot in robots.items()}
