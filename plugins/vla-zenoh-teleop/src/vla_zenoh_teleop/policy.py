"""Teleoperation policy: turns operator input into action chunks. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from vla_zenoh.policy import ActionSpec, ActionSteps, Frame, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.spec import PERSON
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray

DT_S = 0.05
HORIZON = 20
"""Steps at most: below one chunk per second the arm holds between chunks."""
COVER_S = 0.1
"""A chunk lasts this much longer than the period of requests, for the next one's delay."""
SPEEDS = ((0.01, 0.05), (0.03, 0.15), (0.06, 0.3), (0.12, 0.6), (0.2, 1.0))
"""Levels: m/s and rad/s, before the profile's limits."""
OPENING_M_S = 0.04
BELOW = 1 - 1e-6
"""Steps travel as float32, and rounding must not put one beyond the limit."""
AXES = 6
AXIS_NAMES = ("x", "y", "z", "rx", "ry", "rz")
Twist = tuple[float, float, float, float, float, float]
STILL: Twist = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
DEAD_ZONE = 0.08
"""A released stick rests this near to its centre."""


class OperatorInput(NamedTuple):
    """Operator input at one moment.

    Args:
        twist: x, y, z and the rotation about them, each a share of the selected speed in [-1, 1].
        opening: opens (1) or closes (-1) the gripper, in [-1, 1].
        toggles: count of open/close commands so far; only changes matter.
        takeovers: count of commands to take the arm or give it back so far.
        part: count of commands to move the next part of the robot so far.
    """

    twist: Twist = STILL
    opening: float = 0.0
    toggles: int = 0
    takeovers: int = 0
    part: int = 0


def combined(one: OperatorInput, other: OperatorInput) -> OperatorInput:
    twist = [a + b for a, b in zip(one.twist, other.twist, strict=True)]
    opening = _clipped(one.opening + other.opening)
    toggles, part = one.toggles + other.toggles, one.part + other.part
    return OperatorInput(clipped_twist(twist), opening, toggles, part=part)


def clipped_twist(values: Sequence[float]) -> Twist:
    """Six numbers, clipped to [-1, 1]."""
    x, y, z, a, b, c = (_clipped(value) for value in values)
    return x, y, z, a, b, c


def without_dead_zone(value: float) -> float:
    """Stick position with the dead zone removed: continuous from 0 at its edge to +-1."""
    size = (abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE)
    if not size > 0:  # NaN too
        return 0.0
    return math.copysign(min(size, 1.0), value)


def _clipped(value: float) -> float:
    return min(max(value, -1.0), 1.0)


class Speed(NamedTuple):
    """Speed at full deflection."""

    translation_m_s: float
    rotation_rad_s: float


def speeds_of(profile: Profile) -> tuple[Speed, ...]:
    """The levels within the profile's limits of velocity and of a single step, of every part."""
    every = [profile.of_part(name).limits for name in profile.parts] or [profile.limits]
    most_m_s = min(
        min(limits.translation.velocity_m_s, BELOW * limits.step_m / DT_S) for limits in every
    )
    most_rad_s = min(
        min(limits.rotation.velocity_rad_s, BELOW * limits.step_rad / DT_S) for limits in every
    )
    return tuple(Speed(min(v, most_m_s), min(w, most_rad_s)) for v, w in SPEEDS)


class TeleopPolicy:
    """A `Policy` whose chunks are the operator's input.

    A step is a delta of the goal in `frame` axes, with the rotation as a rotation vector, and the
    absolute width of the gripper. While the worker is not active the width is the measured one, or
    0 where an object is held, so that taking over drops nothing. Of a robot of parts one is moved
    at a time, and the others stand.
    """

    example_prompts = ("by hand",)

    def __init__(
        self,
        profile: Profile,
        name: str,
        read: Callable[[], OperatorInput],
        level: Callable[[], int],
        *,
        frame: Frame = "base",
    ) -> None:
        parts = {part: profile.of_part(part).robot for part in profile.part_names}
        actions = {
            part: ActionSpec(
                horizon=HORIZON,
                dt_s=DT_S,
                kind="delta",
                frame=frame,
                rotation="rotvec",
                gripper="none" if robot.gripper is None else "absolute_m",
            )
            for part, robot in parts.items()
        }
        self.spec = ModelSpec(
            name=PERSON,
            observation=ObservationSpec(cameras=(), state=("pose", "gripper"), prompt=False),
            action=ActionSpec.of_parts(actions) if profile.parts else actions[""],
        )
        self.speeds = speeds_of(profile)
        self.last = OperatorInput()
        self._name, self._read, self._level = name, read, level
        self._max_width_m = {part: robot.max_width_m for part, robot in parts.items()}
        self._parts = tuple(parts)
        self._width_m: dict[str, float] = {}

    def infer(self, observation: Observation) -> ActionSteps:
        """Steps until the next request is due, and a little longer.

        Raises:
            PeerError: the device is gone.
        """
        wanted, before = self._read(), self.last
        self.last = wanted
        active = observation.task.active and observation.task.worker == self._name
        if not active:
            self._width_m.clear()
        toggled = (wanted.toggles - before.toggles) % 2 == 1
        each = [
            self._steps(part, observation, wanted, toggled=toggled, active=active)
            if part == self._moved
            else self._steps(part, observation, OperatorInput(), toggled=False, active=active)
            for part in self._parts
        ]
        raw = {"twist": list(wanted.twist), "speed_m_s": self.speeds[self._level()].translation_m_s}
        return ActionSteps(np.concatenate(each, axis=1), raw=raw)

    @property
    def _moved(self) -> str:
        return self._parts[self.last.part % len(self._parts)]

    def _steps(
        self,
        part: str,
        observation: Observation,
        wanted: OperatorInput,
        *,
        toggled: bool,
        active: bool,
    ) -> FloatArray:
        """(H, 7) steps of one part; (H, 6) without a gripper."""
        gripper = observation.parts[part].gripper if part else observation.gripper
        assert gripper is not None
        opening, most_m = wanted.opening if active else 0.0, self._max_width_m[part]
        width_m = self._width_m.get(part, gripper.kept_width_m)
        if active and toggled:
            width_m = 0.0 if width_m > most_m / 2 else most_m
        period_s = 1 / observation.rate_hz
        count = min(math.ceil((period_s + COVER_S) / DT_S - 1e-9), HORIZON)
        speed = self.speeds[self._level()]
        motion = DT_S * np.concatenate(
            [
                speed.translation_m_s * _at_most_unit(wanted.twist[:3]),
                speed.rotation_rad_s * _at_most_unit(wanted.twist[3:]),
            ]
        )
        after_s = DT_S * np.arange(1, count + 1)
        widths_m = np.clip(width_m + opening * OPENING_M_S * after_s, 0.0, most_m)
        if active:
            moved_m = opening * OPENING_M_S * min(period_s, count * DT_S)
            self._width_m[part] = float(np.clip(width_m + moved_m, 0.0, most_m))
        steps = np.empty((count, AXES + 1))
        steps[:, :AXES], steps[:, AXES] = motion, widths_m
        return steps[:, :AXES] if math.isnan(most_m) else steps

    def describe(self) -> str:
        """Speed and input, for a status line."""
        speed = self.speeds[self._level()]
        moving = " ".join(
            f"{name}{value:+.1f}"
            for name, value in zip(AXIS_NAMES, self.last.twist, strict=True)
            if value
        )
        return (
            f"{100 * speed.translation_m_s:g} cm/s, {speed.rotation_rad_s:.2g} rad/s | "
            f"{f'{self._moved} ' if self._moved else ''}{moving or 'still'}"
        )


def _at_most_unit(direction: Sequence[float]) -> FloatArray:
    """`direction`, no longer than 1: two keys at once are not faster than one."""
    vector = np.array(direction)
    return vector / max(float(np.linalg.norm(vector)), 1.0)
