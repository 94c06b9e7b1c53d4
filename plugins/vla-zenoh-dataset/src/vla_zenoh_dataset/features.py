"""Columns of a dataset, and the state of the robot as one of them.

Actions that are positions of joints, and the state that goes with them, are in the numbers of
LeRobot's own robots, whose names they have: ``JOINT.pos`` in degrees, of a joint that slides in m,
``gripper.pos`` from 0 shut to 100 open. All others are in ours.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from vla_zenoh_policy_servers.action_semantics import (
    NO_CONTROLLER,
    ActionSemantics,
    read_action_semantics,
)
from vla_zenoh_policy_servers.presets import LEROBOT, LEROBOT_STATE
from vla_zenoh_policy_servers.state_vector import (
    PARTS,
    StateNumbers,
    names_of_part,
    parts_of,
    state_numbers,
)

from vla_zenoh.errors import RecordingError, SpecError
from vla_zenoh.kinematics.description import sliding_joints
from vla_zenoh.lab.recording.run import Run, nearest
from vla_zenoh.policy import ActionSpec, Observation, StatePart
from vla_zenoh.policy.meaning import ROTATION_FORMS, joints_as, unturned, wrapped
from vla_zenoh.policy.spec import FIELD_OF, STREAM_OF
from vla_zenoh.profile import Profile
from vla_zenoh.types import Task
from vla_zenoh_dataset.episodes import EpisodeGap, RecordedEpisode, endless_joints

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
LEAST_SPREAD = 1e-6
"""Std of a number that changed; of one over 1 a share of its size. What is less is rounding."""
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


def to_scale_with(found: Mapping[str, list[Any]]) -> dict[str, list[Any]]:
    """Statistics of `of_numbers` that a policy can be scaled with.

    The std of a number that never changed is 1: scaled with 0, a sensor's noise would be the
    largest thing that a policy sees.
    """
    std = [
        1.0 if spread <= LEAST_SPREAD * max(abs(mean), 1.0) else spread
        for spread, mean in zip(found["std"], found["mean"], strict=True)
    ]
    return {**found, "std": std}


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
NEAR_NS = 100_000_000
"""Largest distance in time between a frame and its state."""


def in_lerobots_numbers(spec: ActionSpec) -> bool:
    """Whether actions of one arm are positions of joints, so that LeRobot's robots have them."""
    return spec.space == "joint" and spec.kind == "absolute" and spec.gripper != "delta_m"


def worker_options(spec: ActionSpec, profile: Profile) -> dict[str, str]:
    """What the actions of one arm mean in a dataset, as options of the worker ``lerobot``."""
    options = {"dt_s": repr(spec.dt_s), "gripper": spec.gripper}
    if spec.turns == "counted":
        options["joint_turns"] = spec.turns
    if in_lerobots_numbers(spec):
        grips = spec.gripper != "none"
        options |= {each: LEROBOT[each] for each in LEROBOT if grips or "grip" not in each}
        if sliding := sliding_joints(profile.robot):
            degree = options["joint_scale_rad"]
            units = ("1" if name in sliding else degree for name in spec.joints)
            options["joint_scale_rad"] = ",".join(units)
        return options
    if spec.gripper in ("open_fraction", "binary"):
        options["gripper_open"] = "high" if spec.gripper_open_is_high else "low"
        options["gripper_threshold"] = repr(spec.gripper_threshold)
    if spec.kind != "absolute":
        controller = spec.controller
        options["anchor"], options["relative_to"] = spec.anchor, spec.relative_to
        options["controller"] = (
            f"{controller.kp!r}:{controller.damping_ratio!r}" if controller else NO_CONTROLLER
        )
    if spec.space == "joint":
        kind = {"absolute": "position"}.get(spec.kind, spec.kind)
        return options | {"action": f"joint_{kind}", "joint_scale_rad": "1"}
    rotation = {"quaternion": "quat_xyzw"}.get(spec.rotation, spec.rotation)
    scale = repr(spec.position_scale_m)
    arm = {"action": spec.kind, "frame": spec.frame, "rotation": rotation}
    return options | arm | {"position_scale_m": scale}


def semantics_of(spec: ActionSpec, profile: Profile) -> ActionSemantics:
    """The numbers of a dataset with actions of one arm."""
    return read_action_semantics(
        {**worker_options(spec, profile), "horizon": str(spec.horizon)}, joints=spec.joints
    )


def state_names(
    parts: Sequence[str], joints: Sequence[str], spec: ActionSpec | None = None
) -> list[str]:
    """Names of the numbers of a state; `spec`: of the actions that it goes with."""
    per_joint = [part for part, (_, count) in PARTS.items() if count is None]
    own = {part: [f"{name}_{part}" for name in joints] for part in per_joint}
    own |= {"joint": [*joints], "joint_deg": [f"{name}_deg" for name in joints]}
    if spec is not None and in_lerobots_numbers(spec):
        own["joint"] = [f"{name}.pos" for name in joints]
        if spec.gripper != "none":
            own["gripper_open"] = ["gripper.pos"]
    return [name for part in parts for name in {**NAMES, **own}.get(part, [part])]


def names_of_state(numbers: Mapping[str, StateNumbers], spec: ActionSpec) -> list[str]:
    """Names of the numbers of a state, one part of the robot after the other.

    Args:
        numbers: of every part.
        spec: of the actions that it goes with.
    """
    each = [
        _of_part(part, state_names(own.names, own.joints, spec.of(part)))
        for part, own in numbers.items()
    ]
    return [name for names in each for name in names]


def kept_columns(spec: ActionSpec, *, rotation: bool) -> list[int]:
    """Numbers of a step that a dataset has.

    Args:
        rotation: whether it has those of rotations.
    """
    out: list[int] = []
    for part in [each.part for each in spec.parts] or [""]:
        own, every = spec.of(part), range(spec.dimension)[spec.columns(part)]
        turns = () if rotation or own.space == "joint" else every[own.rotation_columns]
        out += [column for column in every if column not in turns]
    return out


def check_never_turns(episodes: Sequence[RecordedEpisode]) -> None:
    """Nothing is lost without the numbers of rotations.

    Raises:
        RecordingError: a step turns the hand, or is a pose.
    """
    spec = episodes[0].spec.action
    for part in episodes[0].spec.parts:
        own = spec.of(part)
        if own.space == "joint":
            continue
        if own.kind == "absolute":
            raise RecordingError("--no-rotation: these actions are poses, which have a rotation")
        still = unturned(own.rotation)
        for episode in episodes:
            steps = np.array([frame.action for frame in episode.frames])
            if np.any(steps[:, spec.columns(part)][:, own.rotation_columns] != still):
                raise RecordingError(
                    f"--no-rotation: {episode.run.path} has steps that turn the hand; leave the "
                    "option out"
                )


def action_names(spec: ActionSpec) -> list[str]:
    """Names of the numbers of a step, one part of the robot after the other."""
    if spec.parts:
        each = [_of_part(one.part, action_names(one.action)) for one in spec.parts]
        return [name for names in each for name in names]
    if in_lerobots_numbers(spec):
        gripper = [] if spec.gripper == "none" else ["gripper.pos"]
        return [*(f"{name}.pos" for name in spec.joints), *gripper]
    gripper = [] if spec.gripper == "none" else [f"gripper_{spec.gripper}"]
    arm = spec.joints if spec.space == "joint" else [*NAMES["position"], *NAMES[spec.rotation]]
    return [*arm, *gripper]


def _of_part(part: str, names: Sequence[str]) -> list[str]:
    """Names as of LeRobot's robots with two arms: ``left_joint1.pos``, ``left_gripper.pos``.

    Args:
        part: of the robot; empty: it is one arm, whose names stay.
    """
    return [f"{part}_{name}" if part else name for name in names]


def usual_state(episodes: Sequence[RecordedEpisode]) -> str:
    """Parts of the state that go with the actions: joints with joints, else the pose."""
    if not episodes:
        return "position+rpy+gripper_m"
    run, parts = episodes[0].run, episodes[0].spec.parts
    actions = [episodes[0].spec.action.of(part) for part in parts]
    grips = any(run.of_part(part).profile.robot.gripper for part in parts)
    gripper = "+gripper_m" if grips else ""
    if actions[0].space != "joint":
        return f"position+rpy{gripper}"
    if not in_lerobots_numbers(actions[0]):
        return f"joint{gripper}"
    return LEROBOT_STATE if any(each.gripper != "none" for each in actions) else "joint"


def actions_of(episode: RecordedEpisode) -> NDArray[np.float32]:
    """(n, D) actions of the frames, one part of the robot after the other."""
    spec, steps = episode.spec, np.array([frame.action for frame in episode.frames], np.float32)
    each = [
        _actions(spec.action.of(part), steps[:, spec.action.columns(part)], episode.run, part)
        for part in spec.parts
    ]
    return np.concatenate(each, axis=1).astype(np.float32)


def _actions(spec: ActionSpec, steps: NDArray[np.float32], run: Run, part: str) -> NDArray[Any]:
    if spec.space == "joint" and spec.kind == "absolute" and spec.turns == "wrapped":
        endless = np.flatnonzero(endless_joints(run, spec, part))
        steps = steps.copy()
        steps[:, endless] = wrapped(steps[:, endless])
    if not in_lerobots_numbers(spec):
        return steps
    rows = steps.astype(np.float64)
    if spec.gripper != "none":
        robot = run.of_part(part).profile.robot
        max_width_m = robot.require_gripper(f"{run.path}: gripper={spec.gripper}").max_width_m
        scale, binary = spec.gripper_scale(max_width_m), spec.gripper == "binary"
        rows[:, -1] = [
            spec.opens(number) if binary else scale.decode(number) for number in rows[:, -1]
        ]
    return semantics_of(spec, run.of_part(part).profile).rows(rows)


def states_of(episode: RecordedEpisode, numbers: Mapping[str, StateNumbers]) -> NDArray[np.float32]:
    """(n, S) state of the robot at each frame, one part of the robot after the other.

    Args:
        numbers: of every part, see `numbers_of`; the same for all episodes of a data set.

    Raises:
        EpisodeGap: no state was recorded near a frame.
        RecordingError: one of other joints, or without a part.
    """
    each = [_states(episode, episode.run.of_part(part), own) for part, own in numbers.items()]
    return np.concatenate(each, axis=1)


def numbers_of(episode: RecordedEpisode, parts: Sequence[str]) -> dict[str, StateNumbers]:
    """Part of the robot -> the numbers of its state, which go with the episode's actions.

    The joints are in the order of the profile, in which a policy is told them, whatever the order
    in which they were published. Where others were recorded, it is those.

    Raises:
        RecordingError: the recording holds no profile.
    """
    out: dict[str, StateNumbers] = {}
    runs = {part: episode.run.of_part(part) for part in episode.spec.parts}
    arms = {part: run.profile for part, run in runs.items()}
    for part, run in runs.items():
        units = semantics_of(episode.spec.action.of(part), run.profile).state_units
        own = state_numbers(names_of_part(parts, part, arms), run.profile, units)
        recorded = run.joints[0].record.names if run.joints else own.joints
        known = set(own.joints) <= set(recorded)
        out[part] = own if known else replace(own, joints=recorded)
    return out


def check_one_robot(episodes: Sequence[RecordedEpisode]) -> None:
    """All recordings are of the same joints, whatever is exported of them.

    Raises:
        RecordingError: they are not; names two of them.
    """
    for part in episodes[0].spec.parts:
        arms = {
            str(each.run.path): each.run.of_part(part).profile.robot.arm_joints for each in episodes
        }
        (first, joints), *others = arms.items()
        other = next((name for name, own in others if {*own} != {*joints}), None)
        if other is not None:
            raise RecordingError(
                f"{first} and {other} are of different robots: their joints are "
                f"{', '.join(joints)}, and {', '.join(arms[other])}; export the recordings of each "
                "robot by themselves"
            )


def check_gripper_widths(episodes: Sequence[RecordedEpisode], names: Sequence[str]) -> None:
    """A share of an open gripper is the same width in all recordings.

    Args:
        names: of the parts of the state.

    Raises:
        RecordingError: their profiles have different widths.
    """
    shares = {"gripper_open", "gripper_closed"} & {*names}
    for part in episodes[0].spec.parts:
        action = episodes[0].spec.action.of(part)
        by_width = action.gripper == "absolute_m" and in_lerobots_numbers(action)
        if not (shares or by_width or action.gripper == "open_fraction"):
            continue
        runs = {str(each.run.path): each.run.of_part(part) for each in episodes}
        widths = {name: run.profile.robot.max_width_m for name, run in runs.items()}
        first, *others = widths
        other = next((name for name in others if widths[name] != widths[first]), None)
        if other is not None:
            raise RecordingError(
                f"{first} and {other} have different grippers: gripper.max_width_m is "
                f"{widths[first]:g} and {widths[other]:g} m in their profiles, and a share of it "
                "would mean two widths in one data set; export the recordings of each gripper by "
                "themselves"
            )


def _states(episode: RecordedEpisode, run: Run, numbers: StateNumbers) -> NDArray[np.float32]:
    streams: dict[str, Any] = {"joint": run.joints, "pose": run.poses, "gripper": run.grippers}
    wanted: dict[StatePart, Any] = {
        part: streams[STREAM_OF.get(part, part)] for part in parts_of(numbers.names)
    }
    place = f"{run.part}/" if run.part else ""
    task = Task(0, True, "", episode.worker, 1.0)
    rows = []
    for frame in episode.frames:
        found: dict[str, Any] = {}
        for part, stream in wanted.items():
            near = nearest(stream, frame.stamp_ns)
            if near is None or abs(near.header.stamp_wall_ns - frame.stamp_ns) > NEAR_NS:
                raise EpisodeGap(
                    f"{episode.named} has no {place}state/{part} within {NEAR_NS / 1e6:g} ms of "
                    f"its frame at {episode.after_s(frame.stamp_ns):.1f} s"
                )
            name = FIELD_OF.get(part, part)
            found[name] = near.record if part in streams else getattr(near.record, name)
            if part == "joint":
                turns = episode.spec.action.of(run.part).turns
                found[name] = joints_as(near.record, turns)
            if found[name] is None:
                raise RecordingError(f"{run.path}: its robot did not measure {part}")
        observation = Observation(frame.stamp_ns, 0, task, **found)
        try:
            rows.append(numbers.encode(observation))
        except SpecError as error:
            raise RecordingError(
                f"{run.path}: {error}. Export the recordings of each robot by themselves"
            ) from error
    return np.array(rows, np.float32)
