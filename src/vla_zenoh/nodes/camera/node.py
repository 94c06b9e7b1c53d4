"""Pictures on the bus: several cameras of a profile from one process."""

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
"""The sizes that models want are looked at so often, however often they change their minds."""
GOODBYE_S = 0.3
"""Threads get this long to end; one that hangs in a driver is left behind."""


class CameraNode:
    """Serves cameras: each picture once, as raw pixels and as JPEG, while somebody listens.

    Args:
        profile: the effective profile.
        session: an open session, closed by whoever opened it.
        name: the node's; another one is needed for a second camera host.
        cameras: which of the profile's to serve; None means all but those of ROS 2.

    Raises:
        NodeError: there is no such camera, or a node of this name is alive already.
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
        self._scene_speaker = SingleWriterFilter(STALL_S)
        self._voice = threading.Lock()  # a Node speaks for one thread at a time
        self._halt = threading.Event()
        self._outlets = {
            camera: CameraPublisher(
                camera, settings, without_password(settings.source), self.node, self._tell
            )
            for camera, settings in chosen.items()
        }
        self._told: tuple[tuple[str, ...], tuple[bool, ...]] = ((), ())
        self._sim: Any = None
        self._threads = [
            self._thread(camera, Grabber(make_source(settings), self._outlets[camera]).run)
            for camera, settings in chosen.items()
            if not settings.source.startswith(SIM)
        ]
        self._asked = RequestedSizes()
        self._sized_s = -1e9
        self._specs: ZenohRing | None = None
        if any(settings.fit_for_workers for settings in chosen.values()):
            self._specs = self.node.subscribe(self.node.keys.all_specs, ZenohRing(SPECS_A_TICK))
        views = [
            (settings.source.removeprefix(SIM), self._outlets[camera])
            for camera, settings in chosen.items()
            if settings.source.startswith(SIM)
        ]
        if views:
            from vla_zenoh.nodes.camera.sim_cameras import SimCameras

            slot = self.node.subscribe(self.node.keys.sim_scene, LatestSample())
            self._sim = SimCameras(profile, views, slot, self._read_scene, self._refuse)
            self._threads.append(self._thread("sim", self._sim.run))

    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set; ends within half a second of it."""
        for thread in self._threads:
            thread.start()
        try:
            while not stop.wait(TICK_S):
                self._watch()
                self._hear_models()
        finally:
            self._halt.set()
            give_up = time.monotonic() + GOODBYE_S
            for thread in self._threads:
                thread.join(max(0.0, give_up - time.monotonic()))
            with self._voice:
                self.node.publish_status("stopped", now=True)
                self.node.close()

    def _thread(self, name: str, body: Callable[[threading.Event], None]) -> threading.Thread:
        # A daemon: a driver that hangs must not keep the process alive.
        return threading.Thread(target=body, args=(self._halt,), name=f"camera {name}", daemon=True)

    # -- for the threads ----------------------------------------------------------------------
    def _tell(self, event: Event) -> None:
        with self._voice:
            if not self._halt.is_set():
                self.node.emit(event)

    def _refuse(self, reason: str, why: str) -> None:
        with self._voice:
            self.node.reject(reason, why)

    def _read_scene(self, arrival: ReceivedSample) -> Stamped[SceneState] | None:
        with self._voice:
            return self.node.decode(SceneState, arrival, self._scene_speaker)

    def _hear_models(self) -> None:
        """Serve the sizes that models want, where the profile says so."""
        if self._specs is None:
            return
        now_s = time.monotonic()
        for arrival in self._specs.drain():
            worker = last_chunk(str(arrival.sample.key_expr))
            with self._voice:
                stamped = self.node.decode(ModelSpec, arrival)
                if stamped is not None and not self._asked.add(worker, stamped.record, now_s):
                    why = f"specs of {MAX_MODELS} workers are known; that of {worker!r} is not read"
                    self.node.reject("too_many_models", why)
        if now_s - self._sized_s < SIZES_PERIOD_S:
            return
        self._sized_s = now_s
        for name, outlet in self._outlets.items():
            if outlet.profile.fit_for_workers:
                outlet.forms.serve(self._asked.sizes(name, now_s))

    # -- status -------------------------------------------------------------------------------
    def _watch(self) -> None:
        states = tuple(outlet.state for outlet in self._outlets.values())
        bad = tuple(outlet.bad is not None for outlet in self._outlets.values())
        state = "degraded" if any(bad) else _summary(states)
        with self._voice:
            changed = (states, bad) != self._told
            if not changed and not self.node.status_due(state):
                return
            self.node.adopt_system_time()
            self._told = (states, bad)
            figures = {name: outlet.figures() for name, outlet in self._outlets.items()}
            for outlet in self._outlets.values():
                for what, count in outlet.counters().items():
                    self.node.counters[what] = count
            self.node.publish_status(
                state,
                detail={
                    "cameras": {name: outlet.detail() for name, outlet in self._outlets.items()},
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
