"""Chooses views from a stream of images and one of the arm's states, live or recorded.

An image is paired with the states around its stamp, and only while the arm stands: `STILL_S` before
it and after it the arm has not moved. So neither the delay of a camera nor clocks of two hosts that
differ by less than that shift a view. A view is also new, sharp, and not partial. Nothing here has
a clock: an image waits until the states after it have come.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.kinematics.so3 import Pose, angle_between, mean_pose
from vla_zenoh.types import FloatArray
from vla_zenoh_calibrate.board import Board, Corners, Grey, Refused
from vla_zenoh_calibrate.errors import CalibrationError
from vla_zenoh_calibrate.view import MIN_TURN_RAD, View, placed, turns, uncovered

STILL_S = 0.4
"""How long the arm stands before an image and after it."""
STILL_M, STILL_RAD = 0.0005, 0.001
"""A standing arm stays within this, its noise included."""
MAX_GAP_S = 0.15
"""Between states."""
MAX_APART_S = 0.3
"""What the delays of images and states may differ by, as clocks that differ look like it."""
NEW_M, NEW_RAD = 0.015, 0.06
"""From every earlier view, in one of both."""
STEADY_PX, NEW_SHARE = 0.7, 0.06
"""Without an arm: a board that stands, and how far its corners must be from earlier views, of the
image's width."""
RETRY_S = 0.5
"""After an image that was refused where the arm stands."""
MAX_STATES, MAX_WAITING = 5000, 4
ENOUGH_STATES = 40
"""Around an image, of a robot that publishes at 1 kHz."""
SEEN_FOR_CLOCKS = 5


class Taken(NamedTuple):
    """A view that was taken, beside its image (H, W, 3) RGB."""

    view: View
    image: NDArray[np.uint8]


class _State(NamedTuple):
    stamp_ns: int
    pose: FloatArray


class _Picture(NamedTuple):
    stamp_ns: int
    image: NDArray[np.uint8]


class Sampler:
    """Takes states and images, and returns the views that are good.

    Args:
        board: that is shown.
        with_arm: each view needs a pose of the arm; else the board itself must stand.

    Attributes:
        taken: views, oldest first.
        refusals: how many images each reason refused.
    """

    def __init__(self, board: Board, *, with_arm: bool) -> None:
        self.board, self._with_arm = board, with_arm
        self.taken: list[Taken] = []
        self.refusals: Counter[str] = Counter()
        self.size: tuple[int, int] | None = None
        self.last_refused: Grey | None = None
        """The newest image without a board."""
        self._states: deque[_State] = deque(maxlen=MAX_STATES)
        self._waiting: deque[_Picture] = deque(maxlen=MAX_WAITING)
        self._delays: dict[str, deque[float]] = {
            name: deque(maxlen=25) for name in ("images", "states")
        }
        self._refused_at: FloatArray | None = None
        self._refused_ns = 0
        self._before: Corners | None = None

    @property
    def views(self) -> list[View]:
        return [one.view for one in self.taken]

    def newest_pose(self) -> FloatArray:
        """The newest measured pose (4, 4) of the arm; `CalibrationError`: none came."""
        if not self._states:
            raise CalibrationError("no state of the arm came; `vla-zenoh status` shows its node")
        return self._states[-1].pose

    def add_state(self, stamp_ns: int, pose: FloatArray, received_ns: int) -> None:
        """A measured pose (4, 4) of the arm's last link in its base.

        Args:
            stamp_ns: of the state's header.
            received_ns: on one clock for states and images.
        """
        if self._states and stamp_ns <= self._states[-1].stamp_ns:
            return
        self._states.append(_State(stamp_ns, pose))
        self._delays["states"].append((received_ns - stamp_ns) / 1e9)

    def add_image(self, stamp_ns: int, image: NDArray[np.uint8], received_ns: int) -> None:
        """An image (H, W, 3) RGB; `settle` decides about it.

        Raises:
            CalibrationError: it has another size than those before it.
        """
        size = image.shape[1], image.shape[0]
        if self.size is not None and size != self.size:
            raise CalibrationError(
                f"an image of {size[0]}x{size[1]} after those of {self.size[0]}x{self.size[1]}: a "
                "calibration is of one size of picture"
            )
        self.size = size
        self._delays["images"].append((received_ns - stamp_ns) / 1e9)
        self._waiting.append(_Picture(stamp_ns, image))

    def settle(self, *, at_end: bool = False) -> list[Taken | Refused]:
        """Decide about the images whose later states are there.

        Args:
            at_end: no more states will come.

        Raises:
            CalibrationError: clocks of images and states differ.
        """
        if self._with_arm:
            self._check_clocks()
        out: list[Taken | Refused] = []
        while self._waiting:
            picture = self._waiting[0]
            newest_ns = self._states[-1].stamp_ns if self._states else 0
            if self._with_arm and not at_end and newest_ns < picture.stamp_ns + STILL_S * 1e9:
                break
            self._waiting.popleft()
            found = self._decide(picture)
            if isinstance(found, Refused):
                self.refusals[found.reason] += 1
            else:
                self.taken.append(found)
            out.append(found)
        return out

    def missing(self, wanted: int) -> list[str]:
        """What a good calibration still lacks, in words; empty: it can be made.

        Args:
            wanted: number of views.
        """
        out: list[str] = []
        if len(self.taken) < wanted:
            out.append(f"{wanted - len(self.taken)} more views")
        if self.size is not None and (parts := uncovered(self.views, self.size)):
            out.append(f"the board at the {', '.join(parts)} of the image")
        poses = [view.arm for view in self.views if view.arm is not None]
        if self._with_arm:
            out += _missing_turns(poses)
        return out

    def require_some(self) -> None:
        """Raise a `CalibrationError` that says why no view was taken, if none was."""
        if self.taken:
            return
        if not self.refusals:
            raise CalibrationError("no image came, or none with states of the arm around it")
        reason = self.refusals.most_common(1)[0][0]
        counts = ", ".join(f"{name} {count}" for name, count in self.refusals.most_common())
        why = _HINTS.get(reason, "")
        if reason in ("no_board", "partial", "other_board") and self.last_refused is not None:
            why = self.board.why_not(self.last_refused)
        raise CalibrationError(f"no view was taken; images refused: {counts}. {why}".rstrip())

    # -- one image ----------------------------------------------------------------------------
    def _decide(self, picture: _Picture) -> Taken | Refused:
        pose = self._standing(picture.stamp_ns) if self._with_arm else None
        if isinstance(pose, Refused):
            return pose
        if pose is not None:
            if any(_is_near(pose, view.arm) for view in self.views if view.arm is not None):
                return Refused("repeated", "the arm was here in an earlier view: move it")
            waited_s = (picture.stamp_ns - self._refused_ns) / 1e9
            again = self._refused_at is not None and _is_near(pose, self._refused_at)
            if again and 0 <= waited_s < RETRY_S:
                return Refused("waiting", "an image from here was just refused")
        grey = np.asarray(cv2.cvtColor(picture.image, cv2.COLOR_RGB2GRAY), np.uint8)
        found = self.board.find(grey)
        if isinstance(found, Refused):
            self._refused_at, self._refused_ns = pose, picture.stamp_ns
            self.last_refused = grey
            self._before = None
            return found
        if pose is None and (refused := self._unsteady(found)):
            return refused
        return Taken(View(found, pose, picture.stamp_ns), picture.image)

    def _standing(self, stamp_ns: int) -> FloatArray | Refused:
        """The arm's mean pose around an image, if it stands."""
        span_ns = int(STILL_S * 1e9)
        around = [one for one in self._states if abs(one.stamp_ns - stamp_ns) <= span_ns]
        stamps = np.array(
            [stamp_ns - span_ns, *(one.stamp_ns for one in around), stamp_ns + span_ns], np.int64
        )
        gap_s = float(np.diff(stamps).max()) / 1e9
        if not around or gap_s > MAX_GAP_S:
            return Refused("stale", f"no state of the arm for {gap_s:.2f} s around the image")
        some = around[:: max(1, len(around) // ENOUGH_STATES)]
        poses = [Pose(one.pose[:3, 3], one.pose[:3, :3]) for one in some]
        mean = mean_pose(poses, np.full(len(poses), 1.0 / len(poses)))
        for pose in poses:
            if (
                np.linalg.norm(pose.position_m - mean.position_m) > STILL_M
                or angle_between(pose.rotation, mean.rotation) > STILL_RAD
            ):
                return Refused("moving", f"the arm moved within {STILL_S:g} s of the image")
        return placed(mean.rotation, mean.position_m)

    def _unsteady(self, found: Corners) -> Refused | None:
        """Why a board without an arm is not taken: it moves, or was there before."""
        assert self.size is not None
        before, self._before = self._before, found
        if before is None or _apart_px(before, found) > STEADY_PX:
            return Refused("moving", "the board moves: hold it still for two images")
        near = NEW_SHARE * self.size[0]
        if any(_apart_px(view.corners, found) < near for view in self.views):
            return Refused("repeated", "the board was here in an earlier view: move it")
        return None

    def _check_clocks(self) -> None:
        images, states = self._delays["images"], self._delays["states"]
        if min(len(images), len(states)) < SEEN_FOR_CLOCKS:
            return
        apart_s = float(np.median(images) - np.median(states))
        if abs(apart_s) > MAX_APART_S:
            older = "images" if apart_s > 0 else "states"
            raise CalibrationError(
                f"{older} are stamped {abs(apart_s):.2f} s before the others that arrive with "
                f"them, at most {MAX_APART_S:g} s are taken for the delay of a camera: do the "
                "clocks of the two hosts differ? `vla-zenoh status` shows their offsets"
            )


_HINTS = {
    "moving": "Let the arm stand for a second at each pose.",
    "stale": "States of the arm do not come, or not with the images' times.",
    "blurred": "Focus the lens, give it more light, or let it stand.",
}


def _missing_turns(poses: Sequence[FloatArray]) -> list[str]:
    if len(poses) < 2:
        return ["turns of the arm about two axes"]
    rms = turns(poses).rms_rad
    lacking = int((rms[:2] < MIN_TURN_RAD).sum())
    words = ("", "turns of the arm about a second axis", "turns of the arm about two axes")
    return [words[lacking]] if lacking else []


def _is_near(a: FloatArray, b: FloatArray) -> bool:
    return bool(
        np.linalg.norm(a[:3, 3] - b[:3, 3]) < NEW_M
        and angle_between(a[:3, :3], b[:3, :3]) < NEW_RAD
    )


def _apart_px(a: Corners, b: Corners) -> float:
    """Mean distance of the corners that both have; infinite: they share few."""
    both, left, right = np.intersect1d(a.ids, b.ids, return_indices=True)
    if len(both) < 4:
        return np.inf
    return float(np.linalg.norm(a.pixels[left] - b.pixels[right], axis=1).mean())
