"""Where an arm may work, and a home for it: away from singularities, from itself and the table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.reachability import Barriers
from vla_zenoh.kinematics.kinematics import InverseKinematics, Kinematics, smallest_singular_value
from vla_zenoh.kinematics.so3 import Pose, exp3
from vla_zenoh.lab.profile.robot_check import singularity_limits
from vla_zenoh.profile import POSE_JOINTS, ReachLimits
from vla_zenoh.profile.limits import REACH_M
from vla_zenoh.simulation.robot_model import MIN_TOOL_M
from vla_zenoh.types import FloatArray

SAMPLES = 1000
BEST = 150
"""Samples of which distances are computed, the best first."""
TURNED = 40
"""Of those, of which it is tried whether the tool can point down there."""
DOWN = 0.98
"""Cosine of the angle to straight down within which a tool counts as pointing there."""
INNER = 0.75
"""Part of each joint's range, about its middle, in which a home lies."""
OVERLAPS, OVERLAP_SHARE = 4, 0.9
"""Pairs of links that may touch, at most, less one; the share of samples in which they overlap."""
WAY_M = 0.08
"""A home has this way up and down."""
ABOVE_TABLE = 0.2
"""Height of the TCP at home over the table, as a share of the reach."""
REACH_SHARE = 0.95
"""Share of the samples that a workspace holds along each axis."""
ABOVE_M = 0.012
"""A workspace begins this far above the table."""
MARGIN_M = 0.1
"""Of a workspace around home, at least."""
FARTHEST_RAD = 3.0
"""Ranges beyond this, and joints without an end, are looked at up to here: half a turn has every
direction."""

SMALL_ARM_M = 0.45
"""A shorter arm has distances of its own: its links are smaller."""

Span = tuple[float, float]


class Posture(NamedTuple):
    """A home and a workspace.

    Args:
        home_rad: in the order of the arm's joints.
        workspace_m: x, y and z.
        reach_m: of the TCP from the base, horizontally.
        free: the arm at home is near nothing; else `home_rad` is the best there is.
        may_touch: links whose shapes overlap almost wherever the arm is.
    """

    home_rad: tuple[float, ...]
    workspace_m: tuple[Span, Span, Span]
    reach_m: float
    free: bool
    may_touch: tuple[tuple[str, str], ...] = ()


def _size(length_m: float) -> float:
    """How small an arm of this length is; 1: it is not."""
    return min(length_m / SMALL_ARM_M, 1.0)


def limits_of_size(kinematics: Kinematics) -> dict[str, float]:
    """Limits of `ReachLimits` by the size of the arm, where the usual ones are too large."""
    usual, share = ReachLimits(), _size(kinematics.length_m)
    found: dict[str, float] = {}
    if (singularities := singularity_limits(kinematics, usual)) is not None:
        _, found["singularity_slow"], found["singularity_stop"] = singularities
    if share < 1.0:
        for name in ("collision_slow_m", "collision_stop_m"):
            found[name] = float(f"{share * getattr(usual, name):.1g}")
    return found


def posture(kinematics: Kinematics, reach: ReachLimits, home_rad: Sequence[float]) -> Posture:
    """A home of an arm and its workspace, as guesses; a given `home_rad`, if not empty, is kept.

    Raises:
        ResourceError: the shapes of its description cannot be loaded.
    """
    random = np.random.default_rng(0)  # the same profile every time
    low = np.maximum(kinematics.lower_rad, -FARTHEST_RAD)
    high = np.minimum(kinematics.upper_rad, FARTHEST_RAD)
    middle, half = (low + high) / 2, (high - low) / 2
    shares = random.uniform(-1.0, 1.0, (SAMPLES, kinematics.size))
    places_m = np.array([kinematics.forward(middle + half * each).position_m for each in shares])
    table_m = reach.table_z_m if reach.table_z_m is not None else float(places_m[:, 2].min())
    reach_m = float(np.quantile(np.linalg.norm(places_m[:, :2], axis=1), REACH_SHARE))
    free, touching = True, ()
    if home_rad:
        home = np.array(home_rad, float)
    else:
        within = middle - INNER * half, middle + INNER * half
        inner = middle + INNER * half * shares
        home, free, touching = _home(kinematics, reach, inner, within, table_m, reach_m)
    at_m = kinematics.forward(home).position_m
    margin_m = MARGIN_M * _size(kinematics.length_m)
    edges = np.quantile(places_m, (1 - REACH_SHARE, REACH_SHARE), axis=0)
    lower = np.minimum(np.floor(edges[0] * 20) / 20, at_m - margin_m)
    upper = np.maximum(np.ceil(edges[1] * 20) / 20, at_m + margin_m)
    lower, upper = np.maximum(lower, -REACH_M), np.minimum(upper, REACH_M)
    if reach.table_z_m is not None:
        lower[2] = min(max(lower[2], table_m + ABOVE_M), float(at_m[2]) - ABOVE_M)
    x, y, z = zip(np.round(lower, 3).tolist(), np.round(upper, 3).tolist(), strict=True)
    return Posture(tuple(home.tolist()), (x, y, z), reach_m, free, touching)


def _home(
    kinematics: Kinematics,
    reach: ReachLimits,
    samples_rad: FloatArray,
    within_rad: tuple[FloatArray, FloatArray],
    table_m: float,
    reach_m: float,
) -> tuple[FloatArray, bool, tuple[tuple[str, str], ...]]:
    """The best of the samples that is near nothing; whether there is one; links that may touch."""
    scores = np.array([_score(kinematics, each, table_m, reach_m) for each in samples_rad])
    homes = np.round(samples_rad[np.argsort(-scores)[:BEST]], 2)
    turned = [found for home in homes[:TURNED] if (found := _turned_down(kinematics, home))]
    # One at the end of a joint's range has no way up.
    low, high = within_rad
    down = [home for home in turned if np.all((low < home) & (home < high))]
    down.sort(key=lambda home: -_score(kinematics, np.array(home), table_m, reach_m))
    homes = np.array([*down, *homes.tolist()])
    touching: tuple[tuple[str, str], ...] = ()
    for _ in range(OVERLAPS):
        allowed = reach.model_copy(update={"may_touch": touching})
        barriers = Barriers(kinematics, allowed, homes[0])
        for home in homes:
            if _is_free(kinematics, barriers, home):
                return home, True, touching
        overlap = _overlap(kinematics, barriers, homes)
        if overlap is None:
            break
        touching = (*touching, overlap)
    return homes[len(down)], False, ()  # the best as it is: turned down it may be lower


def _overlap(
    kinematics: Kinematics, barriers: Barriers, homes: FloatArray
) -> tuple[str, str] | None:
    """The two links whose shapes overlap at almost all of these homes; None: there are none."""
    left = [barriers.at(home, kinematics.jacobian(home))[1:] for home in homes]
    shares = np.mean(np.array(left) < 0.0, axis=0)
    for index in np.argsort(-shares):
        pair = barriers.collisions.pairs[index]
        if shares[index] < OVERLAP_SHARE:
            return None
        if pair.limit == "self_collision":
            return pair.first, pair.second
    return None


def _score(kinematics: Kinematics, joints_rad: FloatArray, table_m: float, reach_m: float) -> float:
    """How good a home is: nimble, in front of the base, at some height, the tool not upwards."""
    here, jacobian = kinematics.pose_and_jacobian(joints_rad)
    # Metres and radians alike, as the limits count; a small arm is as nimble as a large one.
    scaled = jacobian.copy()
    scaled[:3] /= max(reach_m, 0.1)
    x_m, y_m, z_m = (here.position_m / max(reach_m, 0.1)).tolist()
    height = z_m - table_m / max(reach_m, 0.1)
    up = float(tool_axis(kinematics, here.rotation)[2])
    score = 4.0 * min(smallest_singular_value(scaled), 0.3)
    score -= abs(x_m - 0.6) + abs(y_m) + 2.0 * max(0.0, ABOVE_TABLE - height)
    score -= max(0.0, height - 0.6)
    return score - 0.5 * up


def tool_axis(kinematics: Kinematics, rotation: FloatArray) -> FloatArray:
    """(3,) where the tool points, from the last joint to the TCP; of a tool of no length along z.

    Args:
        rotation: of the TCP.
    """
    length_m = float(np.linalg.norm(kinematics.tool_m))
    own = kinematics.tool_m / length_m if length_m > MIN_TOOL_M else np.array([0.0, 0.0, 1.0])
    return rotation @ own


def points_down(axis: FloatArray) -> bool:
    """Whether a tool along `axis` points down."""
    return float(axis[2]) < -DOWN


def _turned_down(kinematics: Kinematics, home_rad: FloatArray) -> tuple[float, ...]:
    """The same home with the tool turned down on the shortest way; empty: it cannot."""
    here = kinematics.forward(home_rad)
    axis = tool_axis(kinematics, here.rotation)
    across = np.cross(axis, [0.0, 0.0, -1.0])
    sine = float(np.linalg.norm(across))
    if sine < 1e-6:
        return tuple(home_rad.tolist()) if points_down(axis) else ()
    turn = exp3(across / sine * float(np.arctan2(sine, -axis[2])))
    goal = Pose(here.position_m, turn @ here.rotation)
    joints_rad = InverseKinematics(kinematics, home_rad).approach(goal, home_rad).joints_rad
    reached = kinematics.forward(joints_rad).rotation
    return (
        tuple(np.round(joints_rad, 2).tolist())
        if points_down(tool_axis(kinematics, reached))
        else ()
    )


def _is_free(kinematics: Kinematics, barriers: Barriers, home_rad: FloatArray) -> bool:
    """Whether home and the ways up and down from it are in no zone of a barrier."""
    solver = InverseKinematics(kinematics, home_rad)
    here = kinematics.forward(home_rad)
    least = 0.5 * barriers.zone
    if np.any(barriers.at(home_rad, kinematics.jacobian(home_rad)) < barriers.zone):
        return False
    up_m = WAY_M * _size(kinematics.length_m)
    for way_m in (up_m, -up_m):
        goal = Pose(here.position_m + np.array([0.0, 0.0, way_m]), here.rotation)
        found = solver.approach(goal, home_rad)
        far = kinematics.size >= POSE_JOINTS and not found.solved
        if far or np.any(barriers.at(found.joints_rad, found.jacobian) < least):
            return False
    return True
