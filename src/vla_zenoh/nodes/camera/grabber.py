"""Chooses the cameras of a node, opens their sources, and reads each one in a thread."""

from __future__ import annotations

import threading
import time

from vla_zenoh.errors import NodeError, in_words
from vla_zenoh.nodes.camera.camera_publisher import ENDED, OK, CameraPublisher
from vla_zenoh.nodes.camera.source import LOOK_S, STALL_S, Source
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import CameraProfile

SIM, ROS2 = "sim:", "ros2:"
BACKOFF_S, MAX_BACKOFF_S = 0.2, 2.0
BROKEN_IN_A_ROW = 5


def choose_cameras(profile: Profile, cameras: tuple[str, ...] | None) -> dict[str, CameraProfile]:
    """The named cameras, or all except those of ROS 2.

    Raises:
        NodeError: unknown camera, a camera of ROS 2, or no camera at all.
    """
    ours = {
        name: camera
        for name, camera in profile.cameras.items()
        if not camera.source.startswith(ROS2)
    }
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
    """The source of a camera, not open yet. Call it before threads start: it configures OpenCV.

    Raises:
        NodeError: unknown kind of source.
    """
    from vla_zenoh.nodes.camera.opencv import prepare

    prepare()
    kind, _, rest = profile.source.partition(":")
    if kind == "v4l2":
        from vla_zenoh.nodes.camera.v4l2 import V4l2Source

        return V4l2Source(rest, profile)
    if kind in ("rtsp", "rtsps"):
        from vla_zenoh.nodes.camera.rtsp import RtspSource

        return RtspSource(profile.source)
    if kind == "file":
        from vla_zenoh.nodes.camera.file import FileSource

        return FileSource(rest, profile.rate_hz, profile.loop)
    raise NodeError(f"no camera source called {kind!r}; there are: v4l2, rtsp, rtsps, file, sim")


class Grabber:
    """Reads one source and reopens it after every failure; `run` is the body of a thread.

    Args:
        source: of the images.
        publisher: publishes them.
    """

    def __init__(self, source: Source, publisher: CameraPublisher) -> None:
        self._source, self._publisher = source, publisher
        self._backoff_s = BACKOFF_S

    def run(self, stop: threading.Event) -> None:
        """Grab images until `stop` is set or the source ends."""
        while not stop.is_set():
            try:
                self._source.open()
                self._publisher.opened(self._source.backend, self._source.same_s)
                self._grab_all(stop)
            except Exception as error:  # whatever a driver raises must not end the other cameras
                if stop.is_set():
                    return
                self._publisher.lose(in_words(error))
            else:
                if not stop.is_set():
                    self._publisher.set_state(ENDED, "the last image was shown, and loop is false")
                return
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
                publisher.publish(image, mono_ns)
            publisher.captured(mono_ns)
            last_good, proved, broken = now, True, 0
            publisher.set_state(OK)
            if now - opened > STALL_S:
                self._backoff_s = BACKOFF_S
