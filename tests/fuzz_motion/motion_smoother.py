"""The smoother by itself: retargeted in motion, with rounding noise on what stands.

Many more states than a whole command node gets into in the same time.
"""

from __future__ import annotations

import random
import zlib
from typing import NamedTuple

import numpy as np
from motion_case import DOWN, START_M
from motion_judge import (
    JERK_RTOL,
    LIMIT_RTOL,
    WANDER_M,
    WANDER_RAD,
    Array,
    Violation,
    ends_of,
    log_of,
    norms,
    unreversed,
)

from vla_zenoh.control.limits import ROTATION_BOX, MotionLimits, Shares
from vla_zenoh.control.smoothing import Motion, Smoother
from vla_zenoh.kinematics.so3 import Pose, exp3

SHIPPED = MotionLimits((0.5, 2.0, 20.0), (1.5, 6.0, 60.0))
LIMITS = (
    *(SHIPPED, SHIPPED, SHIPPED),
    MotionLimits((1.7, 13.0, 6500.0), (2.5, 25.0, 12500.0)),
    MotionLimits((0.005, 2.0, 20.0), (0.05, 6.0, 60.0)),
    MotionLimits((0.5, 0.05, 20.0), (1.5, 0.2, 60.0)),
)
DT_S = (0.004, 0.004, 0.004, 0.001, 0.02)
NOISE = (0.0, 1e-17, 1e-16, 1e-15, 1e-14, 1e-13, 1e-12)
SHAPES = ("axis", "plane", "line", "turn", "any", "any")
MOST_TICKS = 4000
REACHED = 1e-6
AGAIN = 6
"""An arm that stands is told its target so often once more."""
Found = tuple[str, float, str, str]


def run_smoother(seed: int, ticks: int) -> tuple[int, list[Violation]]:
    """So many ticks of cases, and what did not hold in them; `Violation.tick` is the case."""
    found: dict[str, Violation] = {}
    done = case = 0
    while done < ticks:
        rng = random.Random(zlib.crc32(f"smoother {seed} {case}".encode()))
        made, bad = _case(rng)
        done += made
        for name, size, unit, note in bad:
            known = found.get(name)
            count = 1 + (known.count if known else 0)
            if known is None or size > known.size:
                found[name] = Violation(name, case, size, unit, count, note)
            else:
                found[name] = known._replace(count=count)
        case += 1
    return done, list(found.values())


def _case(rng: random.Random) -> tuple[int, list[Found]]:
    limits, dt_s, noise = rng.choice(LIMITS), rng.choice(DT_S), rng.choice(NOISE)
    shape = rng.choice(SHAPES)
    start = Pose(START_M, exp3(_vector(rng)) @ DOWN)
    box = np.array(
        [[t] * 3 + [r * ROTATION_BOX] * 3 for t, r in zip(*limits, strict=True)], dtype=np.float64
    )
    smoother = Smoother(start, dt_s, limits)
    failures = smoother.failures
    # Ways are about as long as the arm needs some tenths of a second for.
    way_m = min(0.15, 0.4 * limits.translation[0], 0.1 * limits.translation[1])
    way_rad = min(0.5, 0.4 * limits.rotation[0], 0.1 * limits.rotation[1])
    direction, about = _unit(rng), _unit(rng)
    motions: list[Motion] = [smoother.motion]
    begins: list[int] = []
    targets: list[Pose] = []
    # As of an arm whose joints are slower than its pose may be.
    shared = rng.random() < 0.3
    parts: list[Shares] = []
    turns = rng.randint(2, 7)
    again = 0
    for turn in range(turns + AGAIN):
        ways, turned = np.zeros(3), np.zeros(3)
        size_m, size_rad = rng.uniform(-1, 1) * way_m, rng.uniform(-1, 1) * way_rad
        if shape == "axis":
            ways[rng.randrange(3)] = size_m
        elif shape == "plane":
            ways[:2] = [size_m, rng.uniform(-1, 1) * way_m]
            if rng.random() < 0.5:
                turned[:2] = [size_rad, rng.uniform(-1, 1) * way_rad]
        elif shape == "line":
            ways = size_m * direction
        elif shape == "turn":
            turned = size_rad * about
        else:
            ways, turned = _vector(rng) * way_m, _vector(rng) * way_rad
        shaken = noise * _vector(rng)
        target = Pose(start.position_m + ways + shaken, exp3(turned + shaken) @ start.rotation)
        again = max(again - 1, 0)
        if turn >= turns and not again:
            break
        if again or (targets and rng.random() < 0.15):  # once more, where it may stand already
            target = Pose(targets[-1].position_m + shaken, targets[-1].rotation)
        begins.append(len(motions))
        targets.append(target)
        many = (rng.choice([0.1, 0.5, 1.0]), rng.choice([0.4, 1.0]), rng.choice([0.3, 1.0]))
        parts.append(Shares(*many) if shared else Shares())
        smoother.target(target, parts[-1])
        to_rest = not again and (turn == turns - 1 or rng.random() < 0.15)
        ticks = rng.choice([1, 2, 5] if again else [1, 3, 10, 30, 60])
        for _ in range(MOST_TICKS if to_rest else ticks):
            motions.append(smoother.tick())
            if to_rest and smoother.at_rest:
                again = rng.choice([0, AGAIN])
                break
    way = _Way(motions, begins, targets, parts, box, dt_s, shape)
    return len(motions), way.judged(smoother.failures - failures)


class _Way(NamedTuple):
    """A case that was carried out.

    Args:
        motions: every tick, the first one before it.
        begins: index of the first motion of each target.
        targets: in turn.
        parts: of the limits each had.
        box: (3, 6) limits of every axis.
        dt_s: of a tick.
        shape: what kind of targets.
    """

    motions: list[Motion]
    begins: list[int]
    targets: list[Pose]
    parts: list[Shares]
    box: Array
    dt_s: float
    shape: str

    def judged(self, failures: int) -> list[Found]:
        """What did not hold: name, size, unit, shape."""
        motions, begins, targets, parts, box, dt_s, shape = self
        if any(min(part) < 1.0 for part in parts):
            shape += ", with parts of the limits"
        bad: list[Found] = []
        if failures:
            bad.append(("smoother finds no trajectory", 1.0, "", shape))
        place = np.array([m.pose.position_m for m in motions])
        rotation = np.array([m.pose.rotation for m in motions])
        twist = np.array([m.twist for m in motions])
        change = np.array([m.acceleration for m in motions])
        if not np.isfinite(place).all() or not np.isfinite(rotation).all():
            return [*bad, ("smoother gives NaN", 1.0, "", shape)]
        whole = box.copy()
        whole[:, 3:] /= ROTATION_BOX
        jerk = np.diff(change, axis=0) / dt_s
        for name, values, limit, rtol in (
            ("velocity", twist, whole[0], LIMIT_RTOL),
            ("acceleration", change, whole[1], LIMIT_RTOL),
            ("jerk", jerk, whole[2], JERK_RTOL),
        ):
            share = max(
                float((np.abs(values[:, :3]) / limit[:3]).max()),
                float((norms(values[:, 3:])[:, 0] / limit[3]).max()),
            )
            if share > 1 + rtol:
                bad.append((f"smoother {name}", share, "x limit", shape))
        # Each way from its target on: in the axes of the rotation it began at.
        at = np.array(begins) - 1
        body = rotation[at].transpose(0, 2, 1)
        v, a = (
            np.hstack([part[at, :3], np.einsum("nij,nj->ni", body, part[at, 3:])])
            for part in (twist, change)
        )
        wanted = np.array([target.position_m for target in targets])
        turned = log_of(np.einsum("nij,njk->nik", body, np.array([t.rotation for t in targets])))
        ahead = np.hstack([wanted - place[at], turned])
        low, high = ends_of(v, a, ahead, box)
        if any(min(part) < 1.0 for part in parts):
            # With less of them it may go as far as a brake would with that much, and with what
            # jerk it takes where an axis would get too fast, or turn round.
            for n, part in enumerate(parts):
                one = slice(n, n + 1)
                moved, scaled = (v[one], a[one], ahead[one]), box * np.array(part)[:, None]
                whole_jerk = np.full((1, 6), 1.0 / part.jerk)
                for more in (None, unreversed(*moved[:2], scaled, box), whole_jerk):
                    down, up = ends_of(*moved, scaled, more)
                    low[one], high[one] = np.minimum(low[one], down), np.maximum(high[one], up)
        beyond = np.zeros(6)
        for n, begin in enumerate(begins):
            end = begins[n + 1] if n + 1 < len(begins) else len(motions)
            moved = np.hstack(
                [place[begin:end] - place[at[n]], log_of(body[n] @ rotation[begin:end])]
            )
            over = np.maximum(low[n] - moved, moved - high[n]).max(axis=0)
            beyond = np.maximum(beyond, over)
        for name, over, limit, unit in (
            ("way", float(beyond[:3].max()), WANDER_M, "mm"),
            ("turn", float(beyond[3:].max()), WANDER_RAD, "mrad"),
        ):
            if over > limit:
                bad.append((f"smoother: a {name} leaves its ends", over * 1e3, unit, shape))
        if self.shape in ("line", "turn"):
            straight = self.shape == "line"
            apart = place - place[0] if straight else log_of(rotation @ rotation[0].T)
            along = apart[np.abs(apart).sum(axis=1).argmax()]
            along = along / max(float(np.linalg.norm(along)), 1e-12)
            off = float(norms(apart - (apart @ along)[:, None] * along).max())
            if off > (WANDER_M if straight else WANDER_RAD):
                what = "a straight motion leaves its line" if straight else "a turn leaves its axis"
                what += " as its limits shrink" if shape != self.shape else ""
                bad.append((f"smoother: {what}", off * 1e3, "mm" if straight else "mrad", shape))
        left = max(
            float(np.abs(place[-1] - wanted[-1]).max()),
            float(norms(log_of((rotation[-1].T @ targets[-1].rotation)[None]))[0, 0]),
        )
        if left > REACHED and len(motions) - begins[-1] < MOST_TICKS:
            bad.append(("smoother does not arrive", left, "m or rad", shape))
        return bad


def _vector(rng: random.Random) -> Array:
    return np.array([rng.uniform(-1.0, 1.0) for _ in range(3)])


def _unit(rng: random.Random) -> Array:
    way = np.array([rng.gauss(0.0, 1.0) for _ in range(3)])
    return way / np.linalg.norm(way)
