"""Notices images that repeat while the arm moves, whoever publishes them and with what stamps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vla_zenoh.policy.inference import Observation
from vla_zenoh.policy.meaning import wrapped
from vla_zenoh.types import FloatArray, JointBound

MOVED_M, MOVED_RAD = 0.02, 0.1
MOVED_JOINT = JointBound(MOVED_RAD, MOVED_M)
"""An arm that moved by less since an image appeared may look the same in it."""


@dataclass(slots=True)
class _Shown:
    """An image that repeats: since when, and where the arm was then (of each part)."""

    pixels: Any
    since_ns: int
    arms: tuple[Observation, ...]


class FrozenImages:
    """Judges the images of successive observations of one robot.

    Without pose and joints in the observation it judges only what is `declared`, by time alone.

    Args:
        same_s: camera -> how long its image, or depth image, may stay the same while the arm moves,
            s; 0: indefinitely.
        declared: cameras whose profile says so itself.
    """

    def __init__(self, same_s: Mapping[str, float], declared: frozenset[str]) -> None:
        self._same_s, self._declared = same_s, declared
        self._shown: dict[tuple[str, str], _Shown] = {}

    @staticmethod
    def of(cameras: Mapping[str, Any]) -> FrozenImages:
        """For the `CameraProfile` of each camera of a profile."""
        declared = [name for name, one in cameras.items() if one.check.same_s is not None]
        limits_s = {name: one.same_moving_s for name, one in cameras.items()}
        return FrozenImages(limits_s, frozenset(declared))

    def judge(self, seen: Observation) -> str:
        """Why an observation must not be used; empty if it may."""
        whys: list[str] = []
        for kind, images in (("image", seen.images), ("depth image", seen.depth)):
            for camera, pixels in images.items():
                limit_s = self._same_s.get(camera, 0.0)
                if limit_s and (why := self._repeats(kind, camera, pixels, seen, limit_s)):
                    whys.append(why)
        return "; ".join(whys)

    def _repeats(
        self, kind: str, camera: str, pixels: Any, seen: Observation, limit_s: float
    ) -> str:
        arms = tuple(seen.parts.values()) or (seen,)
        before = self._shown.get((kind, camera))
        if before is None or not _same(before.pixels, pixels):
            self._shown[kind, camera] = _Shown(pixels, seen.stamp_wall_ns, arms)
            return ""
        lasted_s = (seen.stamp_wall_ns - before.since_ns) / 1e9
        moved = [_moved(then, now) for then, now in zip(before.arms, arms, strict=True)]
        known = [one for one in moved if one is not None]
        judged = any(known) if known else camera in self._declared
        if lasted_s < limit_s or not judged:
            return ""
        return (
            f"camera {camera!r} repeats one {kind} for {lasted_s:.1f} s while the arm moves, less "
            f"than {limit_s:g} s is allowed (cameras.{camera}.check.same_s; 0 where it does not "
            "see the arm)"
        )


def _same(before: Any, now: Any) -> bool:
    """Whether images agree; of most that do not, one row in sixteen says so."""
    return np.array_equal(before[::16], now[::16]) and np.array_equal(before, now)


def _moved(then: Observation, now: Observation) -> bool | None:
    """Whether an arm has moved; None: the observations do not say."""
    if then.pose is not None and now.pose is not None:
        turned = abs(float(np.dot(then.pose.quat_xyzw, now.pose.quat_xyzw)))
        angle_rad = 2 * np.arccos(min(turned, 1.0))
        way_m = float(np.linalg.norm(now.pose.position_m - then.pose.position_m))
        return way_m > MOVED_M or angle_rad > MOVED_RAD
    if then.joint is not None and now.joint is not None:
        ways_rad: FloatArray = now.joint.position_rad - then.joint.position_rad
        if now.joint.endless:
            ways_rad = wrapped(ways_rad)
        return bool((np.abs(ways_rad) > MOVED_JOINT.of(now.joint.slides)).any())
    return None
