"""A robot as a Python program sees it: its states and images, and what drives it."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, TypeVar

import zenoh

from vla_zenoh.bus.buffers import LatestSample, ReceivedSample, bytes_of, header_of
from vla_zenoh.bus.clock import Clock
from vla_zenoh.client.answer import DEFAULT_TIMEOUT_S, Answer
from vla_zenoh.client.client import ANSWER_S, START_PATIENCE_S, Client, open_patiently
from vla_zenoh.client.primitives import PrimitiveError, ask
from vla_zenoh.codec import records
from vla_zenoh.codec.image import MAX_IMAGE_BYTES, decode_jpeg, decode_raw
from vla_zenoh.codec.records import MAX_RECORD_BYTES
from vla_zenoh.errors import SessionError
from vla_zenoh.profile import Profile, as_robot, load_profile, override
from vla_zenoh.types import ActionChunk, GripperState, Image, JointState, PoseState, Stamped


def _list(numbers: Sequence[float] | None) -> list[float] | None:
    return None if numbers is None else [float(number) for number in numbers]


Record = TypeVar("Record")
TIMEOUT_S = 2.0


class RemoteRobot(Client):
    """A robot on the bus: reads its streams and drives it. Made by `connect`.

    Each stream is subscribed to at the first call for it. Where nothing arrives within `timeout_s`,
    `SessionError` is raised; messages that cannot be decoded raise `CodecError`.
    """

    def __init__(self, profile: Profile, session: zenoh.Session, **patience: Any) -> None:
        super().__init__(profile, session, **patience)
        self._buffers: dict[str, LatestSample] = {}
        self._newest: dict[str, Stamped[Any]] = {}
        self._wall = Clock()

    def joint_state(self, timeout_s: float = TIMEOUT_S) -> Stamped[JointState]:
        """Newest joint state; waits for one no older than ``timing.state_timeout_s``."""
        return self._record(JointState, self.keys.state_joint, timeout_s)

    def pose_state(self, timeout_s: float = TIMEOUT_S) -> Stamped[PoseState]:
        """Newest measured pose of the TCP in the base frame; waits as `joint_state`."""
        return self._record(PoseState, self.keys.state_pose, timeout_s)

    def gripper_state(self, timeout_s: float = TIMEOUT_S) -> Stamped[GripperState]:
        """Newest gripper state; waits as `joint_state`."""
        return self._record(GripperState, self.keys.state_gripper, timeout_s)

    def chunk(self, worker: str, timeout_s: float = TIMEOUT_S) -> Stamped[ActionChunk]:
        """Next action chunk of a worker, one that was not returned before."""
        key = self.keys.delta(worker)
        return self._decoded(ActionChunk, self._next(key, MAX_RECORD_BYTES, timeout_s))

    def image(
        self, camera: str, *, jpeg: bool = False, timeout_s: float = TIMEOUT_S
    ) -> Stamped[Image]:
        """Next image of a camera, one that was not returned before; older ones are skipped.

        `jpeg` takes a tenth of the bandwidth of pixels.
        """
        key = self.keys.camera_jpeg(camera) if jpeg else self.keys.camera_raw(camera)
        sample = self._next(key, MAX_IMAGE_BYTES, timeout_s)
        payload = bytes_of(sample.sample.payload, MAX_IMAGE_BYTES)
        schema = str(sample.sample.encoding).partition(";")[2]
        image = decode_jpeg(payload) if jpeg else decode_raw(payload, schema)
        return Stamped(header_of(sample.sample), image, self._wall.wall_at(sample.mono_ns))

    def picture(self, camera: str, *, timeout_s: float = TIMEOUT_S) -> bytes:
        """Next image of a camera as a JPEG file, otherwise as `image`."""
        sample = self._next(self.keys.camera_jpeg(camera), MAX_IMAGE_BYTES, timeout_s)
        return bytes_of(sample.sample.payload, MAX_IMAGE_BYTES)

    # -- guarded primitives -------------------------------------------------------------------
    def move_to(
        self,
        position_m: Sequence[float] | None = None,
        quat_xyzw: Sequence[float] | None = None,
        *,
        joints_rad: Sequence[float] | Mapping[str, float] | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> Answer:
        """Move the TCP straight to a pose, or the joints to positions, and wait until it is there.

        The arm moves only while this waits, at ``limits.approach_m_s`` at most, within all bounds
        of the profile; a target that it cannot go to is rejected before it moves.

        Args:
            position_m: (3,) of the TCP in the base frame; None: as it is.
            quat_xyzw: (4,) of the TCP; None: as it is.
            joints_rad: all joints in the order of the profile, or some by name; instead of a pose.
            timeout_s: then the arm is braked.

        Raises:
            PrimitiveError: it is not there; its `answer` says why, and where it stands.
            SessionError: the node primitives does not answer.
        """
        joints = dict(joints_rad) if isinstance(joints_rad, Mapping) else _list(joints_rad)
        target = {"position_m": _list(position_m), "quat_xyzw": _list(quat_xyzw)}
        return self._primitive("move_to", timeout_s, joints_rad=joints, **target)

    def home(self, timeout_s: float = DEFAULT_TIMEOUT_S) -> Answer:
        """Move the joints to ``robot.home_rad`` of the profile; otherwise as `move_to`."""
        return self._primitive("home", timeout_s)

    def grip(
        self,
        width_m: float | Literal["open", "closed"],
        timeout_s: float = DEFAULT_TIMEOUT_S,
        holds_m: tuple[float, float, float] | None = None,
    ) -> Answer:
        """Set the width of the gripper while the arm stands; otherwise as `move_to`.

        Args:
            width_m: between the fingers; ``closed``: until something is held.
            timeout_s: then it ends.
            holds_m: size of what it holds afterwards, along the axes of the TCP: kept from table,
                keep-outs and the arm until the gripper opens.
        """
        return self._primitive("grip", timeout_s, width_m=width_m, holds_m=holds_m)

    def run(
        self,
        worker: str,
        until: Mapping[str, Any] | None = None,
        *,
        prompt: str | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> Answer:
        """Let a worker move the arm until a condition holds or the time is over.

        Args:
            worker: the worker that moves it.
            until: conditions, `vla_zenoh_primitives.requests.Until`: ``{"gripper": "closed"}``.
            prompt: for the worker; None: the present one.
            timeout_s: then the arm is braked.

        Returns:
            with the condition as its reason, or ``timeout``.

        Raises:
            PrimitiveError: it ended for any other reason.
            SessionError: the node primitives does not answer.
        """
        return self._primitive("run", timeout_s, worker=worker, prompt=prompt, until=until)

    def _primitive(self, name: str, timeout_s: float, **fields: Any) -> Answer:
        answer = ask(self, name, {**fields, "timeout_s": timeout_s}, who="script")
        if answer.ok or (name == "run" and answer.reason == "timeout"):
            return answer
        raise PrimitiveError(name, answer)

    def stop(self, timeout_s: float = TIMEOUT_S) -> None:
        """Emergency stop: the arm brakes and stays stopped until `reset`.

        Raises:
            SessionError: it was not confirmed within `timeout_s`; begins with HEARD or NOT
                CONFIRMED, as `stop_progress` says.
        """
        super().stop()
        if not self.wait_for(self.stopped, timeout_s):
            raise SessionError(self.stop_progress().sentence(f"robot {self.profile.robot.name}"))

    def reset(self, timeout_s: float = TIMEOUT_S) -> None:
        """Clear an emergency stop or a fault. The arm stays inactive.

        Raises:
            SessionError: it was not cleared within `timeout_s`; gives the reason.
        """
        super().reset()
        began_s = time.monotonic()
        if not self.wait_for(self.cleared, timeout_s):
            heard = self.status_since("command", began_s) is not None
            why = self.latch_reason() if heard else "it is silent, or the router is lost"
            raise SessionError(
                f"reset: the command node of robot {self.profile.robot.name!r} did not confirm it"
                f"{why and f': {why}'}"
            )

    def _record(self, kind: type[Record], key: str, timeout_s: float) -> Stamped[Record]:
        self._wall.adopt_system_time()
        oldest_ns = self._wall.wall_ns() - int(self.profile.timing.state_timeout_s * 1e9)
        sample = self._buffer(key, MAX_RECORD_BYTES).pop()
        if sample is not None:
            self._newest[key] = self._decoded(kind, sample)
        newest = self._newest.get(key)
        if newest is None or newest.received_ns < oldest_ns:
            newest = self._newest[key] = self._decoded(kind, self._next(key, 0, timeout_s))
        return newest

    def _decoded(self, kind: type[Record], sample: ReceivedSample) -> Stamped[Record]:
        record = records.decode(kind, bytes_of(sample.sample.payload, MAX_RECORD_BYTES))
        return Stamped(header_of(sample.sample), record, self._wall.wall_at(sample.mono_ns))

    def _next(self, key: str, limit: int, timeout_s: float) -> ReceivedSample:
        buffer = self._buffer(key, limit)
        if buffer.wait(timeout_s):
            sample = buffer.pop()
            if sample is not None:
                return sample
        if why := self.reception.short().get(self.keys.short(key)):
            raise SessionError(f"nothing came within {timeout_s:g} s; {why}")
        status = self.status(self.profile.robot.node)
        if why := status and status.detail.get("complaint"):
            raise SessionError(f"nothing was published on {key} for {timeout_s:g} s: {why}")
        raise SessionError(
            f"nothing was published on {key} for {timeout_s:g} s; `vla-zenoh keys` shows which "
            "keys have a publisher"
        )

    def _buffer(self, key: str, limit: int) -> LatestSample:
        if key not in self._buffers:
            self._buffers[key] = LatestSample(limit)
            self.watch(key, self._buffers[key])
        return self._buffers[key]


@contextmanager
def connect(
    profile: str | Profile = "panda_sim",
    *,
    endpoints: Sequence[str] = (),
    robot: str | None = None,
    wait_s: float = START_PATIENCE_S,
) -> Iterator[RemoteRobot]:
    """A session with the router of a profile, and the robot there.

    Args:
        profile: name or path, or a loaded one.
        endpoints: routers, such as ``tcp/10.0.0.2:7447``, instead of the profile's.
        robot: name, instead of the profile's.
        wait_s: how long to wait for the router, and settings and activations for nodes that are
            starting; what is waited for is logged as a warning of the logger ``vla_zenoh``.

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
    tell = logging.getLogger("vla_zenoh").warning
    session, cold = open_patiently(loaded.session, wait_s, tell)
    with session:
        patience_s = max(wait_s, ANSWER_S)
        found = RemoteRobot(loaded, session, patience_s=patience_s, tell=tell, cold=cold)
        found.subscribe()
        yield found
