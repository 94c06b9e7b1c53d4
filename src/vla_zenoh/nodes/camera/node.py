"""The camera node: publishes cameras of a profile from one process; it draws the simulated ones."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from vla_zenoh import plugins
from vla_zenoh.bus.bounded import Bounded
from vla_zenoh.bus.buffers import LatestSample, ReceivedSample, ZenohRing
from vla_zenoh.bus.node import Node
from vla_zenoh.errors import MissingExtraError, NodeError, RecordError, VlaZenohError, in_words
from vla_zenoh.keys import OPENING, last_chunk
from vla_zenoh.nodes.camera.camera_publisher import OK, WAITING, CameraPublisher
from vla_zenoh.nodes.camera.geometry import Intrinsics
from vla_zenoh.nodes.camera.image_check import read_references
from vla_zenoh.nodes.camera.source import STALL_S, Grabber, Source, prepare_opencv, without_password
from vla_zenoh.opencv import cv2
from vla_zenoh.policy import CameraSpec, ModelSpec
from vla_zenoh.policy.observation import size_variant
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.simulation.backend import AUTO, RAYCAST, choose_backend
from vla_zenoh.simulation.robot_model import robot_models
from vla_zenoh.types import Event, SceneState, SingleWriterFilter, Stamped

if TYPE_CHECKING:
    from vla_zenoh.simulation.render import Renderer

SIM, ROS2 = "sim:", "ros2:"


def choose_cameras(profile: Profile, cameras: tuple[str, ...] | None) -> dict[str, CameraProfile]:
    """The named cameras, or all except those of ROS 2.

    Raises:
        NodeError: there is none of that name.
        PluginError: what reads one of them is not installed.
    """
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
    for camera in chosen.values():
        plugins.load(plugins.CAMERAS, camera.source.partition(":")[0])
    return chosen


def make_source(profile: CameraProfile) -> Source:
    """The source of a camera, not open yet. Call it before threads start: it configures OpenCV.

    Raises:
        PluginError: no plug-in for it is installed.
        NodeError: another node publishes it, or its plug-in fails.
    """
    kind, _, rest = profile.source.partition(":")
    plugin = plugins.load(plugins.CAMERAS, kind)
    if plugin.make is None:
        raise NodeError(f"{profile.source!r}: no camera node reads {kind}:")
    prepare_opencv()
    try:
        source = plugin.make(rest, profile)
    except VlaZenohError:
        raise
    except Exception as error:
        raise NodeError(f"{profile.source!r} cannot be made: {in_words(error)}") from error
    if not isinstance(source, Source):
        raise NodeError(
            f"{profile.source!r}: {type(source).__name__} is no {Source.__module__}.Source"
        )
    return source


SILENCE_S = 5.0
"""A worker publishes its spec once a second; after this silence it counts as gone."""
MAX_MODELS = 64


class RequestedSizes:
    """Image sizes that live workers ask for, from the newest spec of each; `now_s`: monotonic."""

    def __init__(self) -> None:
        self._specs: Bounded[str, tuple[float, ModelSpec]] = Bounded(MAX_MODELS)

    def add(self, worker: str, spec: ModelSpec, now_s: float) -> bool:
        """Keep a worker's spec; False if that of another worker had to make room."""
        dropped = self._specs.dropped
        self._specs[worker] = (now_s, spec)
        return self._specs.dropped == dropped

    def sizes(self, camera: str, now_s: float) -> dict[str, CameraSpec]:
        """Variant name -> spec of the camera."""
        return {
            variant: one
            for heard_s, spec in self._specs.values()
            for one in spec.observation.cameras
            if one.camera == camera and now_s - heard_s <= SILENCE_S
            if (variant := size_variant(one)) is not None
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
        self._sim: SimCameras | None = None
        if views:
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
                self.node.publish_end()
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
                    why = f"more than {MAX_MODELS} workers have a spec; the newest: {worker!r}"
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


WAKE_S = 0.1
IDLE_PERIOD_S = 1.0
"""Without subscribers one image in this time is drawn, to prove that rendering works."""
RENDERER_BACKOFF_S, MAX_RENDERER_BACKOFF_S = 0.5, 10.0
COARSEST = 4
TOO_SLOW, WITH_EASE = 0.5, 0.25
"""Share of a camera's period above which rendering gets coarser, and below which finer."""
MEMORY = 0.8


class RenderBudget:
    """Adapts the resolution of ray casting to the time it takes: every `step`-th pixel is drawn."""

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz
        self._mean_s: float | None = None
        self.step = 1

    def add(self, seconds: float) -> None:
        """Account for an image that took this long to draw."""
        before_s = seconds if self._mean_s is None else self._mean_s
        mean_s = MEMORY * before_s + (1 - MEMORY) * seconds
        step = self.step
        if mean_s > TOO_SLOW * self._period_s and step < COARSEST:
            step += 1
        elif step > 1 and mean_s * (step / (step - 1)) ** 2 < WITH_EASE * self._period_s:
            step -= 1
        # Time is about proportional to the number of pixels.
        self._mean_s, self.step = mean_s * (self.step / step) ** 2, step


class SimCameras:
    """All simulated cameras of a node; `run` is the body of a thread.

    One renderer draws for all of them, from the scene that the simulator publishes, so that it
    never disturbs the control loop. An image carries the stamp of the `SceneState` it was drawn
    from.

    `views` has the name of each camera in the scene and its publisher, `buffer` the newest scene;
    `decode` returns None if it was rejected.
    """

    def __init__(
        self,
        profile: Profile,
        views: Sequence[tuple[str, CameraPublisher]],
        buffer: LatestSample,
        decode: Callable[[ReceivedSample], Stamped[SceneState] | None],
        reject: Callable[[str, str], None],
    ) -> None:
        self._profile, self._views, self._buffer = profile, tuple(views), buffer
        self._decode, self._reject = decode, reject
        self._drawn_ns: dict[str, int] = {}
        self._budgets = {one.name: RenderBudget(one.profile.rate_hz) for _, one in self._views}
        self._received_ns = time.monotonic_ns()
        self._seed: int | None = None
        self.renderer = "not ready yet"

    def run(self, stop: threading.Event) -> None:
        """Render until `stop` is set; a renderer that fails is replaced."""
        backoff_s = RENDERER_BACKOFF_S
        while not stop.is_set():
            self._drawn_ns = {publisher.name: 0 for _, publisher in self._views}
            try:
                with self._make_renderer() as renderer:
                    self._render_scenes(renderer, stop)
            except Exception as error:  # drivers raise anything, and none of it may end the thread
                if stop.is_set():
                    return
                self.renderer = f"none: {in_words(error)}"
                for _, publisher in self._views:
                    publisher.lose(in_words(error))
            if any(publisher.state == OK for _, publisher in self._views):
                backoff_s = RENDERER_BACKOFF_S
            stop.wait(backoff_s)
            backoff_s = min(2 * backoff_s, MAX_RENDERER_BACKOFF_S)

    def _make_renderer(self) -> Renderer:
        wanted = self._profile.sim.renderer
        robot = robot_models(self._profile)
        try:
            # "auto" leaves the choice to the environment variable, if it is set.
            backend = choose_backend(None if wanted == AUTO else wanted)
            # After the choice: with a bad MUJOCO_GL in the environment this import itself fails.
            from vla_zenoh.simulation.render import Renderer

            renderer = Renderer(self._profile.sim.scene, robot, backend)
        except ImportError as error:
            if isinstance(error, VlaZenohError):
                raise
            raise MissingExtraError(error.name or str(error), "sim") from error
        self.renderer, self._seed = backend.name, None
        if backend.reason:
            advice = f"; on Debian: apt-get install {backend.install}" if backend.install else ""
            self.renderer += f", since {backend.reason}{advice}"
        for _, publisher in self._views:
            publisher.backend = backend.name
        return renderer

    def _render_scenes(self, renderer: Renderer, stop: threading.Event) -> None:
        known = set(renderer.cameras)
        views = [(camera, publisher) for camera, publisher in self._views if camera in known]
        for camera, publisher in self._views:
            if camera not in known:
                publisher.lose(
                    f"scene {self._profile.sim.scene!r} has no camera {camera!r}; there are: "
                    f"{', '.join(renderer.cameras)}"
                )
        key = self._profile.keys.short(self._profile.keys.sim_scene)
        self._received_ns = max(self._received_ns, time.monotonic_ns())
        for camera, publisher in views:
            width, height = publisher.profile.width, publisher.profile.height
            focal_px = renderer.focal_px(camera, height)
            cx_px, cy_px = width / 2, height / 2
            publisher.intrinsics = Intrinsics(
                width=width, height=height, fx_px=focal_px, fy_px=focal_px, cx_px=cx_px, cy_px=cy_px
            ).shown()
            if publisher.state == WAITING:  # without an event
                publisher.why = f"{OPENING}: no scene on {key} yet"
        while not stop.is_set():
            if not self._buffer.wait(WAKE_S):
                if time.monotonic_ns() - self._received_ns > STALL_S * 1e9:
                    why = f"no scene on {key} for {STALL_S:g} s; does the sim node run?"
                    for _, publisher in views:
                        publisher.lose(why)
                continue
            arrival = self._buffer.pop()
            stamped = None if arrival is None else self._decode(arrival)
            if arrival is not None and stamped is not None and self._show(renderer, stamped.record):
                self._received_ns = arrival.mono_ns
                self._render_due(renderer, views, stamped.header.stamp_wall_ns, arrival.mono_ns)

    def _show(self, renderer: Renderer, scene: SceneState) -> bool:
        if scene.scene != self._profile.sim.scene:
            self._reject(
                "foreign_scene",
                f"sim/scene is of scene {scene.scene[:60]!r}, the profile has "
                f"{self._profile.sim.scene!r}: start both with one profile",
            )
            return False
        if scene.seed != self._seed and self._profile.sim.vary:
            renderer.vary(scene.seed, self._profile.sim.vary)
            self._seed = scene.seed
        try:
            renderer.set_qpos(scene.qpos)
        except RecordError as error:
            self._reject("invalid", f"sim/scene: {error}")
            return False
        return True

    def _render_due(
        self,
        renderer: Renderer,
        views: Sequence[tuple[str, CameraPublisher]],
        stamp_ns: int,
        mono_ns: int,
    ) -> None:
        for camera, publisher in views:
            # In simulated time, which in lockstep differs from every clock here.
            due = publisher.due(stamp_ns)
            proof_due = mono_ns - self._drawn_ns[publisher.name] > IDLE_PERIOD_S * 1e9
            if due if publisher.has_subscribers else proof_due:
                rgb = self._render(renderer, camera, publisher)
                publisher.check(rgb, mono_ns)
                width, height = publisher.profile.width, publisher.profile.height
                depth_m = None
                if publisher.wants_depth:
                    depth_m = renderer.render_depth(camera, width, height)
                publisher.publish_rgb(rgb, mono_ns, stamp_ns, depth_m)
                self._drawn_ns[publisher.name] = mono_ns
                publisher.set_state(OK)
            publisher.captured(mono_ns)

    def _render(
        self, renderer: Renderer, camera: str, publisher: CameraPublisher
    ) -> NDArray[np.uint8]:
        """One image in full size, drawn coarser where ray casting would be too slow."""
        width, height = publisher.profile.width, publisher.profile.height
        budget = self._budgets[publisher.name]
        began = time.perf_counter()
        step = budget.step
        rgb = renderer.render(camera, -(-width // step), -(-height // step))
        if step > 1:
            scaled = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR)
            rgb = np.asarray(scaled, np.uint8)
        if renderer.backend.name == RAYCAST:
            budget.add(time.perf_counter() - began)
            publisher.backend = RAYCAST if budget.step == 1 else f"{RAYCAST} 1/{budget.step}"
        return rgb
