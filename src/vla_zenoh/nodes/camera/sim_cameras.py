"""Cameras of the simulated scene: one renderer draws for all of them.

Rendering runs in the camera node's process, from the scene that the simulator publishes, so that it
never disturbs the control loop. An image carries the stamp of the `SceneState` it was drawn from.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.bus.buffers import LatestSample, ReceivedSample
from vla_zenoh.errors import MissingExtraError, RecordError, VlaZenohError, in_words
from vla_zenoh.nodes.camera.camera_publisher import OK, WAITING, CameraPublisher
from vla_zenoh.nodes.camera.geometry import Intrinsics
from vla_zenoh.nodes.camera.source import STALL_S
from vla_zenoh.profile import Profile
from vla_zenoh.simulation.backend import AUTO, RAYCAST, choose_backend
from vla_zenoh.simulation.robot_model import robot_models
from vla_zenoh.types import SceneState, Stamped

if TYPE_CHECKING:
    from vla_zenoh.simulation.render import Renderer

WAKE_S = 0.1
IDLE_PERIOD_S = 1.0
"""Without subscribers one image in this time is drawn, to prove that rendering works."""
BACKOFF_S, MAX_BACKOFF_S = 0.5, 10.0
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
        backoff_s = BACKOFF_S
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
                backoff_s = BACKOFF_S
            stop.wait(backoff_s)
            backoff_s = min(2 * backoff_s, MAX_BACKOFF_S)

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
                publisher.why = f"no scene on {key} yet"
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
