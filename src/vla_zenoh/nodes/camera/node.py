"""The camera node: publishes cameras of a profile from one process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from vla_zenoh.bus.buffers import LatestSample, ReceivedSample, ZenohRing
from vla_zenoh.bus.node import Node
from vla_zenoh.keys import last_chunk
from vla_zenoh.nodes.camera.camera_publisher import ENDED, OK, CameraPublisher
from vla_zenoh.nodes.camera.fitted_streams import MAX_MODELS, RequestedSizes
from vla_zenoh.nodes.camera.grabber import SIM, Grabber, choose_cameras, make_source
from vla_zenoh.nodes.camera.source import STALL_S, without_password
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import Profile
from vla_zenoh.types import Event, SceneState, Stamped
from vla_zenoh.types.stream import SingleWriterFilter

TICK_S = 0.05
SPECS_A_TICK = 8
SIZES_PERIOD_S = 0.5
"""Period at which the sizes requested by models are applied, however often they change."""
GOODBYE_S = 0.3
"""Threads get this long to end; one that hangs in a driver is left behind."""


class CameraNode:
    """Publishes each image of its cameras as raw pixels and as JPEG, while there are subscribers.

    Args:
        profile: the effective profile.
        session: an open session; the caller closes it.
        name: of the node; a second camera host needs another one.
        cameras: of the profile, to be served; None: all except those of ROS 2.

    Raises:
        NodeError: unknown camera, or a node of this name is alive already.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        *,
        name: str = "camera",
        cameras: tuple[str, ...] | None = None,
    ) -> None:
        chosen = choose_cameras(profile, cameras)
        self.node = Node(name, profile, session)
        self._scene_writer = SingleWriterFilter(STALL_S)
        self._node_lock = threading.Lock()  # a Node is used by one thread at a time
        self._halt = threading.Event()
        self._publishers = {
            camera: CameraPublisher(
                camera, settings, without_password(settings.source), self.node, self._emit
            )
            for camera, settings in chosen.items()
        }
        self._reported: tuple[tuple[str, ...], tuple[bool, ...]] = ((), ())
        self._threads = [
            self._thread(camera, Grabber(make_source(settings), self._publishers[camera]).run)
            for camera, settings in chosen.items()
            if not settings.source.startswith(SIM)
        ]
        self._requested = RequestedSizes()
        self._sized_s = -1e9
        self._specs: ZenohRing | None = None
        if any(settings.fit_for_workers for settings in chosen.values()):
            self._specs = self.node.subscribe(self.node.keys.all_specs, ZenohRing(SPECS_A_TICK))
        views = [
            (settings.source.removeprefix(SIM), self._publishers[camera])
            for camera, settings in chosen.items()
            if settings.source.startswith(SIM)
        ]
        self._sim: Any = None
        if views:
            from vla_zenoh.nodes.camera.sim_cameras import SimCameras

            scenes = self.node.subscribe(self.node.keys.sim_scene, LatestSample())
            self._sim = SimCameras(profile, views, scenes, self._decode_scene, self._reject)
            self._threads.append(self._thread("sim", self._sim.run))

    def run(self, stop: threading.Event) -> None:
        """Publish until `stop` is set; ends within half a second of it."""
        for thread in self._threads:
            thread.start()
        try:
            while not stop.wait(TICK_S):
                self._report()
                self._apply_specs()
        finally:
            self._halt.set()
            give_up = time.monotonic() + GOODBYE_S
            for thread in self._threads:
                thread.join(max(0.0, give_up - time.monotonic()))
            with self._node_lock:
                self.node.publish_status("stopped", now=True)
                self.node.close()

    def _thread(self, name: str, body: Callable[[threading.Event], None]) -> threading.Thread:
        # A daemon: a driver that hangs must not keep the process alive.
        return threading.Thread(target=body, args=(self._halt,), name=f"camera {name}", daemon=True)

    # -- called by the threads ----------------------------------------------------------------
    def _emit(self, event: Event) -> None:
        with self._node_lock:
            if not self._halt.is_set():
                self.node.emit(event)

    def _reject(self, reason: str, why: str) -> None:
        with self._node_lock:
            self.node.reject(reason, why)

    def _decode_scene(self, arrival: ReceivedSample) -> Stamped[SceneState] | None:
        with self._node_lock:
            return self.node.decode(SceneState, arrival, self._scene_writer)

    # -- called by `run` ----------------------------------------------------------------------
    def _apply_specs(self) -> None:
        """Publish cameras with ``fit_for_workers`` in the sizes that models request."""
        if self._specs is None:
            return
        now_s = time.monotonic()
        for arrival in self._specs.drain():
            worker = last_chunk(str(arrival.sample.key_expr))
            with self._node_lock:
                stamped = self.node.decode(ModelSpec, arrival)
                if stamped is not None and not self._requested.add(worker, stamped.record, now_s):
                    why = f"specs of {MAX_MODELS} workers are known; that of {worker!r} is ignored"
                    self.node.reject("too_many_models", why)
        if now_s - self._sized_s < SIZES_PERIOD_S:
            return
        self._sized_s = now_s
        for name, publisher in self._publishers.items():
            if publisher.profile.fit_for_workers:
                publisher.fitted.serve(self._requested.sizes(name, now_s))

    def _report(self) -> None:
        publishers = self._publishers
        states = tuple(one.state for one in publishers.values())
        bad = tuple(one.fault is not None for one in publishers.values())
        state = "degraded" if any(bad) else _summary(states)
        with self._node_lock:
            changed = (states, bad) != self._reported
            if not changed and not self.node.status_due(state):
                return
            self.node.adopt_system_time()
            self._reported = (states, bad)
            figures = {name: one.figures() for name, one in publishers.items()}
            for one in publishers.values():
                for counter, count in one.counters().items():
                    self.node.counters[counter] = count
            self.node.publish_status(
                state,
                detail={
                    "cameras": {name: one.detail() for name, one in publishers.items()},
                    **({} if self._sim is None else {"renderer": self._sim.renderer}),
                },
                rates_hz={name: rate_hz for name, (rate_hz, _) in figures.items()},
                latency_ms={name: late for name, (_, late) in figures.items() if late is not None},
                now=changed,
            )


def _summary(states: tuple[str, ...]) -> str:
    if all(state == ENDED for state in states):
        return "ended"
    return "running" if all(state in (OK, ENDED) for state in states) else "degraded"
