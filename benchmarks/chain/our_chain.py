"""Our own chain under measurement: router, worker and command node as in a lab, a process each.

This process plays the camera and receives the results; another one plays the robot.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray
from vla_zenoh_benchmarks.command_runner import cpu_s

from benchmarks.chain import report
from benchmarks.chain.process import Server, free_port
from benchmarks.peers import Pictures
from vla_zenoh.bus.buffers import CallbackRing, LatestSample
from vla_zenoh.bus.node import Node
from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError, SessionError
from vla_zenoh.nodes.camera.camera_publisher import OK, CameraPublisher
from vla_zenoh.profile import HostProfile, Profile, load_profile
from vla_zenoh.runtime.launch import Host
from vla_zenoh.types import ActionChunk, PoseCommand, Stamped

PROFILE, WORKER, PROMPT = "panda_sim", "scripted", "hold"
CAMERAS = ("front", "left", "right")
RATE_HZ = 100.0
"""Requested of the worker: the highest rate, so that it waits for nothing but the image."""
READY_PATIENCE_S = 20.0
ANSWER_PATIENCE_S = 0.5
POSE_PATIENCE_S = 0.3
TICK_MARGIN_S = 0.002
POLL_S = 0.001


@dataclass(frozen=True, slots=True)
class Answer:
    """Results of one image; `figures_ms` as in `benchmarks.chain.report`."""

    figures_ms: dict[str, float]


def bench_profile(command_hz: float, pictures: Pictures, shadows: Sequence[str] = ()) -> Profile:
    """The shipped profile at its own address, with the nodes that are measured.

    Args:
        command_hz: rate of the command node.
        pictures: images of the cameras that the model waits for.
        shadows: names of workers that are not obeyed, with the same model.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    data = load_profile(PROFILE).model_dump()
    data["session"].update(connect=(endpoint,), listen=(endpoint,))
    data["timing"]["command_hz"] = command_hz
    data["task"].update(prompt=PROMPT, worker=WORKER, rate_hz=RATE_HZ)
    data["workers"] = (WORKER, *shadows)
    data["models"] = dict.fromkeys(shadows, WORKER)
    cameras = dict(zip(CAMERAS, pictures, strict=False))
    data["cameras"] = {
        name: {**data["cameras"]["front"], "height": rgb.shape[0], "width": rgb.shape[1]}
        for name, rgb in cameras.items()
    }
    data["options"] = {name: {"camera": ",".join(cameras)} for name in data["workers"]}
    # A worker takes raw images if its host has the cameras, as here.
    here = HostProfile(nodes=("router", "camera", "command", "worker"))
    data["hosts"] = {"here": here.model_dump()}
    return Profile.model_validate(data)


class Chain:
    """The chain, running and active during the context.

    Args:
        command_hz: rate of the command node.
        pictures: images shown until the worker answers.
        shadows: see `bench_profile`.

    Raises:
        NodeError: it does not start.
    """

    def __init__(self, command_hz: float, pictures: Pictures, shadows: Sequence[str] = ()) -> None:
        self.profile = bench_profile(command_hz, pictures, shadows)
        self._first = pictures
        self._lines: list[str] = []
        self._up = ExitStack()
        self._host = Host(
            self.profile,
            None,
            log=lambda node, line: self._lines.append(f"{node}: {line}"),
            tell=lambda node, what: None,
            own_router=True,
        )
        supervisor = self._host.supervisor
        supervisor.children = [c for c in supervisor.children if c.command.kind != "camera"]
        self._period_s = 1.0 / command_hz

    def __enter__(self) -> Chain:
        try:
            self._start()
        except BaseException:
            self._up.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._up.close()

    def _start(self) -> None:
        self._up.enter_context(self._host)
        session, client = self._host.session, self._host.client
        assert session is not None
        assert client is not None
        self._robot = self._up.enter_context(Server("robot", str(self._host.profile_file)))
        self.node = Node("camera", self.profile, session)
        self._up.callback(self.node.close)
        self._outlets = {
            name: CameraPublisher(name, camera, "benchmark", self.node, self.node.emit)
            for name, camera in self.profile.cameras.items()
        }
        for outlet in self._outlets.values():
            outlet.set_state(OK)
        keys = self.node.keys
        self.chunk_key = keys.delta(WORKER)
        self._chunks = self.node.subscribe(self.chunk_key, LatestSample())
        self._poses = self.node.subscribe(keys.command_pose, CallbackRing(4096))
        self._activate(client)

    def _activate(self, client: Client) -> None:
        """Show images until the worker answers and the command node has no reason to reject."""
        give_up = time.monotonic() + READY_PATIENCE_S
        why = "the worker does not answer"
        while time.monotonic() < give_up:
            self._robot.check()
            self.publish(self._first)
            self._report()
            if not self._chunks.wait(0.1):
                continue
            self._chunks.pop()
            if client.status("command") is None:
                continue
            try:
                client.activate(timeout_s=0.5)
                return
            except SessionError as error:
                why = str(error)
        said = "\n".join(self._lines[-20:])
        raise NodeError(f"the chain does not come up: {why}\n{said}".rstrip())

    @property
    def profile_file(self) -> Path:
        """Profile of the running nodes."""
        return Path(self._host.profile_file)

    # -- CPU ----------------------------------------------------------------------------------
    def cpu_s(self) -> dict[str, float]:
        """Process -> CPU time so far; this one is ``camera``."""
        spent = {name: cpu_s(pid) for name, pid in self._host.supervisor.pids().items()}
        return spent | {"robot": cpu_s(self._robot.pid), "camera": time.process_time()}

    # -- one request --------------------------------------------------------------------------
    def _report(self) -> None:
        cameras = {name: {"state": OK, "age_s": 0.0} for name in self._outlets}
        self.node.publish_status(OK, detail={"cameras": cameras})

    def publish(
        self, pictures: Pictures, in_turn: Callable[..., Iterable[None]] = map
    ) -> tuple[int, int]:
        """Publish an image of each camera; returns when, on the monotonic and the wall clock.

        Args:
            pictures: of the cameras.
            in_turn: `map`, or that of an executor: each camera then has a thread, as in a lab.
        """
        mono_ns, wall_ns = time.monotonic_ns(), self.node.clock.wall_ns()

        def publish_one(outlet: CameraPublisher, rgb: NDArray[np.uint8]) -> None:
            outlet.captured(mono_ns)
            outlet.publish_rgb(rgb, mono_ns, wall_ns)

        for _ in in_turn(publish_one, self._outlets.values(), pictures):
            pass
        return mono_ns, wall_ns

    def request(self, pictures: Pictures) -> Answer:
        """Show images and follow them.

        Raises:
            TimeoutError: no chunk or no pose command followed.
        """
        self._poses.drain()
        self._chunks.pop()
        began_ns, stamp_ns = self.publish(pictures)
        self._await_chunk(stamp_ns, began_ns)
        chunk_ns = time.monotonic_ns()
        time.sleep(self._period_s + TICK_MARGIN_S)
        pose, heard_ns = self._await_pose(stamp_ns)
        # Between requests: what is sent while one is under way would be measured with it.
        self._report()
        return Answer(
            {report.CHUNK: (chunk_ns - began_ns) / 1e6}
            | _pose_figures(pose, stamp_ns, (heard_ns - began_ns) / 1e6)
        )

    def _await_chunk(self, stamp_ns: int, began_ns: int) -> None:
        give_up_ns = began_ns + int(ANSWER_PATIENCE_S * 1e9)
        while (left_ns := give_up_ns - time.monotonic_ns()) > 0:
            if not self._chunks.wait(left_ns / 1e9):
                break
            arrival = self._chunks.pop()
            chunk = self.node.decode(ActionChunk, arrival) if arrival else None
            if chunk is not None and chunk.record.observation_stamp_ns == stamp_ns:
                return
        raise TimeoutError

    def _await_pose(self, stamp_ns: int) -> tuple[Stamped[PoseCommand], int]:
        """The first pose command of the image, and when it arrived on the monotonic clock."""
        give_up = time.monotonic() + POSE_PATIENCE_S
        while time.monotonic() < give_up:
            for arrival in self._poses.drain():
                pose = self.node.decode(PoseCommand, arrival)
                cause = pose.record.cause if pose else None
                if pose is not None and cause and cause.observation_stamp_ns == stamp_ns:
                    return pose, arrival.mono_ns
            time.sleep(POLL_S)
        raise TimeoutError

    def awake(self) -> None:
        """Put the prompt again: the command node ticks at its rate for a moment."""
        assert self._host.client is not None
        self._host.client.publish(self.profile.keys.prompt, PROMPT)

    def rest(self) -> None:
        """Between requests: a node that died is not restarted, it ends the measurement.

        Raises:
            NodeError: one died.
        """
        self._robot.check()
        running = self._host.supervisor.pids()
        for child in self._host.supervisor.children:
            if child.command.name not in running:
                said = "\n".join(self._lines[-20:])
                raise NodeError(f"the {child.command.name} under measurement died\n{said}".rstrip())


def _pose_figures(pose: Stamped[PoseCommand], stamp_ns: int, total_ms: float) -> dict[str, float]:
    """Stages from an image to its first pose command, divided by the stamps of the nodes.

    The stages are of the wall clocks of processes of one computer. The last one is what is left of
    the total, so that they add up to it.
    """
    cause = pose.record.cause
    assert cause is not None
    wait_ns = max(pose.header.stamp_wall_ns - cause.received_ns, 0)
    stages = {
        "picture_to_worker": (cause.observed_ns - stamp_ns) / 1e6,
        "worker": (cause.published_ns - cause.observed_ns) / 1e6,
        "chunk_to_command": (cause.received_ns - cause.published_ns) / 1e6,
        report.TICK_WAIT: wait_ns / 1e6,
    }
    return stages | {
        "tick_to_pose": total_ms - sum(stages.values()),
        report.POSE: total_ms,
        report.POSE_WITHOUT_WAIT: total_ms - wait_ns / 1e6,
    }
