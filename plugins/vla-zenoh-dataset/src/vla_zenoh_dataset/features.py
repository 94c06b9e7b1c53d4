"""Columns of a dataset, and the state of the robot as one of them."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.policy_servers.state_vector import StateNumbers, parts_of, state_numbers
from vla_zenoh.lab.recording.run import Run, nearest
from vla_zenoh.policy import ActionSpec, Observation
from vla_zenoh.policy.meaning import ROTATION_FORMS
from vla_zenoh.policy.spec import STREAM_OF
from vla_zenoh.types import Task
from vla_zenoh_dataset.episodes import RecordedEpisode

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
STRIDE = 4
"""Only every fourth row and column of an image counts."""


def of_numbers(rows: ArrayLike) -> dict[str, list[Any]]:
    """min, max, mean, std, count and quantiles of (n,) or (n, D), each of length D."""
    table = np.asarray(rows, np.float64)
    table = table.reshape(len(table), -1)
    out = {
        "min": table.min(axis=0),
        "max": table.max(axis=0),
        "mean": table.mean(axis=0),
        "std": table.std(axis=0),
        **{name: np.quantile(table, share, axis=0) for name, share in QUANTILES.items()},
    }
    return {name: value.tolist() for name, value in out.items()} | {"count": [len(table)]}


class Histogram:
    """Histogram of images, whose statistics LeRobot keeps for each channel.

    Args:
        step: value of one level; LeRobot's colours are in [0, 1].
    """

    def __init__(self, step: float = 1 / 255, channels: int = 3, levels: int = 256) -> None:
        self.levels: Any = np.zeros((channels, levels), np.int64)
        self.count, self._step = 0, step

    def add(self, image: NDArray[Any]) -> None:
        """Count the levels of an image, (H, W, channels) or (H, W)."""
        seen = image[::STRIDE, ::STRIDE].reshape(-1, len(self.levels))
        for levels, values in zip(self.levels, seen.T, strict=True):
            levels += np.bincount(values, minlength=len(levels))
        self.count += 1

    def statistics(self) -> dict[str, list[Any]]:
        """As `of_numbers`, each of shape (channels, 1, 1); count is the number of images."""
        values = np.arange(self.levels.shape[1]) * self._step
        channels: dict[str, list[float]] = {}
        for levels in self.levels:
            seen = np.flatnonzero(levels)
            mean = float(levels @ values / levels.sum())
            below = np.cumsum(levels) / levels.sum()
            found = {
                "min": values[seen[0]],
                "max": values[seen[-1]],
                "mean": mean,
                "std": np.sqrt(levels @ (values - mean) ** 2 / levels.sum()),
                **{name: values[np.searchsorted(below, q)] for name, q in QUANTILES.items()},
            }
            for name, value in found.items():
                channels.setdefault(name, []).append(float(value))
        return {name: [[[v]] for v in found] for name, found in channels.items()} | {
            "count": [self.count]
        }


def joined(histograms: Sequence[Histogram]) -> dict[str, list[Any]]:
    """Statistics of all `histograms` together; there is at least one."""
    every = copy.copy(histograms[0])
    every.levels = sum(each.levels for each in histograms)
    every.count = sum(each.count for each in histograms)
    return every.statistics()


STATE, ACTION, PICTURE = "observation.state", "action", "observation.images."
INTERVENTION = "intervention"
"""A person led the arm; the name that LeRobot's rollouts with corrections have."""
NAMES = {
    "position": ["x", "y", "z"],
    **{name: [*form.names] for name, form in ROTATION_FORMS.items()},
    "wrench": [*(f"force_{axis}" for axis in "xyz"), *(f"torque_{axis}" for axis in "xyz")],
    "fingers_m": ["left_finger", "right_finger"],
}
GRIPPER_POSITIONS = ("gripper_m", "gripper_absolute_m", "gripper_open", "gripper_open_fraction")
NEAR_NS = 100_000_000
"""Largest distance in time between a frame and its state."""


def state_names(parts: Sequence[str], joints: Sequence[str]) -> list[str]:
    """Names of the numbers of a state."""
    of_arm = {"joint": [*joints], "joint_deg": [f"{name}_deg" for name in joints]}
    of_arm["effort"] = [f"{name}_effort" for name in joints]
    return [name for part in parts for name in {**NAMES, **of_arm}.get(part, [part])]


def names_of_state(episode: RecordedEpisode, parts: Sequence[str]) -> list[str]:
    """Names of the numbers of an episode's state, one part of the robot after the other."""
    out: list[str] = []
    for part in episode.spec.parts:
        joints = episode.run.of_part(part).joints
        names = joints[0].record.names if joints else ()
        out += _of_part(part, state_names(parts, names), names)
    return out


def action_names(spec: ActionSpec) -> list[str]:
    """Names of the numbers of a step, one part of the robot after the other."""
    if spec.parts:
        each = [
            _of_part(
                one.part,
                action_names(one.action),
                one.action.joints if one.action.kind == "absolute" else (),
            )
            for one in spec.parts
        ]
        return [name for names in each for name in names]
    gripper = [] if spec.gripper == "none" else [f"gripper_{spec.gripper}"]
    arm = spec.joints if spec.space == "joint" else [*NAMES["position"], *NAMES[spec.rotation]]
    return [*arm, *gripper]


def _of_part(part: str, names: Sequence[str], joints: Sequence[str]) -> list[str]:
    """Names as of LeRobot's robots with two arms: ``left_joint1.pos``, ``left_gripper.pos``.

    Those that LeRobot has no name for follow the part as they are. Units are ours: rad, and metres
    or a share of the opening.

    Args:
        part: of the robot; empty: it is one arm, whose names stay.
    """
    if not part:
        return [*names]
    own = {name: f"{name}.pos" for name in joints} | dict.fromkeys(GRIPPER_POSITIONS, "gripper.pos")
    return [f"{part}_{own.get(name, name)}" for name in names]


def usual_state(episodes: Sequence[RecordedEpisode]) -> str:
    """Parts of the state that go with the actions: joints with joints, else the pose."""
    first = episodes[0].spec if episodes else None
    joints = first is not None and first.action.of(first.parts[0]).space == "joint"
    return "joint+gripper_m" if joints else "position+rpy+gripper_m"


def states_of(episode: RecordedEpisode, parts: Sequence[str]) -> NDArray[np.float32]:
    """(n, S) state of the robot at each frame, one part of the robot after the other.

    Raises:
        RecordingError: no state was recorded near a frame.
    """
    each = [_states(episode, episode.run.of_part(part), parts) for part in episode.spec.parts]
    return np.concatenate(each, axis=1)


def numbers_of(run: Run, parts: Sequence[str]) -> StateNumbers:
    """The numbers of a state of the run's robot, whose joints come as they were recorded.

    Raises:
        RecordingError: the recording holds no profile.
    """
    found = state_numbers(parts, run.profile)
    return replace(found, joints=run.joints[0].record.names) if run.joints else found


def _states(episode: RecordedEpisode, run: Run, parts: Sequence[str]) -> NDArray[np.float32]:
    streams: dict[str, Any] = {"joint": run.joints, "pose": run.poses, "gripper": run.grippers}
    wanted = {part: streams[STREAM_OF.get(part, part)] for part in parts_of(parts)}
    numbers, place = numbers_of(run, parts), f"{run.part}/" if run.part else ""
    task = Task(0, True, "", episode.worker, 1.0)
    rows = []
    for frame in episode.frames:
        found: dict[str, Any] = {}
        for part, stream in wanted.items():
            near = nearest(stream, frame.stamp_ns)
            if near is None or abs(near.header.stamp_wall_ns - frame.stamp_ns) > NEAR_NS:
                raise RecordingError(
                    f"{run.path}: no {place}state/{part} within {NEAR_NS / 1e6:g} ms of a frame"
                )
            name = {"effort": "effort_nm"}.get(part, part)
            found[name] = near.record if part in streams else getattr(near.record, name)
            if found[name] is None:
                raise RecordingError(f"{run.path}: its robot did not measure {part}")
        observation = Observation(frame.stamp_ns, 0, task, **found)
        rows.append(numbers.encode(observation))
    return np.array(rows, np.float32)
