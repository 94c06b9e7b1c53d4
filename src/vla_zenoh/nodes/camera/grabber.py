"""Takes pictures from one source for ever, whatever becomes of it."""

from __future__ import annotations

import threading
import time

from vla_zenoh.errors import NodeError, VlaZenohError
from vla_zenoh.nodes.camera.camera_publisher import ENDED, OK, CameraPublisher
from vla_zenoh.nodes.camera.source import LOOK_S, STALL_S, Source
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import CameraProfile

SIM, ROS2 = "sim:", "ros2:"


def choose_cameras(profile: Profile, cameras: tuple[str, ...] | None) -> dict[str, CameraProfile]:
    """The cameras asked for, or all that are not ROS 2's.

    Raises:
        NodeError: there is no such camera, it is not ours to serve, or none is left.
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
    """The source of a camera that has a thread of its own.

    Raises:
        NodeError: the source is none of these.
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


BACKOFF_S, MAX_BACKOFF_S = 0.2, 2.0
BROKEN_IN_A_ROW = 5


class Grabber:
    """Body of a thread that serves one camera.

    Args:
        source: where its pictures come from.
        outlet: where they go.
    """

    def __init__(self, source: Source, outlet: CameraPublisher) -> None:
        self._source, self._outlet = source, outlet
        self._backoff_s = BACKOFF_S

    def run(self, stop: threading.Event) -> None:
        """Grab until `stop` is set or the source ends; what fails is opened again."""
        while not stop.is_set():
            try:
                self._source.open()
                self._outlet.opened(self._source.backend, self._source.same_s)
                self._grab_all(stop)
            except Exception as error:  # no camera may end the others, whatever its library does
                if stop.is_set():
                    return
                known = isinstance(error, VlaZenohError)
                self._outlet.lose(str(error) if known else f"{type(error).__name__}: {error}")
            else:
                if not stop.is_set():
                    self._outlet.change(ENDED, "the last picture was shown, and loop is false")
                return
            finally:
                self._source.close()
            stop.wait(self._backoff_s)
            self._backoff_s = min(2 * self._backoff_s, MAX_BACKOFF_S)

    def _grab_all(self, stop: threading.Event) -> None:
        source, outlet = self._source, self._outlet
        opened = last_good = looked = time.monotonic()
        proved, broken = False, 0
        while (mono_ns := source.grab(stop)) is not None and not stop.is_set():
            now = time.monotonic()
            if proved:
                outlet.seen(mono_ns)
            # By the time now, not of capture: a backlog must not come out in a burst.
            if not outlet.in_time(time.monotonic_ns()):
                continue
            wanted = outlet.wanted or not proved
            if not wanted and now - looked < LOOK_S:
                last_good = now
                continue
            picture = source.retrieve()
            if picture is None:
                outlet.broken()
                broken += 1
                if broken >= BROKEN_IN_A_ROW and now - last_good > STALL_S:
                    raise NodeError(f"the last {broken} pictures could not be decoded")
                continue
            looked = now
            outlet.look(picture, mono_ns, source.stamp_ns)
            if wanted:
                outlet.put(picture, mono_ns)
            outlet.seen(mono_ns)
            last_good, proved, broken = now, True, 0
            outlet.change(OK)
            if now - opened > STALL_S:
                self._backoff_s = BACKOFF_S
