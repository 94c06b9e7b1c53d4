"""The person as a model: wishes become chunks, so that everything behind them stays the same."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from vla_zenoh.policy import ActionSpec, ActionSteps, Frame, ModelSpec, Observation, ObservationSpec
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, GripperState

DT_S = 0.05
HORIZON = 20
"""Steps at most: whoever asks for less than a chunk a second gets an arm that holds in between."""
COVER_S = 0.1
"""A chunk lasts so much longer than the period of the asked rate, for the next one's delay."""
SPEEDS = ((0.01, 0.05), (0.03, 0.15), (0.06, 0.3), (0.12, 0.6), (0.2, 1.0))
"""Levels: m/s and rad/s; the profile's limits cut them off."""
OPENING_M_S = 0.04
BELOW = 1 - 1e-6
"""Steps travel as float32, and rounding must not put one beyond the limit."""


class Speed(NamedTuple):
    """What a stick at its end means."""

    translation_m_s: float
    rotation_rad_s: float


def speeds_of(profile: Profile) -> tuple[Speed, ...]:
    """The levels within the profile's limits: of velocity, and of a single step."""
    limits = profile.limits
    most_m_s = min(limits.translation.velocity_m_s, BELOW * limits.step_m / DT_S)
    most_rad_s = min(limits.rotation.velocity_rad_s, BELOW * limits.step_rad / DT_S)
    return tuple(Speed(min(v, most_m_s), min(w, most_rad_s)) for v, w in SPEEDS)


class TeleopPolicy:
    """A worker's model whose answers come from a person.

    A step is a delta of the goal in `frame` axes with the rotation as a rotation vector, and the
    absolute width of the gripper. While it is not obeyed the width is the measured one (shut, where
    something is held), so that nothing is dropped when it takes over.

    Args:
        profile: for its limits and gripper.
        name: of the worker.
        wish: what is wanted; called once for each chunk.
        level: index of the chosen speed.
        frame: axes of a step.
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
        self.spec = ModelSpec(
            name="teleop",
            observation=ObservationSpec(cameras=(), state=("pose", "gripper"), prompt=False),
            action=ActionSpec(
                horizon=HORIZON,
                dt_s=DT_S,
                kind="delta",
                frame=frame,
                rotation="rotvec",
                gripper="absolute_m",
            ),
        )
        self.speeds = speeds_of(profile)
        self.last = OperatorInput()
        self._name, self._wish, self._level = name, read, level
        self._most_m = profile.robot.gripper.max_width_m
        self._wanted_m: float | None = None

    def infer(self, observation: Observation) -> ActionSteps:
        """The steps that are wanted until the next request is due, and a little longer.

        Raises:
            PeerError: the device is gone.
        """
        wanted, before = self._wish(), self.last
        self.last = wanted
        gripper = observation.gripper
        assert gripper is not None
        obeyed = observation.task.active and observation.task.worker == self._name
        if not obeyed:  # what the gripper keys say now is meant for nobody
            wanted, self._wanted_m = wanted._replace(opening=0.0), None
        width_m = _kept(gripper) if self._wanted_m is None else self._wanted_m
        if obeyed and (wanted.toggles - before.toggles) % 2:
            width_m = 0.0 if width_m > self._most_m / 2 else self._most_m
        period_s = 1 / observation.rate_hz
        count = min(math.ceil((period_s + COVER_S) / DT_S - 1e-9), HORIZON)
        speed = self.speeds[self._level()]
        motion = DT_S * np.concatenate(
            [
                speed.translation_m_s * _unit(wanted.twist[:3]),
                speed.rotation_rad_s * _unit(wanted.twist[3:]),
            ]
        )
        after_s = DT_S * np.arange(1, count + 1)
        widths = np.clip(width_m + wanted.opening * OPENING_M_S * after_s, 0.0, self._most_m)
        steps = np.column_stack([np.tile(motion, (count, 1)), widths])
        if obeyed:
            moved_m = wanted.opening * OPENING_M_S * min(period_s, count * DT_S)
            self._wanted_m = float(np.clip(width_m + moved_m, 0.0, self._most_m))
        raw = {"twist": list(wanted.twist), "speed_m_s": speed.translation_m_s}
        return ActionSteps(steps, raw=raw)


def _unit(direction: Sequence[float]) -> FloatArray:
    """`direction`, no longer than 1: two keys at once are not faster than one."""
    vector = np.array(direction)
    return vector / max(float(np.linalg.norm(vector)), 1.0)


def _kept(gripper: GripperState) -> float:
    return 0.0 if gripper.holding else max(gripper.width_m, 0.0)


AXES = 6
Twist = tuple[float, float, float, float, float, float]
STILL: Twist = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
DEAD_ZONE = 0.08
"""A stick that is let go rests this near to its middle."""


class OperatorInput(NamedTuple):
    """One look at the controls.

    Args:
        twist: x, y, z and the rotation about them, each a share of the chosen speed in [-1, 1].
        opening: the gripper wider (1) or narrower (-1), likewise.
        toggles: how often so far the gripper was told to open or close; only changes count.
    """

    twist: Twist = STILL
    opening: float = 0.0
    toggles: int = 0


class InputDevice(Protocol):
    """A device with sticks beside the keyboard.

    Attributes:
        name: as the device calls itself.
    """

    name: str

    def read(self) -> OperatorInput:
        """Current input.

        Raises:
            PeerError: the device is gone.
        """
        ...

    def close(self) -> None:
        """Release the device."""
        ...


def combined(one: OperatorInput, other: OperatorInput) -> OperatorInput:
    """Both at once, no axis beyond its end."""
    twist = [_clipped(a + b) for a, b in zip(one.twist, other.twist, strict=True)]
    opening = _clipped(one.opening + other.opening)
    return OperatorInput(clipped_twist(twist), opening, one.toggles + other.toggles)


def clipped_twist(values: Sequence[float]) -> Twist:
    """Six numbers in [-1, 1]; what is more is cut off."""
    x, y, z, a, b, c = (_clipped(value) for value in values)
    return x, y, z, a, b, c


def without_dead_zone(value: float) -> float:
    """A stick's position without its dead zone: steady from 0 at the zone's edge to +-1."""
    size = (abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE)
    if not size > 0:  # NaN too
        return 0.0
    return min(size, 1.0) * (1.0 if value > 0 else -1.0)


def _clipped(value: float) -> float:
    return min(max(value, -1.0), 1.0)
