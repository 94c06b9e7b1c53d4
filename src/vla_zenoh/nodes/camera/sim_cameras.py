"""Cameras of the simulated scene: one renderer draws for all of them.

It draws in the camera node's process, from the scene the simulator publishes, so that drawing never
disturbs the control loop. A picture has the stamp of the `SceneState` it was drawn from.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.bus.buffers import LatestSample, ReceivedSample
from vla_zenoh.errors import MissingExtraError, NodeError, RecordError, VlaZenohError
from vla_zenoh.nodes.camera.camera_publisher import OK, CameraPublisher
from vla_zenoh.nodes.camera.source import STALL_S
from vla_zenoh.profile import Profile
from vla_zenoh.simulation.render import AUTO, Renderer, choose_backend
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.types import SceneState, Stamped

COARSEST = 4
TOO_SLOW, WITH_EASE = 0.5, 0.25
"""Share of a camera's period that drawing may take before it gets coarser, and to get finer."""
MEMORY = 0.8


class RenderBudget:
    """Every how many pixels one is drawn, for one camera; the rest is interpolated.

    Args:
        rate_hz: pictures per second that are wanted.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz
        self._mean_s: float | None = None
        self.step = 1

    def took(self, seconds: float) -> None:
        """A picture took this long to draw."""
        mean_s = seconds if self._mean_s is None else self._mean_s
        mean_s = MEMORY * mean_s + (1 - MEMORY) * seconds
        self._mean_s = mean_s
        if mean_s > TOO_SLOW * self._period_s and self.step < COARSEST:
            self._change(self.step + 1)
        elif self.step > 1:
            finer = self.step - 1
            if mean_s * (self.step / finer) ** 2 < WITH_EASE * self._period_s:
                self._change(finer)

    def _change(self, step: int) -> None:
        # What was measured says nothing of the new step; scaled by pixels it is a fair guess.
        if self._mean_s is not None:
            self._mean_s *= (self.step / step) ** 2
        self.step = step


RAYCAST = "raycast"
WAKE_S = 0.1
IDLE_PERIOD_S = 1.0
"""With nobody listening one picture in this time is drawn, to know that it can be."""
BACKOFF_S, MAX_BACKOFF_S = 0.5, 10.0


class SimCameras:
    """Body of a thread that serves all simulated cameras.

    Args:
        profile: scene, robot and choice of renderer.
        views: the scene's name of each camera, and where its pictures go.
        slot: the newest scene.
        read: decodes a scene, None when it is refused.
        refuse: counts and tells a refusal: reason, why.
    """

    def __init__(
        self,
        profile: Profile,
        views: Sequence[tuple[str, CameraPublisher]],
        slot: LatestSample,
        read: Callable[[ReceivedSample], Stamped[SceneState] | None],
        refuse: Callable[[str, str], None],
    ) -> None:
        self._profile, self._views, self._slot = profile, tuple(views), slot
        self._read, self._refuse = read, refuse
        self._drawn_ns = {outlet.name: 0 for _, outlet in self._views}
        self._coarseness = {
            outlet.name: RenderBudget(outlet.profile.rate_hz) for _, outlet in self._views
        }
        self._heard_ns = time.monotonic_ns()
        self._seed: int | None = None
        self.renderer = "not ready yet"

    def run(self, stop: threading.Event) -> None:
        """Draw until `stop` is set; a renderer that fails is made anew."""
        backoff_s = BACKOFF_S
        while not stop.is_set():
            self._drawn_ns = dict.fromkeys(self._drawn_ns, 0)
            try:
                with self._make_renderer() as renderer:
                    self._draw_all(renderer, stop)
            except Exception as error:  # drivers raise what they like, and that must not end us
                if stop.is_set():
                    return
                known = isinstance(error, VlaZenohError)
                why = str(error) if known else f"{type(error).__name__}: {error}"
                self.renderer = f"none: {why}"
                self._lose_all(why)
            if any(outlet.state == OK for _, outlet in self._views):
                backoff_s = BACKOFF_S
            stop.wait(backoff_s)
            backoff_s = min(2 * backoff_s, MAX_BACKOFF_S)

    def _make_renderer(self) -> Renderer:
        wanted = self._profile.sim.renderer
        robot = RobotModel(
            description=self._profile.robot.description,
            arm_joints=self._profile.robot.arm_joints,
            tcp_link=self._profile.robot.tcp_frame,
        )
        try:
            # "auto" leaves the choice to the environment variable, where there is one.
            backend = choose_backend(None if wanted == AUTO else wanted)
            renderer = Renderer(self._profile.sim.scene, robot, backend)
        except ImportError as error:
            if isinstance(error, VlaZenohError):
                raise
            raise MissingExtraError(error.name or str(error), "sim") from error
        self.renderer, self._seed = backend.name, None
        if backend.reason:
            advice = f"; on Debian: apt-get install {backend.install}" if backend.install else ""
            self.renderer += f", since {backend.reason}{advice}"
        for _, outlet in self._views:
            outlet.backend = backend.name
        return renderer

    def _draw_all(self, renderer: Renderer, stop: threading.Event) -> None:
        known = set(renderer.cameras)
        views = [(camera, outlet) for camera, outlet in self._views if camera in known]
        for camera, outlet in self._views:
            if camera not in known:
                outlet.lose(
                    f"scene {self._profile.sim.scene!r} has no camera {camera!r}; there are: "
                    f"{', '.join(renderer.cameras)}"
                )
        key = self._profile.keys.short(self._profile.keys.sim_scene)
        self._heard_ns = max(self._heard_ns, time.monotonic_ns())
        for _, outlet in views:
            outlet.wait(f"no scene on {key} yet")
        while not stop.is_set():
            if not self._slot.wait(WAKE_S):
                if time.monotonic_ns() - self._heard_ns > STALL_S * 1e9:
                    for _, outlet in views:
                        outlet.lose(f"no scene on {key} for {STALL_S:g} s; does the sim node run?")
                continue
            arrival = self._slot.pop()
            stamped = None if arrival is None else self._read(arrival)
            if arrival is not None and stamped is not None and self._show(renderer, stamped.record):
                self._heard_ns = arrival.mono_ns
                self._draw_due(renderer, views, stamped.header.stamp_wall_ns, arrival.mono_ns)

    def _show(self, renderer: Renderer, scene: SceneState) -> bool:
        if scene.scene != self._profile.sim.scene:
            self._refuse(
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
            self._refuse("invalid", f"sim/scene: {error}")
            return False
        return True

    def _draw_due(
        self,
        renderer: Renderer,
        views: Sequence[tuple[str, CameraPublisher]],
        stamp_ns: int,
        mono_ns: int,
    ) -> None:
        for camera, outlet in views:
            # By the world's own time, which in lockstep is not that of any clock here.
            in_time = outlet.in_time(stamp_ns)
            proof_due = mono_ns - self._drawn_ns[outlet.name] > IDLE_PERIOD_S * 1e9
            if in_time if outlet.wanted else proof_due:
                rgb = self._draw(renderer, camera, outlet)
                outlet.look(rgb, mono_ns)
                outlet.put_rgb(rgb, mono_ns, stamp_ns)
                self._drawn_ns[outlet.name] = mono_ns
                outlet.change(OK)
            outlet.seen(mono_ns)

    def _draw(self, renderer: Renderer, camera: str, outlet: CameraPublisher) -> NDArray[np.uint8]:
        """One picture in full size; coarser inside where ray casting would be too slow."""
        width, height = outlet.profile.width, outlet.profile.height
        coarseness = self._coarseness[outlet.name]
        began = time.perf_counter()
        step = coarseness.step
        rgb = renderer.render(camera, -(-width // step), -(-height // step))
        if step > 1:
            scaled = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR)
            rgb = np.asarray(scaled, np.uint8)
        if rgb.shape != (height, width, 3):
            raise NodeError(f"the renderer drew a picture of shape {rgb.shape}")
        if renderer.backend.name == RAYCAST:
            coarseness.took(time.perf_counter() - began)
            outlet.backend = RAYCAST if coarseness.step == 1 else f"{RAYCAST} 1/{coarseness.step}"
        return rgb

    def _lose_all(self, why: str) -> None:
        for _, outlet in self._views:
            outlet.lose(why)
