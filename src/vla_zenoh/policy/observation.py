"""One coherent look at the world out of many streams: newest, near in time, in the form asked."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import SpecError
from vla_zenoh.policy import ActionSteps, CameraSpec, ModelSpec, Observation
from vla_zenoh.types import ActionChunk, Image, Stamped, Task

CLOCK_TOLERANCE_S = 0.05
"""An image may lie this far in the future before its clock counts as wrong."""


@dataclass(slots=True)
class History:
    """The last states of one kind, oldest first, to find the one nearest to an image."""

    size: int = 128
    entries: list[Stamped[Any]] = field(default_factory=list)

    def add(self, entry: Stamped[Any]) -> None:
        """Add a state; one older than the newest clears the history, as its writer restarted."""
        if self.entries and entry.header.stamp_wall_ns < self.entries[-1].header.stamp_wall_ns:
            self.entries.clear()
        self.entries.append(entry)
        if len(self.entries) > 2 * self.size:
            del self.entries[: -self.size]

    def nearest(self, stamp_ns: int) -> Stamped[Any] | None:
        """The entry whose stamp is nearest."""
        if not self.entries:
            return None
        right = bisect_left(self.entries, stamp_ns, key=_stamp_ns)
        around = self.entries[max(right - 1, 0) : right + 1]
        return min(around, key=lambda entry: abs(entry.header.stamp_wall_ns - stamp_ns))


def _stamp_ns(entry: Stamped[Any]) -> int:
    return entry.header.stamp_wall_ns


@dataclass(frozen=True, slots=True)
class NotReady:
    """Why there is no observation now; `waiting`: it is early, and nothing is wrong."""

    why: str
    waiting: bool = False


def assemble(
    spec: ModelSpec,
    task: Task,
    images: Mapping[str, Stamped[Image]],
    states: Mapping[str, History],
    *,
    not_before_ns: int,
    now_ns: int,
    robot: str = "",
) -> Observation | NotReady:
    """The newest observation that fits the spec, or why there is none.

    Args:
        spec: what the model needs.
        task: prompt and episode.
        images: newest image of each camera.
        states: what (``joint``, ``pose``, ``gripper``; see `state_names`) -> its history.
        not_before_ns: an observation from before this time is not wanted: it cannot show what the
            last chunk did.
        now_ns: wall clock.
        robot: whose observation it is.

    Raises:
        SpecError: an image does not have the size of the spec, see `prepare_image`.
    """
    wanted = spec.observation
    if wanted.prompt and not task.prompt:
        return NotReady("there is no prompt", waiting=True)
    missing = [f"camera {c.camera!r}" for c in wanted.cameras if c.camera not in images]
    named = state_names(spec)
    missing += [f"state/{n}" for n in named if n not in states or not states[n].entries]
    if missing:
        return NotReady(f"nothing received yet of {', '.join(missing)}")
    oldest = _oldest([images[camera.camera] for camera in wanted.cameras])
    if oldest is None and wanted.state:
        oldest = _oldest([states[name].entries[-1] for name in named])
    stamp_ns = oldest.header.stamp_wall_ns if oldest else now_ns
    seq = oldest.header.seq if oldest else 0
    age_s = (now_ns - stamp_ns) / 1e9
    if age_s > wanted.max_age_s:
        return NotReady(
            f"the newest observation is {age_s:.2f} s old, at most {wanted.max_age_s:g} s"
        )
    if age_s < -CLOCK_TOLERANCE_S:
        return NotReady(
            f"the newest observation is {-age_s:.2f} s in the future; synchronise the clocks "
            "of camera, robot and worker (chrony or ptp)"
        )
    if stamp_ns < not_before_ns:
        return NotReady("no observation since the last chunk", waiting=True)
    found: dict[str, dict[str, Any]] = {part: {} for part in spec.parts}
    for name, (part, what) in named.items():
        near = states[name].nearest(stamp_ns)
        assert near is not None
        skew_s = abs(near.header.stamp_wall_ns - stamp_ns) / 1e9
        if skew_s > wanted.max_skew_s:
            return NotReady(f"state/{name} is {skew_s:.3f} s apart from the images")
        found[part][what] = near.record
    for camera in wanted.cameras:
        skew_s = (images[camera.camera].header.stamp_wall_ns - stamp_ns) / 1e9
        if skew_s > wanted.max_skew_s:
            return NotReady(f"camera {camera.camera!r} is {skew_s:.3f} s apart from the others")
    whole = Observation(
        stamp_wall_ns=stamp_ns,
        seq=seq,
        task=task,
        robot=robot,
        images={c.camera: prepare_image(images[c.camera].record, c) for c in wanted.cameras},
        **found.pop("", {}),
    )
    if not found:
        return whole
    return replace(whole, parts={part: replace(whole, **own) for part, own in found.items()})


def state_names(spec: ModelSpec) -> dict[str, tuple[str, str]]:
    """Every state that a model observes: name (``pose``, ``left/pose``) -> part and what."""
    return {
        f"{part}/{what}" if part else what: (part, what)
        for part in spec.parts
        for what in spec.observation.state
    }


def _oldest(entries: Sequence[Stamped[Any]]) -> Stamped[Any] | None:
    return min(entries, key=_stamp_ns, default=None)


def size_variant(spec: CameraSpec) -> str | None:
    """Name of the size and resize rule a model wants; None: any size will do."""
    if spec.width is None or spec.height is None or spec.resize == "none":
        return None
    return f"{spec.width}x{spec.height}-{spec.resize}"


def prepare_image(image: Image, spec: CameraSpec) -> NDArray[np.uint8]:
    """An image in the size and channel order of the spec.

    Raises:
        SpecError: it has another size and the spec does not say how to resize it.
    """
    rgb = image.rgb
    if spec.width is not None and spec.height is not None:
        rgb = _resize(rgb, spec)
    if spec.colour == "bgr":
        rgb = np.ascontiguousarray(rgb[..., ::-1])
    return rgb


def _resize(rgb: NDArray[np.uint8], spec: CameraSpec) -> NDArray[np.uint8]:
    assert spec.width is not None and spec.height is not None
    height, width = rgb.shape[:2]
    if (height, width) == (spec.height, spec.width):
        return rgb
    if spec.resize == "none":
        raise SpecError(
            f"camera {spec.camera!r} sends {width}x{height}, the spec asks for "
            f"{spec.width}x{spec.height} and says resize: none"
        )
    if spec.resize == "stretch":
        return _scale(rgb, spec.width, spec.height)
    fit = min if spec.resize == "pad" else max
    factor = fit(spec.width / width, spec.height / height)
    scaled = _scale(rgb, max(1, round(width * factor)), max(1, round(height * factor)))
    out = np.zeros((spec.height, spec.width, 3), np.uint8)
    top, left = (spec.height - scaled.shape[0]) // 2, (spec.width - scaled.shape[1]) // 2
    cut = scaled[max(-top, 0) :, max(-left, 0) :][: spec.height, : spec.width]
    top, left = max(top, 0), max(left, 0)
    out[top : top + cut.shape[0], left : left + cut.shape[1]] = cut
    return out


def _scale(rgb: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    smaller = width < rgb.shape[1] or height < rgb.shape[0]
    method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(rgb, (width, height), interpolation=method), np.uint8)


def make_chunk(
    worker: str,
    spec_hash: str,
    dt_s: float,
    observation: Observation,
    answer: ActionSteps,
    *,
    patience_s: float,
    observed_ns: int,
    start_ns: int,
    end_ns: int,
) -> ActionChunk:
    """The action chunk of a worker's answer to `observation`.

    Args:
        worker: its name.
        spec_hash: of its model.
        dt_s: duration of a step.
        observation: that was answered.
        answer: with checked steps.
        patience_s: how long the chunk is valid after its last step.
        observed_ns: observation complete, wall clock.
        start_ns: start of inference, wall clock.
        end_ns: end of inference, wall clock.
    """
    steps = np.asarray(answer.steps)
    valid_ns = int(len(steps) * dt_s * 1e9) + int(patience_s * 1e9)
    return ActionChunk(
        worker=worker,
        spec_hash=spec_hash,
        episode=observation.task.episode,
        observation_stamp_ns=observation.stamp_wall_ns,
        observation_seq=observation.seq,
        valid_until_ns=observation.stamp_wall_ns + valid_ns,
        steps=steps,
        observed_ns=observed_ns,
        inference_start_ns=start_ns,
        inference_end_ns=end_ns,
        done=answer.done,
    )
