"""Assembles coherent observations from many streams: newest, near in time, as the spec declares."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import SpecError
from vla_zenoh.keys import NOTHING_YET
from vla_zenoh.policy import (
    CameraSpec,
    DepthSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
    StatePart,
)
from vla_zenoh.policy.meaning import joints_as
from vla_zenoh.policy.resize import scaled
from vla_zenoh.policy.spec import FIELD_OF, STREAM_OF
from vla_zenoh.types import (
    Depth,
    GripperState,
    Image,
    JointState,
    PoseState,
    PrivilegedState,
    Stamped,
    Task,
)
from vla_zenoh.types.records import MAX_COUNT

MAX_STATES, MAX_PICTURES = 4096, 128
PAIR_S = 0.15
"""Colour and depth of one moment are published this much apart at most."""
ROUNDING = 1e-6
CLOCK_TOLERANCE_S = 0.05
"""An image may lie this far in the future before its clock counts as wrong."""


@dataclass(slots=True)
class History:
    """The last samples of one stream, oldest first, to find the one nearest to a time.

    Args:
        size: number of samples that are kept.
        keep_s: samples this much older than the newest are kept as well.
        most: number of samples in all.
    """

    size: int = 128
    keep_s: float = 0.0
    most: int = MAX_STATES
    entries: list[Stamped[Any]] = field(default_factory=list)

    def add(self, entry: Stamped[Any]) -> None:
        """Add a sample; one older than the newest clears the history, as its writer restarted."""
        if self.entries and entry.header.stamp_wall_ns < self.entries[-1].header.stamp_wall_ns:
            self.entries.clear()
        self.entries.append(entry)
        if len(self.entries) < 2 * self.size:
            return
        cut = len(self.entries) - self.size
        if self.keep_s > 0.0:
            kept_ns = _stamp_ns(entry) - round(self.keep_s * 1e9)
            cut = min(cut, bisect_left(self.entries, kept_ns, key=_stamp_ns))
        del self.entries[: max(cut, len(self.entries) - self.most)]

    def first_since(self, stamp_ns: int) -> int:
        """Stamp of the first sample that is not older; of the newest where all are."""
        at = bisect_left(self.entries, stamp_ns, key=_stamp_ns)
        return _stamp_ns(self.entries[min(at, len(self.entries) - 1)])

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest; 0 without records."""
        return _stamp_ns(self.entries[-1]) if self.entries else 0

    def nearest(self, stamp_ns: int) -> Stamped[Any] | None:
        """The entry whose stamp is nearest; None without entries."""
        right = bisect_right(self.entries, stamp_ns, key=_stamp_ns)
        around = self.entries[max(right - 1, 0) : right + 1]
        return min(around, key=lambda entry: abs(_stamp_ns(entry) - stamp_ns), default=None)


STATE_KINDS: dict[str, type[Any]] = {
    "joint": JointState,
    "pose": PoseState,
    "gripper": GripperState,
    "privileged": PrivilegedState,
}
"""Records of the state. Their keys are ``state_joint`` etc. of `Keys`."""


def state_names(
    spec: ObservationSpec, parts: Sequence[str] = ("",)
) -> dict[str, tuple[str, StatePart]]:
    """Every state that is received: name (``pose``, ``left/pose``) -> part and what."""
    return {
        f"{part}/{what}" if part else what: (part, what)
        for part in parts
        for what in spec.state_streams
    }


class Moment(NamedTuple):
    """The entry of each stream that is nearest to a time; see `Streams`."""

    stamp_ns: int
    images: Mapping[str, Stamped[Image]]
    depth: Mapping[str, Stamped[Depth]]
    states: Mapping[str, Stamped[Any]]

    def apart(self, most_s: float) -> tuple[str, float, str] | None:
        """Name of the first entry more than `most_s` away, how far in s, and from what."""
        for kind, entries, others in (
            (_STATE, self.states, "images"),
            (_IMAGE, self.images, "others"),
            (_DEPTH, self.depth, "others"),
        ):
            for name, entry in entries.items():
                apart_s = abs(_stamp_ns(entry) - self.stamp_ns) / 1e9
                if apart_s > most_s:
                    return kind.format(name), apart_s, others
        return None


def _stamp_ns(entry: Stamped[Any]) -> int:
    return entry.header.stamp_wall_ns


_IMAGE, _DEPTH, _STATE = "camera {!r}", "depth of camera {!r}", "state/{}"
"""Names of streams in messages."""


@dataclass(frozen=True, slots=True)
class Streams:
    """What a worker has received of the streams that its model observes.

    Args:
        images: camera -> its images.
        depth: camera -> its depth images.
        states: record (``joint``, ``pose``, ``gripper``; see `state_names`) -> its states.
    """

    images: Mapping[str, History]
    depth: Mapping[str, History]
    states: Mapping[str, History]

    @staticmethod
    def of(spec: ObservationSpec, parts: Sequence[str] = ("",)) -> Streams:
        """Empty ones, which keep enough for an observation of this kind of these parts."""
        # A colour image waits for the depth image of the same moment.
        kept_s = PAIR_S if spec.depth or spec.history > 1 else 0.0
        if spec.history > 1:
            kept_s += spec.history_span_s + spec.max_skew_s
        pictures = partial(History, 1, kept_s, MAX_PICTURES)
        return Streams(
            {one.camera: pictures() for one in spec.cameras},
            {one.camera: pictures() for one in spec.depth},
            {name: History(keep_s=kept_s) for name in state_names(spec, parts)},
        )

    def leading(self) -> list[History]:
        """The streams whose stamps are those of the observation."""
        pictures = [*self.images.values(), *self.depth.values()]
        return pictures or list(self.states.values())

    def silent(self) -> list[str]:
        """Names of the streams of which nothing was received."""
        named = (_IMAGE, self.images), (_DEPTH, self.depth), (_STATE, self.states)
        return [
            kind.format(name)
            for kind, streams in named
            for name, one in streams.items()
            if not one.entries
        ]

    def at(self, stamp_ns: int) -> Moment:
        """What was received nearest to this time; nothing may be `silent`."""
        images, depth, states = (
            {name: near for name, one in streams.items() if (near := one.nearest(stamp_ns))}
            for streams in (self.images, self.depth, self.states)
        )
        return Moment(stamp_ns, images, depth, states)


@dataclass(frozen=True, slots=True)
class NotReady:
    """Why there is no observation now; `waiting`: it is early, and nothing is wrong."""

    why: str
    waiting: bool = False


def assemble(
    spec: ModelSpec,
    task: Task,
    streams: Streams,
    *,
    not_before_ns: int,
    now_ns: int,
    robot: str = "",
    episode_ns: int = 0,
) -> Observation | NotReady:
    """The newest observation that fits the spec, or why there is none.

    Args:
        spec: what the model needs.
        task: prompt and episode.
        streams: what was received.
        not_before_ns: an observation from before this time is not used: it cannot show the effect
            of the last chunk.
        now_ns: wall clock.
        robot: its name, for the observation.
        episode_ns: when the episode began; what is older is not in its history.

    Raises:
        SpecError: an image does not have the size of the spec, see `prepare_image` and
            `prepare_depth`.
    """
    wanted = spec.observation
    if wanted.prompt and not task.prompt:
        return NotReady("there is no prompt", waiting=True)
    silent = streams.silent()
    if silent:
        return NotReady(f"{NOTHING_YET} of {', '.join(silent)}")
    oldest = min((one.entries[-1] for one in streams.leading()), key=_stamp_ns, default=None)
    stamp_ns = oldest.header.stamp_wall_ns if oldest else now_ns
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
    moment = streams.at(stamp_ns)
    apart = moment.apart(wanted.max_skew_s)
    if apart is not None:
        name, skew_s, others = apart
        return NotReady(f"{name} is {skew_s:.3f} s apart from the {others}")
    seq = oldest.header.seq if oldest else 0
    now = _observation(spec, moment, (stamp_ns, seq, task), robot)
    if wanted.history == 1 or isinstance(now, NotReady):
        return now
    before = _history(now, spec, streams, episode_ns)
    return before if isinstance(before, NotReady) else replace(now, history=before)


def _observation(
    spec: ModelSpec, moment: Moment, first: tuple[int, int, Task], robot: str
) -> Observation | NotReady:
    """The observation of a moment; `first`: its stamp, number and task."""
    wanted = spec.observation
    found: dict[str, dict[str, Any]] = defaultdict(dict)
    for stream, entry in moment.states.items():
        part, _, kind = stream.rpartition("/")
        for what in wanted.state:
            if STREAM_OF.get(what, what) != kind:
                continue
            name = FIELD_OF.get(what, what)
            value = entry.record if what == kind else getattr(entry.record, name)
            if value is None:
                where = _STATE.format(stream)
                return NotReady(f"{where} holds no {name}: this robot does not measure it")
            if what == "joint":
                value = joints_as(value, spec.action.of(part).turns)
            found[part][name] = value
    images = {c.camera: prepare_image(moment.images[c.camera].record, c) for c in wanted.cameras}
    depth = {c.camera: prepare_depth(moment.depth[c.camera].record, c) for c in wanted.depth}
    whole = Observation(*first, images, depth, robot=robot, **found.pop("", {}))
    if not found:
        return whole
    return replace(whole, parts={part: replace(whole, **own) for part, own in found.items()})


def _history(
    now: Observation, spec: ModelSpec, streams: Streams, episode_ns: int
) -> tuple[Observation, ...] | NotReady:
    """The observations before this one, oldest first, or why there are none."""
    wanted = spec.observation
    assert wanted.history_spacing_s is not None
    leading = streams.leading()
    first_ns = max(one.first_since(episode_ns) for one in leading)
    most_s = min(wanted.max_skew_s, wanted.history_spacing_s / 2)
    before: list[Observation] = []
    for steps in range(wanted.history - 1, 0, -1):
        ago_s = steps * wanted.history_spacing_s
        at_ns = now.stamp_wall_ns - round(ago_s * 1e9)
        if at_ns < first_ns and wanted.history_start == "wait":
            return NotReady(f"the episode is younger than {ago_s:g} s", waiting=True)
        # Never later than the observation itself, which may be the first one.
        moment = streams.at(min(max(at_ns, first_ns), now.stamp_wall_ns))
        apart = moment.apart(most_s)
        if apart is not None:
            name, apart_s, _ = apart
            return NotReady(
                f"history: {name} has nothing within {most_s:g} s of the time {ago_s:g} s "
                f"ago, the nearest is {apart_s:.3f} s away"
            )
        pictures = [*moment.images.values(), *moment.depth.values()]
        lead = min(pictures or moment.states.values(), key=_stamp_ns).header
        first = lead.stamp_wall_ns, lead.seq, now.task
        then = _observation(spec, moment, first, now.robot)
        if isinstance(then, NotReady):
            return then
        before.append(then)
    return tuple(before)


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
    rgb = _resize(image.rgb, spec)
    if spec.colour == "bgr":
        rgb = np.ascontiguousarray(rgb[..., ::-1])
    return rgb


def _resize(rgb: NDArray[Any], spec: CameraSpec | DepthSpec) -> NDArray[Any]:
    height, width = rgb.shape[:2]
    if spec.width is None or spec.height is None or (height, width) == (spec.height, spec.width):
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
    small = _scale(rgb, max(1, round(width * factor)), max(1, round(height * factor)))
    out = np.zeros((spec.height, spec.width, *rgb.shape[2:]), rgb.dtype)
    top, left = (spec.height - small.shape[0]) // 2, (spec.width - small.shape[1]) // 2
    cut = small[max(-top, 0) :, max(-left, 0) :][: spec.height, : spec.width]
    top, left = max(top, 0), max(left, 0)
    out[top : top + cut.shape[0], left : left + cut.shape[1]] = cut
    return out


def _scale(rgb: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    if rgb.ndim == 3:
        return scaled(rgb, width, height)
    from vla_zenoh.opencv import cv2

    # No depth is half way between an edge and its background.
    method = cv2.INTER_NEAREST_EXACT
    return np.asarray(cv2.resize(rgb, (width, height), interpolation=method))


def prepare_depth(depth: Depth, spec: DepthSpec) -> NDArray[np.uint16]:
    """A depth image in the size, unit and range of the spec, (H, W) in counts.

    Raises:
        SpecError: it has another size and the spec does not say how to resize it.
    """
    counts = _resize(depth.counts, spec)
    whole = MAX_COUNT - (spec.invalid == MAX_COUNT)
    far_m = whole * spec.unit_m if spec.far_m is None else spec.far_m
    # The same unit goes through as it is, bit by bit.
    scale = depth.unit_m / spec.unit_m
    out = counts if scale == 1.0 else np.rint(counts * scale)
    least = max(1, math.ceil(spec.near_m / spec.unit_m - ROUNDING))
    most = min(whole, math.floor(far_m / spec.unit_m + ROUNDING))
    good = (counts > 0) & (out >= least) & (out <= most)
    return np.where(good, out, spec.invalid).astype(np.uint16)
