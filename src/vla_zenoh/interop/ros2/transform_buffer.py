"""Where one frame is in another, of the transforms on /tf and /tf_static."""

from __future__ import annotations

from collections.abc import Iterable

from vla_zenoh.errors import CodecError, RecordError
from vla_zenoh.interop.joint_reading import RESTARTED_NS
from vla_zenoh.interop.ros2.samples import Transform
from vla_zenoh.kinematics.so3 import Pose, norm3, rotation_from_quat
from vla_zenoh.types import unit_quaternion, vector

MAX_FRAMES = 1000
MAX_CHAIN = 64
FURTHEST_M = 1e9
"""Frames of the whole Earth are nearer to each other; a chain of such stays finite."""


class TransformBuffer:
    """The newest transform to every child frame."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, int, Pose, bool]] = {}

    def take(self, transforms: Iterable[Transform], *, static: bool) -> None:
        """Keep these transforms; one that was overtaken by what is known is passed over.

        Raises:
            CodecError: ``invalid`` (not finite, out of this world, no unit quaternion) or
                ``flood``.
        """
        for entry in transforms:
            known = self._parents.get(entry.child)
            if known is not None and not static and _overtaken(entry.stamp_ns, known[1]):
                continue
            if known is None and len(self._parents) >= MAX_FRAMES:
                raise CodecError("flood", f"more than {MAX_FRAMES} frames; {entry.child[:60]!r}")
            try:
                pose = Pose(
                    vector("translation", entry.position_m, 3),
                    rotation_from_quat(unit_quaternion("rotation", entry.quat_xyzw)),
                )
            except RecordError as error:
                raise CodecError("invalid", f"frame {entry.child[:60]!r}: {error}") from error
            if norm3(pose.position_m) > FURTHEST_M:
                raise CodecError(
                    "invalid",
                    f"frame {entry.child[:60]!r} is more than {FURTHEST_M:g} m from its parent",
                )
            self._parents[entry.child] = (entry.parent, entry.stamp_ns, pose, static)

    def find(self, base: str, tip: str) -> tuple[Pose, int, int] | None:
        """Pose of `tip` in `base`, and the oldest and newest stamp it stands on; None: not known.

        The way is up from `tip`; static transforms have no age.
        """
        stamps_ns: list[int] = []
        frame, position, rotation = tip, None, None
        for _ in range(MAX_CHAIN):
            if frame == base:
                break
            found = self._parents.get(frame)
            if found is None:
                return None
            frame, at_ns, pose, static = found
            if position is None or rotation is None:
                position, rotation = pose.position_m, pose.rotation
            else:
                position = pose.position_m + pose.rotation @ position
                rotation = pose.rotation @ rotation
            if not static:
                stamps_ns.append(at_ns)
        if frame != base or position is None or rotation is None or not stamps_ns:
            return None
        return Pose(position, rotation), min(stamps_ns), max(stamps_ns)


def _overtaken(stamp_ns: int, known_ns: int) -> bool:
    """It is older, and not by so much that the robot's clock was set."""
    return known_ns - RESTARTED_NS < stamp_ns < known_ns
