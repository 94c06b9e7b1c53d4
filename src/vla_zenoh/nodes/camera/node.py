"""The camera node: publishes cameras of a profile from one process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from vla_zenoh.bus.buffers import LatestSample, ReceivedSample, ZenohRing
from vla_zenoh.bus.node import Node
from vla_zenoh.errors import NodeError, in_words
from vla_zenoh.keys import last_chunk
from vla_zenoh.nodes.camera.camera_publisher import OK, CameraPublisher
from vla_zenoh.nodes.camera.image_check import read_references
from vla_zenoh.nodes.camera.source import LOOK_S, STALL_S, Source, prepare_opencv, without_password
from vla_zenoh.policy import CameraSpec, ModelSpec
from vla_zenoh.policy.observation import size_variant
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import CAMERA_SOURCES, CameraProfile
from vla_zenoh.types import Event, SceneState, SingleWriterFilter, Stamped

SIM, ROS2 = "sim:", "ros2:"
BACKOFF_S, MAX_BACKOFF_S = 0.2, 2.0
BROKEN_IN_A_ROW = 5


def choose_cameras(profile: Profile, cameras: tuple[str, ...] | None) -> dict[str, CameraProfile]:
    """The named cameras, or all except those of ROS 2; `NodeError`: there is none of that name."""
    ours = {name: one for name, one in profile.cameras.items() if not one.source.startswith(ROS2)}
    known = f"this node can serve: {', '.join(ours) or 'none'}"
    for name in cameras or ():
        if name not in profile.cameras:
            raise NodeError(f"profile {profile.name!r} has no camera {name!r}; {known}")
        if name not in ours:
            raise NodeError(f"camera {name!r} comes from ROS 2, the ros2 node serves it; {known}")
    chosen = ours if cameras is None else {name: ours[name] for name in cameras}
    if not chosen:
        raise NodeError(f"profile {profile.name!r} has no camera for this node to serve")
    return chosen


def make_source(profile: CameraProfile) -> Source:
    """The source of a camera, not open yet. Call it before threads start: it configures OpenCV."""
    prepare_opencv()
    kind, _, rest = profile.source.partition(":")
    if kind in ("v4l2", "rtsp", "rtsps"):
        from vla_zenoh.nodes.camera.capture import RtspSource, V4l2Source

        return V4l2Source(rest, profile) if kind == "v4l2" else RtspSource(profile.source)
    if kind == "file":
        from vla_zenoh.nodes.camera.file import FileSource

        return FileSource(rest, profile.rate_hz)
    if kind == "realsense":
        from vla_zenoh.nodes.camera.realsense import RealsenseSource

        return RealsenseSource(rest, profile)
    known = ", ".join(name for name in CAMERA_SOURCES if name not in ("sim", "ros2"))
    raise NodeError(f"no camera source called {kind!r}; there are: {known}, sim")


class Grabber:
    """Reads one source and reopens it after every failure; `run` is the body of a thread."""

    def __init__(self, source: Source, publisher: CameraPublisher) -> None:
        self._source, self._publisher = source, publisher
        self._backoff_s = BACKOFF_S

    def run(self, stop: threading.Event) -> None:
        """Grab images until `stop` is set."""
        while not stop.is_set():
            try:
                self._source.open()
                self._publisher.opened(
                    self._source.backend, self._source.same_s, self._source.intrinsics
                )
                self._grab_all(stop)
            except Exception as error:  # whatever a driver raises must not end the other cameras
                if stop.is_set():
                    return
                self._publisher.lose(in_words(error))
            finally:
                self._source.close()
            stop.wait(self._backoff_s)
            self._backoff_s = min(2 * self._backoff_s, MAX_BACKOFF_S)

    def _grab_all(self, stop: threading.Event) -> None:
        source, publisher = self._source, self._publisher
        opened = last_good = looked = time.monotonic()
        proved, broken = False, 0
        while (mono_ns := source.grab(stop)) is not None and not stop.is_set():
            now = time.monotonic()
            if proved:
                publisher.captured(mono_ns)
            # The current time, not that of capture: a backlog must not come out in a burst.
            if not publisher.due(time.monotonic_ns()):
                continue
            wanted = publisher.has_subscribers or not proved
            if not wanted and now - looked < LOOK_S:
                last_good = now
                continue
            image = source.retrieve()
            if image is None:
                publisher.count_broken()
                broken += 1
                if broken >= BROKEN_IN_A_ROW and now - last_good > STALL_S:
                    raise NodeError(f"the last {broken} images could not be decoded")
                continue
            looked = now
            publisher.check(image, mono_ns, source.stamp_ns)
            if wanted:
                depth_m = source.depth_m() if publisher.wants_depth else None
                publisher.publish(image, mono_ns, depth_m)
            publisher.captured(mono_ns)
            last_good, proved, broken = now, True, 0
            publisher.set_state(OK)
            if now - opened > STALL_S:
                self._backoff_s = BACKOFF_S


SILENCE_S = 5.0
"""A worker publishes its spec once a second; after this silence it counts as gone."""
MAX_MODELS = 64


class RequestedSizes:
    """Image sizes that live workers ask for, from the newest spec of each; `now_s`: monotonic."""

    def __init__(self) -> None:
        self._specs: dict[str, tuple[float, ModelSpec]] = {}

    def add(self, worker: str, spec: ModelSpec, now_s: float) -> bool:
        """Keep a worker's spec; False if there are `MAX_MODELS` of other workers already."""
        self._forget(now_s)
        if worker not in self._specs and len(self._specs) >= MAX_MODELS:
            return False
        self._specs[worker] = (now_s, spec)
        return True

    def sizes(self, camera: str, now_s: float) -> dict[str, CameraSpec]:
        """Variant name -> spec of the camera, in the order in which workers appeared."""
        self._forget(now_s)
        return {
            variant: one
            for _, spec in self._specs.values()
            for one in spec.observation.cameras
            if one.camera == camera and (variant := size_variant(one)) is not None
        }

    def _forget(self, now_s: float) -> None:
        self._specs = {
            worker: heard for worker, heard in self._specs.items() if now_s - heard[0] <= SILENCE_S
        }


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
        session: open session, which the caller closes.
        name: of the node; a second camera host needs another one.
        cameras: names of those to serve; None: all except those of ROS 2.

    Raises:
        NodeError: unknown camera, a reference that is not an image, or a node of this name is alive
            already.
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
        references = read_references(chosen)
        self._publishers: dict[str, CameraPublisher] = {}
        self._threads: list[threading.Thread] = []
        views: list[tuple[str, CameraPublisher]] = []
        for camera, settings in chosen.items():
            source = settings.source
            publisher = self._publishers[camera] = CameraPublisher(
                *(camera, settings, without_password(source), self.node, self._emit),
                references=references,
            )
            if source.startswith(SIM):
                views.append((source.removeprefix(SIM), publisher))
            else:
                self._add_thread(camera, Grabber(make_source(settings), publisher).run)
        self._reported: tuple[tuple[str, ...], tuple[bool, ...]] = ((), ())
        self._requested = RequestedSizes()
        self._sized_s = -1e9
        self._specs: ZenohRing | None = None
        if any(settings.fit_for_workers for settings in chosen.values()):
            self._specs = self.node.subscribe(self.node.keys.all_specs, ZenohRing(SPECS_A_TICK))
        self._sim: Any = None
        if views:
            from vla_zenoh.nodes.camera.sim_cameras import SimCameras

            scenes = self.node.subscribe(self.node.keys.sim_scene, LatestSample())
            self._sim = SimCameras(profile, views, scenes, self._decode_scene, self._reject)
            self._add_thread("sim", self._sim.run)

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

    def _add_thread(self, name: str, body: Callable[[threading.Event], None]) -> None:
        # A daemon: a driver that hangs must not keep the process alive.
        self._threads.append(
            threading.Thread(target=body, args=(self._halt,), name=f"camera {name}", daemon=True)
        )

    # Called by the threads.
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

    # Called by `run`.
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
        good = all(state == OK for state in states) and not any(bad)
        state = "running" if good else "degraded"
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
            detail: dict[str, Any] = {
                "cameras": {name: one.detail() for name, one in publishers.items()}
            }
            if self._sim is not None:
                detail["renderer"] = self._sim.renderer
            self.node.publish_status(
                state,
                detail=detail,
                rates_hz={name: rate_hz for name, (rate_hz, _) in figures.items()},
                latency_ms={name: late for name, (_, late) in figures.items() if late is not None},
                now=changed,
            )
