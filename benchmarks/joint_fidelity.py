"""Whether the joints of an arm execute what a policy asks of them: asked against reached joints.

    python -m benchmarks.joint_fidelity [-n 50] [--seed 1] [--only TEXT] [--perfect] [--json]

In lockstep, a policy follows paths that are known in advance, in chunks of 8 steps of 0.1 s, five
times a second; an inference takes 25 to 75 ms. It gives each path in up to three ways:

- ``joints``: joint positions, which the arm follows as such;
- ``poses``: the TCP poses of those positions, by forward kinematics, for ``robot.command: joint``;
- ``poses*``: the same for ``robot.command: pose``.

Paths of the Panda: its elbow swivels and the TCP rests; its joints pass a singularity of the wrist;
N smooth ones at random. Paths of the SO-101: N / 2 minimum-jerk motions of 1.5 s and as many of
2.5 s, at random. No bound is near any of them. Figures of a path:

- rest: asked less measured, of the worst joint and of the TCP, 2 s after the end;
- late: the delay with which the measured joints follow best; motion: the worst joint at any time,
  at the time it was asked for; left: but for that delay, of the worst joint and of the TCP;
- stuck: at rest further than 10 mrad from the end.

Then a policy asks the Panda for steps as DROID's do, 8 of them 15 times a second, each on the one
before, for 3 s in N / 10 directions: the share of the asked displacement that is reached.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays

from benchmarks.lockstep_arm import LOOK_S, activated, in_processes
from vla_zenoh.control.limits import chain_motion_limits, workspace_corners
from vla_zenoh.control.reachability import Barriers, ReachabilityFilter
from vla_zenoh.kinematics.kinematics import Kinematics, pose_error, smallest_singular_value
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.types import FloatArray

PANDA, SO101 = "panda_sim", "so101_sim"
WAYS = {"joints": "joint", "poses": "joint", "poses*": "pose"}
"""How a policy gives a path -> ``robot.command``."""
RATE_HZ, HORIZON, DT_S = 5.0, 8, 0.1
DELAYS = Delays(inference_s=0.05, jitter=0.5, camera_s=0.015, wire_s=0.0005)
SETTLE_S, SAMPLE_S, MOST_LATE_S = 1.5, 0.01, 0.6
STUCK_MRAD = 10.0

SWIVEL_RAD, SWIVEL_S = 0.9, 4.0
WRIST_RAD = np.array([0.0, -0.4, 0.2, -2.475, -np.pi / 2, 3.34, 1.588])
"""At this angle of its fifth joint the Panda's wrist is singular at one angle of the sixth."""
ASIDE_RAD = np.array([0.2, 0.1, -0.2, 0.1, 0.5, -0.25, 0.3])
"""From there to either end of the path."""
WRIST_S = 3.0
SPREAD_RAD = {PANDA: 0.4, SO101: 0.7}
WOBBLE_RAD, TURNS = 0.08, 2.0
SHARE = 0.8
"""Part of the joints' limits that a random path may need."""
CLEAR_M, CLEAR_RAD = 0.03, 0.1
"""Of the workspace box and the ends of the joints' ranges."""
MOMENTS = 401

DROID_HZ, DROID_STEPS, DROID_S, DROID_RAD_S = 15.0, 8, 3.0, 0.2
DROID_RATES_HZ = (2.0, 5.0, 15.0)


class Case(NamedTuple):
    """One path, or one direction of steps.

    Args:
        name: which kind.
        profile: of the arm.
        way: of `WAYS`.
        seed: of all random numbers.
        duration_s: of the path; of steps: the rate in Hz.
    """

    name: str
    profile: str
    way: str
    seed: int
    duration_s: float = 0.0


def all_cases(n: int, seed: int) -> list[Case]:
    """The whole table."""
    single = [Case(name, PANDA, way, seed) for name in ("swivel", "wrist") for way in WAYS]
    panda = [Case("random", PANDA, way, seed + i) for way in WAYS for i in range(n)]
    so101 = [
        Case(f"random {duration_s:g} s", SO101, "joints", seed + i, duration_s)
        for duration_s in (1.5, 2.5)
        for i in range(max(n // 2, 1))
    ]
    steps = [
        Case(f"steps, {rate_hz:g} Hz", PANDA, "steps", seed + i, rate_hz)
        for rate_hz in DROID_RATES_HZ
        for i in range(max(n // 10, 1))
    ]
    return [*single, *panda, *so101, Case("random 1.5 s", SO101, "poses", seed, 1.5), *steps]


class Track(NamedTuple):
    """Joints over time, which rest at both ends.

    Args:
        rows_rad: (`MOMENTS`, n) in chain order, evenly spaced in time.
        duration_s: from first to last.
    """

    rows_rad: FloatArray
    duration_s: float

    def at(self, time_s: ArrayLike) -> FloatArray:
        """(m, n) joints at the times (m,)."""
        place = np.clip(np.asarray(time_s, float) / self.duration_s, 0.0, 1.0) * (
            len(self.rows_rad) - 1
        )
        row = np.minimum(place.astype(int), len(self.rows_rad) - 2)
        share = (place - row)[:, None]
        return (1 - share) * self.rows_rad[row] + share * self.rows_rad[row + 1]


class Arm(NamedTuple):
    """An arm and its bounds."""

    profile: Profile
    kinematics: Kinematics
    barriers: Barriers
    home_rad: FloatArray


def arm_of(profile_name: str, command: str) -> Arm:
    """The arm of a profile, commanded by joints or poses."""
    profile = override(load_profile(profile_name), {"robot": {"command": command}})
    reach = ReachabilityFilter(profile)
    home_rad = reach.kinematics.ordered(profile.robot.arm_joints, profile.robot.home_rad)
    return Arm(profile, reach.kinematics, reach.barriers, home_rad)


# -- paths ----------------------------------------------------------------------------------------
def eased() -> FloatArray:
    """(`MOMENTS`, 1) of a minimum-jerk motion from 0 to 1."""
    s = np.linspace(0.0, 1.0, MOMENTS)[:, None]
    return s**3 * (10 - 15 * s + 6 * s * s)


def swivel(arm: Arm) -> Track:
    """The elbow turns, and the TCP stays where it is at home."""
    joints_rad, home = arm.home_rad.copy(), arm.kinematics.forward(arm.home_rad)
    rows = [joints_rad]
    for part in np.diff(eased()[:, 0]) * SWIVEL_RAD:
        pose, jacobian = arm.kinematics.pose_and_jacobian(joints_rad)
        null = np.linalg.svd(jacobian)[2][-1]
        back = np.linalg.lstsq(jacobian, pose_error(home, pose), rcond=None)[0]
        joints_rad = joints_rad + back + null * np.sign(null[0]) * part
        rows.append(joints_rad)
    return Track(np.array(rows), SWIVEL_S)


def wrist(arm: Arm) -> Track:
    """The joints pass straight through a singularity of the wrist, within 1e-6 of it."""
    middle_rad = WRIST_RAD.copy()
    for width in (0.1, 0.01, 0.001, 1e-4, 1e-5):
        near = middle_rad[5] + width * np.linspace(-1.0, 1.0, 41)
        values = [singular_value(arm, np.array([*middle_rad[:5], x, middle_rad[6]])) for x in near]
        middle_rad[5] = near[int(np.argmin(values))]
    return Track(middle_rad + (2 * eased() - 1) * ASIDE_RAD, WRIST_S)


def singular_value(arm: Arm, joints_rad: FloatArray) -> float:
    """The smallest of the Jacobian."""
    return smallest_singular_value(arm.kinematics.pose_and_jacobian(joints_rad)[1])


def random_track(arm: Arm, seed: int, duration_s: float, spread_rad: float) -> Track:
    """From home to joints at random, as long as given; else a time at random, and with detours."""
    rng, joints = np.random.default_rng(seed), len(arm.home_rad)
    s = np.linspace(0.0, 1.0, MOMENTS)[:, None]
    for _ in range(10_000):
        way_rad = rng.uniform(-spread_rad, spread_rad, joints)
        rows = arm.home_rad + eased() * way_rad
        if not duration_s:
            wobble = rng.uniform(-WOBBLE_RAD, WOBBLE_RAD, joints)
            turns = rng.uniform(0.5, TURNS, joints)
            rows += wobble * 64 * (s * (1 - s)) ** 3 * np.sin(2 * np.pi * turns * s)
        track = Track(rows, duration_s or float(rng.uniform(2.0, 4.0)))
        if is_free(arm, track):
            return track
    raise RuntimeError(f"no free path found with seed {seed}")


def is_free(arm: Arm, track: Track) -> bool:
    """Whether no bound is near."""
    moment_s = track.duration_s / (len(track.rows_rad) - 1)
    bounds = chain_motion_limits(arm.profile, arm.kinematics)
    rates = np.diff(track.rows_rad, axis=0) / moment_s
    if (np.abs(rates) > SHARE * bounds.velocity_rad_s).any():
        return False
    if (np.abs(np.diff(rates, axis=0)) / moment_s > SHARE * bounds.acceleration_rad_s2).any():
        return False
    low, high = workspace_corners(arm.profile.limits)
    lower, upper = arm.kinematics.lower_rad + CLEAR_RAD, arm.kinematics.upper_rad - CLEAR_RAD
    places_m = []
    for joints_rad in track.rows_rad[::10]:
        places_m.append(arm.kinematics.forward(joints_rad).position_m)
        if (joints_rad < lower).any() or (joints_rad > upper).any():
            return False
        if (places_m[-1] < low + CLEAR_M).any() or (places_m[-1] > high - CLEAR_M).any():
            return False
        if (arm.barriers.collisions.distances(joints_rad) < arm.barriers.slow[1:]).any():
            return False
    speed = np.linalg.norm(np.diff(places_m, axis=0), axis=1).max() / (10 * moment_s)
    return bool(speed < SHARE * arm.profile.limits.translation.velocity_m_s)


# -- policies -------------------------------------------------------------------------------------
class Follower:
    """A policy that follows a path of joints from `begin_ns` on, as joints or as their poses.

    Args:
        kinematics: of the arm.
        track: the path.
        joints: as joints.
    """

    def __init__(self, kinematics: Kinematics, track: Track, *, joints: bool) -> None:
        self.spec = ModelSpec(
            name="follower",
            observation=ObservationSpec(state=("joint",), prompt=False),
            action=ActionSpec(
                horizon=HORIZON,
                dt_s=DT_S,
                kind="absolute",
                space="joint" if joints else "tcp",
                joints=kinematics.arm_joints if joints else (),
                rotation="quaternion",
                gripper="none",
            ),
        )
        self._kinematics, self._track, self._joints = kinematics, track, joints
        self.begin_ns: int | None = None

    def infer(self, observation: Observation) -> ActionSteps:
        """The path of the next 0.8 s."""
        times_s = np.zeros(HORIZON)
        if self.begin_ns is not None:
            since_s = (observation.stamp_wall_ns - self.begin_ns) / 1e9
            times_s = since_s + DT_S * np.arange(1, HORIZON + 1)
        rows = self._track.at(times_s)
        return ActionSteps(rows if self._joints else [self._pose(row) for row in rows])

    def _pose(self, joints_rad: FloatArray) -> list[float]:
        pose = self._kinematics.forward(joints_rad)
        return [*pose.position_m, *quat_from_rotation(pose.rotation)]


class Stepper:
    """A policy of joint deltas that asks for the same rates until `DROID_S` of them are asked for.

    Of a chunk it counts what its next observation says of it: see `Observation.executed_steps`.

    Args:
        joints: names of the arm's.
        rates: (n,) rad/s.
    """

    def __init__(self, joints: tuple[str, ...], rates: FloatArray) -> None:
        self.spec = ModelSpec(
            name="stepper",
            observation=ObservationSpec(state=("joint",), prompt=False),
            action=ActionSpec(
                horizon=DROID_STEPS,
                dt_s=1 / DROID_HZ,
                kind="delta",
                space="joint",
                joints=joints,
                gripper="none",
            ),
        )
        self._rates = rates
        self._times_s = np.arange(DROID_STEPS + 1) / DROID_HZ
        self._ends_s = np.zeros(DROID_STEPS + 1)
        self.asked_s = 0.0

    def infer(self, observation: Observation) -> ActionSteps:
        """The next chunk; no steps before the arm follows."""
        if not observation.task.active:
            return ActionSteps(np.zeros((DROID_STEPS, len(self._rates))))
        executed_s = (observation.executed_steps or 0.0) / DROID_HZ
        self.asked_s += float(np.interp(executed_s, self._times_s, self._ends_s))
        self._ends_s = np.minimum(self._times_s, DROID_S - self.asked_s)
        return ActionSteps(np.diff(self._ends_s)[:, None] * self._rates)


# -- measurement ----------------------------------------------------------------------------------
def measure(case: Case, perfect: bool) -> dict[str, Any]:
    """Run one case."""
    if case.way == "steps":
        return {**case._asdict(), **step_figures(case, perfect)}
    arm = arm_of(case.profile, WAYS[case.way])
    if case.name == "swivel":
        track = swivel(arm)
    elif case.name == "wrist":
        track = wrist(arm)
    else:
        track = random_track(arm, case.seed, case.duration_s, SPREAD_RAD[case.profile])
    policy = Follower(arm.kinematics, track, joints=case.way == "joints")
    try:
        loop = started(arm, policy, RATE_HZ, case.seed, track.rows_rad[0], perfect=perfect)
    except RuntimeError as error:
        return {**case._asdict(), "rejected": str(error).rpartition("': ")[2]}
    policy.begin_ns = loop.now_ns
    measured = []
    for _ in range(round((track.duration_s + SETTLE_S) / SAMPLE_S)):
        loop.run(SAMPLE_S)
        measured.append(arm.kinematics.joints_of(loop.world.joint_state()))
    return {**case._asdict(), **track_figures(arm, track, loop, np.array(measured))}


def started(
    arm: Arm, policy: Any, rate_hz: float, seed: int, start_rad: FloatArray, *, perfect: bool
) -> Lockstep:
    """A loop whose arm follows the policy and stands at `start_rad`.

    Raises:
        RuntimeError: it could not be activated; says why.
    """
    chain = arm.kinematics.arm_joints
    home_rad = [float(start_rad[chain.index(name)]) for name in arm.profile.robot.arm_joints]
    profile = override(arm.profile, {"robot": {"home_rad": home_rad}})
    loop = activated(profile, policy, DELAYS, rate_hz, seed, perfect=perfect)
    if isinstance(policy, Follower):
        loop.run(LOOK_S)
    return loop


def track_figures(arm: Arm, track: Track, loop: Lockstep, measured: FloatArray) -> dict[str, Any]:
    """Figures of a path."""
    times_s = SAMPLE_S * np.arange(1, len(measured) + 1)
    off = 1e3 * np.abs(measured - track.at(times_s))
    delays_s = np.arange(0.0, MOST_LATE_S, SAMPLE_S)
    shifted = [1e3 * np.abs(measured - track.at(times_s - delay_s)) for delay_s in delays_s]
    best = int(np.argmin([(each**2).mean() for each in shifted]))
    asked = track.at(times_s - delays_s[best])
    apart_mm = [1e3 * _apart_m(arm, *rows) for rows in zip(asked, measured, strict=True)]
    rest_mrad = float(off[-1].max())
    return {
        "singular_value": min(singular_value(arm, row) for row in track.rows_rad),
        "moves_rad": float(np.ptp(track.rows_rad, axis=0).max()),
        "rest_mrad": rest_mrad,
        "rest_mm": 1e3 * _apart_m(arm, track.rows_rad[-1], measured[-1]),
        "late_s": float(delays_s[best]),
        "motion_mrad": float(off.max()),
        "left_mrad": float(shifted[best].max()),
        "left_mm": max(apart_mm),
        "stuck": rest_mrad > STUCK_MRAD,
        "state": loop.commander.state.value,
        "limits": sorted({event.what for event in loop.events if event.kind == "limit"}),
    }


def _apart_m(arm: Arm, asked_rad: FloatArray, measured_rad: FloatArray) -> float:
    """Distance of the TCPs of two joints."""
    asked_m = arm.kinematics.forward(asked_rad).position_m
    return float(np.linalg.norm(arm.kinematics.forward(measured_rad).position_m - asked_m))


def step_figures(case: Case, perfect: bool) -> dict[str, Any]:
    """How much of the steps asked for is executed."""
    arm, rng = arm_of(case.profile, "joint"), np.random.default_rng(case.seed)
    while True:
        rates = rng.uniform(-DROID_RAD_S, DROID_RAD_S, len(arm.home_rad))
        if is_free(arm, Track(arm.home_rad + eased() * DROID_S * rates, 2 * DROID_S)):
            break
    policy = Stepper(arm.kinematics.arm_joints, rates)
    loop = started(arm, policy, case.duration_s, case.seed, arm.home_rad, perfect=perfect)
    loop.run(DROID_S + SETTLE_S)
    moved_rad = arm.kinematics.joints_of(loop.world.joint_state()) - arm.home_rad
    asked_rad = policy.asked_s * rates
    return {
        "asked_rad": float(np.linalg.norm(asked_rad)),
        "covered": float(moved_rad @ asked_rad / (asked_rad @ asked_rad)),
        "rest_mrad": 1e3 * float(np.abs(moved_rad - asked_rad).max()),
        "state": loop.commander.state.value,
        "limits": sorted({event.what for event in loop.events if event.kind == "limit"}),
    }


# -- tables ---------------------------------------------------------------------------------------
FIGURES = ("rest_mrad", "rest_mm", "late_s", "motion_mrad", "left_mrad", "left_mm")


def show(rows: list[dict[str, Any]]) -> None:
    """Print two tables: of each kind of path the median and the worst."""
    kinds: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in rows:
        kinds.setdefault((row["profile"], row["name"], row["way"]), []).append(row)
    heads = " ".join(f"{name.replace('_', ' '):>15}" for name in FIGURES)
    print(f"{'arm':10} {'path':13} {'as':7} {'n':>3} {heads} {'stuck':>6}")
    for (profile, name, way), ended in kinds.items():
        if way == "steps":
            continue
        about = f"{profile:10} {name:13} {way:7} {len(ended):3d}"
        if "rejected" in ended[0]:
            print(f"{about} rejected: {ended[0]['rejected']}")
            continue
        each = [[row[figure] for row in ended] for figure in FIGURES]
        told = " ".join(f"{np.median(found):8.2f} {max(found):6.2f}" for found in each)
        print(f"{about} {told} {sum(row['stuck'] for row in ended):6d}")
    steps = {kind: ended for kind, ended in kinds.items() if kind[2] == "steps"}
    if steps:
        print(f"\n{'arm':10} {'asked':13} {'n':>3} {'executed':>18} {'rest mrad':>10}")
    for (profile, name, _), ended in steps.items():
        parts = [100 * row["covered"] for row in ended]
        worst = max(row["rest_mrad"] for row in ended)
        print(
            f"{profile:10} {name:13} {len(ended):3d} {min(parts):7.1f} to {max(parts):5.1f} % "
            f"{worst:10.2f}"
        )


def main() -> int:
    """Command line of the benchmark."""
    parser = argparse.ArgumentParser(description="Asked against reached joints.")
    parser.add_argument("-n", type=int, default=50, help="random paths of each kind and way")
    parser.add_argument("--seed", type=int, default=1, help="of the first one")
    parser.add_argument("--only", default="", help="cases with this text in arm, name and way")
    parser.add_argument("--perfect", action="store_true", help="without physics, much faster")
    parser.add_argument("--jobs", type=int, help="at a time; else one a core")
    parser.add_argument("--json", action="store_true", help="every path, in place of the tables")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="every path")
    options = parser.parse_args()
    cases = [
        case
        for case in all_cases(options.n, options.seed)
        if options.only in f"{case.profile} {case.name} {case.way}"
    ]
    rows = list(in_processes(measure, [(case, options.perfect) for case in cases], options.jobs))
    order = {case: index for index, case in enumerate(cases)}
    rows.sort(key=lambda row: order[Case(**{name: row[name] for name in Case._fields})])
    text = json.dumps(rows, indent=1)
    if options.json:
        print(text)
    else:
        show(rows)
    if options.output:
        options.output.write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
