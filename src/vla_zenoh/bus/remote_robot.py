"""A robot as a Python program sees it: its states and images, and what drives it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import zenoh

from vla_zenoh.bus.buffers import LatestSample, ReceivedSample, bytes_of, header_of
from vla_zenoh.bus.client import Client
from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import records
from vla_zenoh.codec.image import MAX_IMAGE_BYTES, decode_jpeg, decode_raw
from vla_zenoh.codec.records import MAX_RECORD_BYTES
from vla_zenoh.errors import SessionError
from vla_zenoh.profile import Profile, as_robot, load_profile, override
from vla_zenoh.types import (
    ActionChunk,
    GripperState,
    Image,
    JointState,
    PoseState,
    Stamped,
)

Record = TypeVar("Record")
TIMEOUT_S = 2.0


class RemoteRobot(Client):
    """A robot on the bus: reads its streams and drives it. Made by `connect`.

    Each stream is subscribed to at the first call for it. Messages that cannot be decoded raise
    `CodecError`.
    """

    def __init__(self, profile: Profile, session: zenoh.Session) -> None:
        super().__init__(profile, session)
        self._buffers: dict[str, LatestSample] = {}
        self._newest: dict[str, Stamped[Any]] = {}

    def joint_state(self, timeout_s: float = TIMEOUT_S) -> Stamped[JointState]:
        """Newest joint state; waits for the first.

        Raises:
            SessionError: none arrived within `timeout_s`.
        """
        return self._record(JointState, self.keys.state_joint, timeout_s)

    def pose_state(self, timeout_s: float = TIMEOUT_S) -> Stamped[PoseState]:
        """Newest measured pose of the TCP in the base frame; waits for the first.

        Raises:
            SessionError: none arrived within `timeout_s`.
        """
        return self._record(PoseState, self.keys.state_pose, timeout_s)

    def gripper_state(self, timeout_s: float = TIMEOUT_S) -> Stamped[GripperState]:
        """Newest gripper state; waits for the first.

        Raises:
            SessionError: none arrived within `timeout_s`.
        """
        return self._record(GripperState, self.keys.state_gripper, timeout_s)

    def chunk(self, worker: str, timeout_s: float = TIMEOUT_S) -> Stamped[ActionChunk]:
        """Next action chunk of a worker, one that was not returned before.

        Raises:
            SessionError: none arrived within `timeout_s`.
        """
        key = self.keys.delta(worker)
        return self._decoded(ActionChunk, self._next(key, MAX_RECORD_BYTES, timeout_s))

    def image(
        self, camera: str, *, jpeg: bool = False, timeout_s: float = TIMEOUT_S
    ) -> Stamped[Image]:
        """Next image of a camera, one that was not returned before; older ones are skipped.

        Args:
            camera: its name in the profile.
            jpeg: take JPEG, a tenth of the bandwidth, in place of pixels.
            timeout_s: how long to wait for it.

        Raises:
            SessionError: none arrived within `timeout_s`.
        """
        key = self.keys.camera_jpeg(camera) if jpeg else self.keys.camera_raw(camera)
        sample = self._next(key, MAX_IMAGE_BYTES, timeout_s)
        payload = bytes_of(sample.sample.payload, MAX_IMAGE_BYTES)
        schema = str(sample.sample.encoding).partition(";")[2]
        image = decode_jpeg(payload) if jpeg else decode_raw(payload, schema)
        return Stamped(header_of(sample.sample), image, sample.mono_ns)

    def stop(self, timeout_s: float = TIMEOUT_S) -> None:
        """Emergency stop: the arm brakes and stays stopped until `reset`.

        Raises:
            SessionError: the command node did not confirm it within `timeout_s`.
        """
        self.publish(self.keys.stop, "stop")
        self._confirm("stop", self._stopped, timeout_s)

    def _stopped(self) -> bool:
        status = self.status("command")
        return status is not None and status.state == "stopped"

    def reset(self, timeout_s: float = TIMEOUT_S) -> None:
        """Clear an emergency stop or a fault. The arm stays inactive.

        Raises:
            SessionError: it was not cleared within `timeout_s`; says why.
        """
        super().reset()
        self._confirm("reset", self.cleared, timeout_s)

    def _confirm(self, what: str, done: Callable[[], bool], timeout_s: float) -> None:
        if not self.wait_for(done, timeout_s):
            why = f": {self.latch_reason()}" if self.latch_reason() else ""
            raise SessionError(f"{what}: the command node did not confirm it{why}")

    def _record(self, kind: type[Record], key: str, timeout_s: float) -> Stamped[Record]:
        buffer = self._buffer(key, MAX_RECORD_BYTES)
        sample = buffer.pop() if key in self._newest else self._next(key, 0, timeout_s)
        if sample is not None:
            self._newest[key] = self._decoded(kind, sample)
        return self._newest[key]

    @staticmethod
    def _decoded(kind: type[Record], sample: ReceivedSample) -> Stamped[Record]:
        record = records.decode(kind, bytes_of(sample.sample.payload, MAX_RECORD_BYTES))
        return Stamped(header_of(sample.sample), record, sample.mono_ns)

    def _next(self, key: str, limit: int, timeout_s: float) -> ReceivedSample:
        buffer = self._buffer(key, limit)
        if buffer.wait(timeout_s):
            sample = buffer.pop()
            if sample is not None:
                return sample
        raise SessionError(
            f"nothing was published on {key} for {timeout_s:g} s; `vla-zenoh keys` shows which "
            "keys have a publisher"
        )

    def _buffer(self, key: str, limit: int) -> LatestSample:
        if key not in self._buffers:
            self._buffers[key] = LatestSample(limit)
            self._subscriptions.append(self._subscribe(key, self._buffers[key]))
        return self._buffers[key]


@contextmanager
def connect(
    profile: str | Profile = "panda_sim",
    *,
    endpoints: Sequence[str] = (),
    robot: str | None = None,
    wait_s: float = 0.0,
) -> Iterator[RemoteRobot]:
    """A session with the router of a profile, and the robot there.

    Args:
        profile: name or path, or a loaded one.
        endpoints: routers, such as ``tcp/10.0.0.2:7447``, in place of the profile's.
        robot: name, in place of the profile's.
        wait_s: keep trying to reach the router for this long.

    Raises:
        ProfileError: the profile is wrong.
        SecurityError: there is no certificate for an operator on this host.
        SessionError: no router answers.
    """
    loaded = load_profile(profile) if isinstance(profile, str) else profile
    if endpoints:
        loaded = override(loaded, {"session": {"connect": list(endpoints)}})
    if robot is not None:
        loaded = as_robot(loaded, robot)
    with open_session(loaded.session, wait_s=wait_s) as session:
        found = RemoteRobot(loaded, session)
        found.subscribe()
        yield found
