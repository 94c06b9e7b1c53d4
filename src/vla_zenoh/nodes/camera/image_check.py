"""Detects from its own images that a camera is frozen, black, overexposed, covered or swapped.

An image is sampled at about 96 x 128 points, at most ten times a second, which costs about 0.1 ms
whatever its size. What an image cannot prove is not judged: blur, a loop of several images, a
camera that was moved.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import NodeError
from vla_zenoh.opencv import cv2
from vla_zenoh.profile.schema import CameraCheck, CameraProfile

ROWS, COLUMNS = 96, 128
BLOCK = 8
"""Samples along a block's side: the mean of 64 cuts a dark sensor's noise to an eighth."""
PERIOD_NS = 90_000_000
REPEATS = 2
"""Identical images in a row before a camera counts as frozen; a slow camera may repeat one."""
CLOCK_SET_NS = 1_000_000_000
"""A time stamp that goes back further means that the driver's clock was set, not that it froze."""
BLACK_LEVEL, WHITE_LEVEL = 8, 247
THUMB = 4
"""Samples along a side of a point of the thumbnail that is compared with references."""
LEAST_LIKE, LEAST_MORE = 0.5, 0.2
"""Correlation with another camera's reference, and how much more than with its own."""
FEW = 0.02
"""Share of the blocks that is ignored at either end of the contrast."""


class ImageFault(NamedTuple):
    """Why a camera cannot be trusted.

    Args:
        check: the field of `vla_zenoh.profile.schema.CameraCheck` that is violated; `value` and
            `limit` are in its unit.
        what: ``same``, ``stamps``, ``black``, ``white``, ``flat`` or ``swapped``.
        why: continues a sentence that begins with ``camera NAME``.
    """

    check: str
    what: str
    why: str
    value: float
    limit: float


class ImageCheck:
    """Checks the images of one camera, from the opening of its source to its end.

    `same_s` is the default of `CameraCheck.same_s` for this kind of source, see `Source`;
    `references` are of the cameras that have one, see `read_references`.
    """

    def __init__(
        self,
        name: str,
        limits: CameraCheck,
        same_s: float,
        references: Mapping[str, NDArray[np.float64]] | None = None,
    ) -> None:
        self._name, self._limits, self._references = name, limits, references or {}
        self._same_s = same_s if limits.same_s is None else limits.same_s
        self.finding: ImageFault | None = None
        self._looked_ns: int | None = None
        self._sample: NDArray[Any] | None = None
        self._same = self._stamps = _Run(0, 0)
        self._stamp_ns: int | None = None
        self._content: tuple[str, int] = ("", 0)
        self._other: ImageFault | None = None

    def update(
        self, image: NDArray[Any], now_ns: int, stamp_ns: int | None = None
    ) -> ImageFault | None:
        """The first fault of an image, None if the camera looks right.

        Args:
            image: (H, W) or (H, W, 1, 3 or 4), uint8 or uint16, channels in any order.
            now_ns: monotonic clock.
            stamp_ns: the driver's time stamp, on any clock.
        """
        if self._looked_ns is not None and 0 <= now_ns - self._looked_ns < PERIOD_NS:
            return self.finding
        self._looked_ns = now_ns
        sample = _sampled(image)
        found = self._frozen_stamps(stamp_ns, now_ns)
        found = self._same_image(sample, now_ns) or found
        content = _content(sample, self._limits) or self._swapped(sample)
        self.finding = self._lasting(content, now_ns) or found
        if self.finding is not None:
            why = f"{self.finding.why} (cameras.{self._name}.check.{self.finding.check})"
            self.finding = self.finding._replace(why=why)
        return self.finding

    def _same_image(self, sample: NDArray[Any], now_ns: int) -> ImageFault | None:
        again = self._sample is not None and np.array_equal(self._sample, sample)
        self._sample = sample
        self._same = self._same.then(again, now_ns)
        return self._same.finding("same_s", "same", "shows the same image", now_ns, self._same_s)

    def _frozen_stamps(self, stamp_ns: int | None, now_ns: int) -> ImageFault | None:
        newest, again = self._stamp_ns, False
        if stamp_ns is not None and newest is not None:
            again = newest - CLOCK_SET_NS <= stamp_ns <= newest
        if not again:
            self._stamp_ns = stamp_ns
        self._stamps = self._stamps.then(again, now_ns)
        why = "delivers images whose driver time stamp does not advance"
        return self._stamps.finding("stamp_s", "stamps", why, now_ns, self._limits.stamp_s)

    def _lasting(self, found: ImageFault | None, now_ns: int) -> ImageFault | None:
        """`found` once it has lasted for `after_s`: a passing hand does not cover the lens."""
        what, since_ns = self._content
        if found is None or found.what != what:
            since_ns = now_ns
        self._content = ("" if found is None else found.what, since_ns)
        return found if now_ns - since_ns >= self._limits.after_s * 1e9 else None

    def _swapped(self, sample: NDArray[Any]) -> ImageFault | None:
        """Its image was like the reference of another camera, and never like its own since."""
        if self._name not in self._references:
            return None
        seen = _thumbnail(sample)
        like = {name: float(np.sum(seen * own)) for name, own in self._references.items()}
        own = like.pop(self._name)
        other = max(like, key=lambda name: like[name], default="")
        limit = max(own + LEAST_MORE, LEAST_LIKE)
        if other and like[other] >= limit:
            why = (
                f"shows what camera {other!r} should show: its image correlates with that "
                f"reference to {like[other]:.2f}, with its own to {own:.2f} "
                "(are the two cameras swapped?)"
            )
            self._other = ImageFault("reference", "swapped", why, like[other], limit)
        elif own >= LEAST_LIKE:
            self._other = None
        return self._other


class _Run(NamedTuple):
    """Successive checks in which nothing changed: their number, and the time of the first."""

    times: int
    since_ns: int

    def then(self, again: bool, now_ns: int) -> _Run:
        return _Run(self.times + 1, self.since_ns) if again else _Run(0, now_ns)

    def finding(
        self, check: str, what: str, why: str, now_ns: int, limit_s: float
    ) -> ImageFault | None:
        lasted_s = (now_ns - self.since_ns) / 1e9
        if limit_s == 0 or self.times < REPEATS or lasted_s < limit_s:
            return None
        why = f"{why} for {lasted_s:.1f} s, less than {limit_s:g} s is allowed"
        return ImageFault(check, what, why, lasted_s, limit_s)


def _sampled(image: NDArray[Any]) -> NDArray[Any]:
    """(1 or 3, h, w) of about `ROWS` x `COLUMNS`, a copy by channel, which is faster to read."""
    if image.ndim == 2:
        image = image[:, :, None]
    down, across = max(1, image.shape[0] // ROWS), max(1, image.shape[1] // COLUMNS)
    return np.ascontiguousarray(np.moveaxis(image[::down, ::across, :3], 2, 0))


def _thumbnail(sample: NDArray[Any]) -> NDArray[np.float64]:
    """(h, w) grey levels whose mean is 0 and whose sum of squares is 1, whatever the light."""
    small = cv2.resize(
        sample.mean(axis=0), (COLUMNS // THUMB, ROWS // THUMB), interpolation=cv2.INTER_AREA
    )
    small -= small.mean()
    return small / max(float(np.linalg.norm(small)), 1e-9)


def read_references(cameras: Mapping[str, CameraProfile]) -> dict[str, NDArray[np.float64]]:
    """Thumbnails of the references of those cameras that have one; `NodeError`: not an image."""
    found: dict[str, NDArray[np.float64]] = {}
    for name, camera in cameras.items():
        path = camera.check.reference
        if path is None:
            continue
        image = cv2.imread(path)
        if image is None:
            raise NodeError(
                f"cameras.{name}.check.reference: {path} is not an image that can be read; "
                "`vla-zenoh camera list --output FOLDER` writes one of each camera"
            )
        found[name] = _thumbnail(_sampled(image))
    return found


def _content(sample: NDArray[Any], limits: CameraCheck) -> ImageFault | None:
    if sample.dtype == np.uint16:
        sample = (sample >> 8).astype(np.uint8)
    share, most = float(np.mean(sample.max(axis=0) <= BLACK_LEVEL)), limits.clipped_share
    if share > most:
        why = f"is black: {share:.1%} of the image, at most {most:.1%}"
        return ImageFault("clipped_share", "black", why, share, most)
    share = float(np.mean(sample.min(axis=0) >= WHITE_LEVEL))
    if share > most:
        why = f"is overexposed: {share:.1%} of the image is white, at most {most:.1%}"
        return ImageFault("clipped_share", "white", why, share, most)
    levels = np.sort(_blocks(sample), axis=None)
    cut = round(FEW * len(levels))
    contrast, least = float(levels[-1 - cut] - levels[cut]), limits.contrast_levels
    if contrast < least:
        why = (
            f"shows no contrast: {contrast:.1f} of 255 levels, at least {least:g} "
            "(is the lens covered?)"
        )
        return ImageFault("contrast_levels", "flat", why, contrast, least)
    return None


def _blocks(sample: NDArray[Any]) -> NDArray[np.float64]:
    """Mean level of each block, over all channels."""
    grey = sample.sum(axis=0, dtype=np.uint32)
    down, across = (max(1, min(BLOCK, length)) for length in grey.shape)
    rows, columns = grey.shape[0] // down, grey.shape[1] // across
    whole = grey[: rows * down, : columns * across].reshape(rows, down, columns, across)
    return whole.sum(axis=1).sum(axis=2) / (down * across * len(sample))
