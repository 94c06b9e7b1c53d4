"""Findings on the answers of a model, and on the time and memory they took. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.policy_check import Finding, error
from vla_zenoh.errors import SpecError
from vla_zenoh.kinematics.so3 import angle_between, rotation_from_quat
from vla_zenoh.lab.check.examples import MAX_WIDTH_M, ExampleStyle
from vla_zenoh.lab.check.fit import note, warning
from vla_zenoh.policy import ActionSpec, ActionSteps, Observation, Policy, check_steps
from vla_zenoh.policy.meaning import ROTATION_FORMS, RotationForm
from vla_zenoh.types import FloatArray

GROWTH_KIB, GROWTH_TOTAL_KIB = 32.0, 4096.0
"""Growth per inference, and in all, above which it is a leak."""
ALIKE = 1e-7

Steps = NDArray[np.float32]
Answers = Sequence[tuple[ExampleStyle, Steps]]


def alike(a: Steps, b: Steps) -> bool:
    return a.shape == b.shape and bool(np.abs(a - b).max() <= ALIKE)


def growth(kib: Sequence[float]) -> tuple[float, list[Finding]]:
    """Growth of memory per inference, from that after each, and a finding if it is a leak."""
    third = len(kib) // 3
    # The first third may still fill caches.
    rest = np.array(kib[third:])
    each_kib = float(np.polyfit(np.arange(len(rest)), rest, 1)[0])
    steady = rest[-third:].min() > rest[:third].max()
    if steady and each_kib > GROWTH_KIB and each_kib * len(rest) > GROWTH_TOTAL_KIB:
        return each_kib, [error("memory_growth", f"every inference keeps {each_kib:.0f} KiB")]
    return each_kib, []


def slowness(
    action: ActionSpec, p50_s: float, p95_s: float, *, oldest_s: float, rate_hz: float | None
) -> list[Finding]:
    """Findings on the duration of an inference.

    Args:
        rate_hz: requested chunks per second; None: unknown.
    """
    found: list[Finding] = []
    if p50_s > oldest_s:
        why = f"an inference takes {p50_s:.3g} s; the command node rejects chunks whose "
        why += f"observation is older than {oldest_s:g} s (timing.max_observation_age_s)"
        found.append(error("too_slow", why))
    if p50_s > action.horizon * action.dt_s:
        # One step late is still the goal; of many late ones all but the last are lost.
        level = error if action.horizon > 1 else warning
        why = f"an inference takes {p50_s:.3g} s, its {action.horizon} steps of "
        found.append(level("slower_than_chunk", f"{why}{action.dt_s:g} s are over by then"))
    if rate_hz is not None and p95_s > 1.0 / rate_hz:
        why = f"an inference takes up to {p95_s:.3g} s (p95), it is asked for "
        found.append(warning("slower_than_rate", f"{why}{rate_hz:g} times a second"))
    return found


def behaviour(
    action: ActionSpec, answers: Answers, depends_on: Mapping[str, bool | None]
) -> list[Finding]:
    """Findings on what all answers have in common.

    Args:
        depends_on: pictures, colour order, prompt -> the answer depends on it; None: unknown.
    """
    found = [*_polarity(action, answers), *_rotation_form(action, answers)]
    # The first three numbers of every rotation, x, y, z of a quaternion too, are zero for none.
    size = action.arm_size if action.space == "joint" else 6
    moves = any(np.any(np.abs(steps[:, :size]) > ALIKE) for _, steps in answers)
    if action.kind != "absolute" and not moves:
        found.append(
            note("stands_still", "no example made it move; try --prompt with one it knows")
        )
    return found + [
        warning(f"ignores_{what.replace(' ', '_')}", f"the answer does not depend on the {what}")
        for what, matters in depends_on.items()
        if matters is False
    ]


def _opening(spec: ActionSpec, steps: Steps) -> NDArray[np.float64] | None:
    """Opening of the gripper at each step, 0 closed to 1 open; None: not given as a fraction."""
    if spec.gripper not in ("open_fraction", "binary"):
        return None
    value = steps[:, -1].astype(np.float64)
    if spec.gripper == "binary":
        return np.array([float(spec.opens(number)) for number in value])
    return value if spec.gripper_open_is_high else 1.0 - value


def _polarity(action: ActionSpec, answers: Answers) -> list[Finding]:
    """Every answer closes an open, empty gripper: probably the wrong polarity."""
    shares = [
        opening
        for style, steps in answers
        if style.width_m == MAX_WIDTH_M and (opening := _opening(action, steps)) is not None
    ]
    if not shares or float(np.concatenate(shares).max()) > 0.5:
        return []
    return [
        warning(
            "gripper_polarity",
            "every example with an open, empty gripper has it shut at once; is "
            f"gripper_open_is_high: {action.gripper_open_is_high} right?",
        )
    ]


FAR_RAD, SAME_RAD = 0.5, 0.2
"""Targets further turned from the tool than the first, and nearer than the second if their numbers
are read in another form."""


def _rotation_form(action: ActionSpec, answers: Answers) -> Iterator[Finding]:
    """Targets turn the tool far in some example, and in none if they are of another form."""
    for part in [each.part for each in action.parts] or [""]:
        own, columns = action.of(part), action.columns(part)
        if own.kind != "absolute" or own.space == "joint":
            continue
        numbers = [steps[0, columns][own.rotation_columns].tolist() for _, steps in answers]
        here = [rotation_from_quat(np.array(style.quat_xyzw)) for style, _ in answers]
        turns_rad = {
            name: _furthest_rad(form, numbers, here)
            for name, form in ROTATION_FORMS.items()
            if form.size == own.rotation_form.size
        }
        given_rad = turns_rad.pop(own.rotation)
        for name, other_rad in turns_rad.items():
            if given_rad > FAR_RAD and other_rad < SAME_RAD:
                why = f"the tool is to turn by up to {given_rad:.2f} rad at once, and would by "
                why += f"{other_rad:.2f} if its numbers are {name}; declared are {own.rotation}"
                names = ", ".join(own.rotation_form.names)
                yield error(own.rotation, f"{why} ({names})")


def _furthest_rad(
    form: RotationForm, numbers: Sequence[Sequence[float]], here: Sequence[FloatArray]
) -> float:
    """Largest angle from rotations (3, 3) to those that the numbers are in this form."""
    angles = [0.0]
    for written, rotation in zip(numbers, here, strict=True):
        try:
            quat_xyzw = np.array(form.decode(written))
        except SpecError:
            return math.inf
        angles.append(angle_between(rotation, rotation_from_quat(quat_xyzw)))
    return max(angles)


NEAR = 1e-3
"""Tolerance as a share of the largest number: a batch is summed in another order."""


def ask_batch(policy: Policy, observations: Sequence[Observation]) -> list[Any]:
    """Answers of ``infer_batch``, without committed steps."""
    infer_batch: Any = getattr(policy, "infer_batch", None)
    committed = getattr(policy, "takes_committed", False)
    extra = {"committed": [None] * len(observations)} if committed else {}
    return list(infer_batch(list(observations), **extra))


def batch_findings(action: ActionSpec, found: Sequence[Any], alone: Sequence[Any]) -> list[Finding]:
    """Findings on answers that differ between ``infer_batch`` and ``infer``.

    Args:
        found: answers of ``infer_batch``.
        alone: (H, D) of ``infer`` for the same observations, in their order.
    """
    if len(found) != len(alone):
        why = f"infer_batch gave {len(found)} answers to {len(alone)} observations"
        return [error("batch", why)]
    out: list[Finding] = []
    for number, (answer, wanted) in enumerate(zip(found, alone, strict=True), 1):
        steps = answer.steps if isinstance(answer, ActionSteps) else answer
        try:
            given: Steps = check_steps(action, steps)
        except SpecError as fault:
            out.append(error("batch", f"answer {number} of infer_batch: {fault}"))
            continue
        largest = max(float(np.abs(wanted).max()), 1e-6)
        if given.shape != wanted.shape or np.abs(given - wanted).max() > NEAR * largest:
            out.append(error("batch", f"answer {number} of infer_batch is not that of infer"))
    return out
