"""Whether the numbers of a chunk can be what their spec says they are.

Wrong units show by size: a step in millimetres or degrees is far over what an arm is allowed, and
what the command node takes for a mistake (`vla_zenoh.profile.REJECT_FACTOR` times a limit).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.finding import Finding, error, warning
from vla_zenoh.policy import ROTATION_SIZE, ActionSpec
from vla_zenoh.profile import REACH_M, REJECT_FACTOR, Limits
from vla_zenoh.types import QUATERNION_NORM_TOLERANCE

FRACTION_SLACK = 0.25
WIDTH_SLACK_M = 0.05
"""What the command node takes for rounding; see `vla_zenoh.control.actions`."""
BINARY_SPAN = 2.0
"""A number further than this from the threshold is no choice of two but another quantity."""
ROUNDING = 1e-6

Steps = NDArray[np.float32]


def findings(spec: ActionSpec, steps: Steps, limits: Limits, max_width_m: float) -> list[Finding]:
    """All that is not plausible in one chunk.

    Args:
        spec: what the numbers are said to mean.
        steps: (H, D), as `vla_zenoh.policy.check_steps` gives them.
        limits: of the robot.
        max_width_m: of its gripper.
    """
    return [
        *_position(spec, steps[:, :3].astype(np.float64) * spec.position_scale_m, limits),
        *_rotation(spec, steps[:, 3 : 3 + ROTATION_SIZE[spec.rotation]].astype(float), limits),
        *_gripper(spec, steps[:, -1].astype(np.float64), max_width_m),
    ]


def opening(spec: ActionSpec, steps: Steps) -> NDArray[np.float64] | None:
    """How far each step opens the gripper, 0 shut to 1 open; None where it does not say so."""
    if spec.gripper not in ("open_fraction", "binary"):
        return None
    value = steps[:, -1].astype(np.float64)
    if spec.gripper == "binary":
        value = (value > spec.gripper_threshold).astype(np.float64)
    return value if spec.gripper_open_is_high else 1.0 - value


def _position(
    spec: ActionSpec, position_m: NDArray[np.float64], limits: Limits
) -> Iterator[Finding]:
    longest_m = float(np.linalg.norm(position_m, axis=1).max())
    if spec.kind == "absolute":
        if longest_m > REACH_M:
            yield error(
                "position_units",
                f"a pose {longest_m:.4g} m from the base, no arm here reaches over {REACH_M:g} m; "
                "are these metres? position_scale_m is "
                f"{spec.position_scale_m:g}",
            )
            return
        box = limits.workspace
        low = np.array([box.x_m[0], box.y_m[0], box.z_m[0]])
        high = np.array([box.x_m[1], box.y_m[1], box.z_m[1]])
        outside_m = float(np.maximum(low - position_m, position_m - high).max())
        if outside_m > limits.step_m:
            yield warning(
                "workspace",
                f"a pose {outside_m:.3f} m outside the workspace x {box.x_m} y {box.y_m} "
                f"z {box.z_m}: is it in the base frame?",
            )
        return
    if longest_m > REJECT_FACTOR * limits.step_m:
        yield error(
            "position_units",
            f"a step of {longest_m:.4g} m, over {REJECT_FACTOR:g} times the limit of "
            f"{limits.step_m:g} m; are these metres, and was the output unnormalised? "
            f"position_scale_m is {spec.position_scale_m:g}",
        )
        return
    if longest_m > limits.step_m * (1 + ROUNDING):
        yield warning(
            "step_limit", f"a step of {longest_m:.4g} m, the limit is {limits.step_m:g} m"
        )
    yield from _speed("m/s", longest_m, spec.dt_s, limits.translation.velocity_m_s)


def _rotation(spec: ActionSpec, rotation: NDArray[np.float64], limits: Limits) -> Iterator[Finding]:
    if spec.rotation == "quaternion":
        yield from _quaternion(spec, rotation, limits)
        return
    largest = float(np.linalg.norm(rotation, axis=1).max())
    if spec.kind == "absolute":
        if float(np.abs(rotation).max()) > 2 * math.pi:
            yield error(
                "rotation_units",
                f"an angle of {float(np.abs(rotation).max()):.4g}, more than a turn; give radians",
            )
        return
    yield from _turn(largest, spec, limits)


def _turn(largest_rad: float, spec: ActionSpec, limits: Limits) -> Iterator[Finding]:
    if largest_rad > REJECT_FACTOR * limits.step_rad:
        yield error(
            "rotation_units",
            f"a step of {largest_rad:.4g} rad, over {REJECT_FACTOR:g} times the limit of "
            f"{limits.step_rad:g} rad; are these radians, and was the output unnormalised?",
        )
        return
    if largest_rad > limits.step_rad * (1 + ROUNDING):
        yield warning(
            "step_limit", f"a step of {largest_rad:.4g} rad, the limit is {limits.step_rad:g} rad"
        )
    yield from _speed("rad/s", largest_rad, spec.dt_s, limits.rotation.velocity_rad_s)


def _speed(unit: str, step: float, dt_s: float, limit: float) -> Iterator[Finding]:
    if step / dt_s > limit * (1 + 1e-3):
        yield warning(
            "speed_limit",
            f"a step of {step:.4g} in {dt_s:g} s is {step / dt_s:.3g} {unit}, the limit is "
            f"{limit:g}: the arm will come later than asked",
        )


def _quaternion(
    spec: ActionSpec, rotation: NDArray[np.float64], limits: Limits
) -> Iterator[Finding]:
    norms = np.linalg.norm(rotation, axis=1)
    worst = float(norms[np.argmax(np.abs(norms - 1.0))])
    if abs(worst - 1.0) > QUATERNION_NORM_TOLERANCE:
        yield error("quaternion", f"a quaternion of norm {worst:.4g}, wanted 1")
        return
    if spec.kind == "absolute":
        return
    turns = 2 * np.arccos(np.clip(np.abs(rotation[:, 3]), 0.0, 1.0))
    swapped = 2 * np.arccos(np.clip(np.abs(rotation[:, 0]), 0.0, 1.0))
    largest = float(turns.max())
    if largest > REJECT_FACTOR * limits.step_rad >= float(swapped.max()):
        yield error(
            "quaternion",
            f"a step of {largest:.4g} rad, which would be {float(swapped.max()):.4g} rad read as "
            "w, x, y, z; the order is x, y, z, w",
        )
        return
    yield from _turn(largest, spec, limits)


def _gripper(spec: ActionSpec, value: NDArray[np.float64], max_width_m: float) -> Iterator[Finding]:
    bounds = {
        "delta_m": (-max_width_m - WIDTH_SLACK_M, max_width_m + WIDTH_SLACK_M),
        "absolute_m": (-0.01, max_width_m + WIDTH_SLACK_M),
        "open_fraction": (-FRACTION_SLACK, 1.0 + FRACTION_SLACK),
        "binary": (spec.gripper_threshold - BINARY_SPAN, spec.gripper_threshold + BINARY_SPAN),
    }
    if spec.gripper not in bounds:
        return
    low, high = bounds[spec.gripper]
    # A choice of two is one whatever the numbers; the others the command node would refuse.
    level = warning if spec.gripper == "binary" else error
    for found in (float(value.min()), float(value.max())):
        if not low <= found <= high:
            yield level(
                "gripper_range",
                f"gripper {found:.4g}, declared as {spec.gripper}: at most {low:.3g} to "
                f"{high:.3g} (this gripper opens to {max_width_m:g} m)",
            )
            return
