"""Measured joints while the arm moves: near to a bound it is slower, too near it brakes."""

from __future__ import annotations

import numpy as np
import pytest
from command_rig import Rig, profile

from vla_zenoh.control.limits import LimitHit, in_steps
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.watchdog import JointMonitor
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import Pose, pose_distance, quat_from_rotation
from vla_zenoh.types import FloatArray

PROFILE = profile()
KINEMATICS = make_kinematics(PROFILE)
HOME_RAD = KINEMATICS.ordered(PROFILE.robot.arm_joints, PROFILE.robot.home_rad)
LIMITS = PROFILE.limits
TICK_NS = 4_000_000
TICKS_A_LOOK = 10
JOINT = dict(zip(KINEMATICS.arm_joints, np.eye(KINEMATICS.size), strict=True))


class Watching:
    """A watch of the shipped arm, told its joints at every tick."""

    def __init__(self, start_rad: FloatArray = HOME_RAD, commanded_rad: FloatArray | None = None):
        shadow = ReachabilityFilter(PROFILE, KINEMATICS)
        shadow.reset(start_rad)
        self.watch, self.commanded_rad = JointMonitor(PROFILE, shadow), commanded_rad
        self.now_ns = 0

    def at(self, joints_rad: FloatArray, ticks: int = TICKS_A_LOOK) -> LimitHit | None:
        for _ in range(ticks):
            self.now_ns += TICK_NS
            hit = self.watch.update(joints_rad, self.commanded_rad, self.now_ns)
            if hit is not None:
                return hit
        return None

    def along(self, way_rad: FloatArray, steps: int = 100) -> tuple[list[float], LimitHit | None]:
        """The shares of a way that begins at home, until it says brake."""
        shares: list[float] = []
        for step in range(steps + 1):
            joints_rad = HOME_RAD + step / steps * way_rad
            self.commanded_rad = joints_rad
            hit = self.at(joints_rad)
            if hit is not None:
                return shares, hit
            slower = self.watch.slowdown
            shares.append(slower.share if slower else 1.0)
        return shares, None


@pytest.mark.parametrize(
    ("joint", "by_rad", "name", "where", "limit"),
    [
        ("panda_joint2", 1.5, "table_distance", "panda_", None),
        ("panda_joint4", -0.5, "joint_limit", "panda_joint4", LIMITS.reach.joint_margin_rad),
        ("panda_joint6", 1.2, "joint_limit", "panda_joint6", LIMITS.reach.joint_margin_rad),
    ],
)
def test_an_arm_that_comes_near_to_a_bound_is_slower_and_then_brakes_and_says_where(
    joint: str, by_rad: float, name: str, where: str, limit: float | None
) -> None:
    shares, hit = Watching().along(by_rad * JOINT[joint])
    assert shares[0] == 1.0
    assert min(shares) < 0.5
    assert hit is not None
    assert hit.name == name
    assert hit.where.startswith(where)
    assert hit.value < hit.limit
    assert limit is None or hit.limit == limit


def test_towards_an_end_of_its_range_an_arm_has_the_speed_that_it_can_stop_from() -> None:
    margin_rad, end_rad = LIMITS.reach.joint_margin_rad, KINEMATICS.lower_rad[3]
    for margins, share in ((2.05, 1.0), (1.75, np.sqrt(0.75)), (1.5, np.sqrt(0.5))):
        way_rad = end_rad + margins * margin_rad - HOME_RAD[3]
        shares, hit = Watching().along(way_rad * JOINT["panda_joint4"])
        assert hit is None
        assert min(shares[-3:]) == pytest.approx(in_steps(float(share)), abs=0.051)


@pytest.mark.parametrize("joints_asked", [False, True])
def test_only_an_arm_that_is_led_by_its_joints_may_come_near_to_a_singularity(
    joints_asked: bool,
) -> None:
    watching, names = Watching(), set[str]()
    for elbow_rad in np.linspace(-1.0, -0.2, 50):
        joints_rad = np.array([0.0, 0.35, 0.0, elbow_rad, 0.0, 1.5, 0.785])
        for _ in range(TICKS_A_LOOK):
            watching.now_ns += TICK_NS
            hit = watching.watch.update(
                joints_rad, joints_rad, watching.now_ns, joints_asked=joints_asked
            )
            names |= {each.name for each in (hit, watching.watch.slowdown) if each is not None}
    assert ("singularity" in names) is not joints_asked


def test_an_arm_that_stood_for_long_is_checked_again_as_soon_as_it_moves() -> None:
    watching = Watching()
    assert watching.at(HOME_RAD, ticks=50 * TICKS_A_LOOK) is None
    for step in range(1, 6):
        joints_rad = HOME_RAD - step / 5 * 0.5 * JOINT["panda_joint4"]
        watching.commanded_rad = joints_rad
        hit = watching.at(joints_rad)
    assert hit is not None
    assert hit.name == "joint_limit"


def test_an_arm_that_stands_still_is_checked_again_when_its_command_moves_away() -> None:
    watching = Watching(commanded_rad=HOME_RAD)
    assert watching.at(HOME_RAD, ticks=50 * TICKS_A_LOOK) is None
    watching.commanded_rad = HOME_RAD + 3 * LIMITS.elbow_rad * JOINT["panda_joint1"]
    hit = watching.at(HOME_RAD)
    assert hit is not None
    assert hit.name == "elbow_rad"


def test_on_the_way_back_an_arm_is_neither_slower_nor_braked() -> None:
    watching = Watching()
    way_rad = -0.41 * JOINT["panda_joint4"]
    shares, hit = watching.along(way_rad)
    assert hit is None
    assert min(shares) < 1.0
    for step in range(50, -1, -1):
        watching.commanded_rad = HOME_RAD + step / 50 * way_rad
        assert watching.at(watching.commanded_rad) is None
        if step < 49:
            assert watching.watch.slowdown is None


def test_an_arm_that_rests_beyond_a_stop_may_move_away() -> None:
    beyond_rad = KINEMATICS.lower_rad[3] + 0.01 - HOME_RAD[3]
    watching = Watching()
    watching.commanded_rad = HOME_RAD + beyond_rad * JOINT["panda_joint4"]
    noise = np.random.default_rng(1)
    for _ in range(50):
        jitter = noise.uniform(-5e-4, 5e-4, KINEMATICS.size)
        assert watching.at(watching.commanded_rad + jitter) is None
    assert watching.watch.slowdown is None


def test_a_creep_towards_a_bound_is_an_approach_however_slow() -> None:
    shares, hit = Watching().along(-0.5 * JOINT["panda_joint4"], steps=2000)
    assert min(shares) < 0.5
    assert hit is not None


@pytest.mark.parametrize("commands_joints", [False, True])
def test_an_elbow_that_goes_astray_slows_the_arm_and_then_brakes_it(commands_joints: bool) -> None:
    """Swivelled about the line from shoulder to wrist, the TCP where it is."""
    watching = Watching(commanded_rad=HOME_RAD if commands_joints else None)
    joints_rad, here = HOME_RAD, KINEMATICS.forward(HOME_RAD)
    shares: list[float] = []
    hit = None
    for _ in range(400):
        jacobian = KINEMATICS.jacobian(joints_rad)
        free = np.linalg.svd(jacobian)[2][-1]
        way_rad = 0.01 * free * np.sign(free[0]) / np.abs(free).max()
        joints_rad = joints_rad + way_rad
        hit = watching.at(joints_rad, ticks=2 if commands_joints else 1)
        if hit is not None:
            break
        slower = watching.watch.slowdown
        shares.append(slower.share if slower else 1.0)
        assert slower is None or slower.name == "elbow_rad"
    assert pose_distance(KINEMATICS.forward(joints_rad), here)[0] < 0.02
    assert hit is not None
    assert hit.name == "elbow_rad"
    assert hit.limit == 2 * LIMITS.elbow_rad
    assert hit.value > hit.limit
    assert min(shares) < 0.5


# -- in the command node --------------------------------------------------------------------------
class Arm(Rig):
    """Poses are commanded; the joints are where a test says."""

    def __init__(self) -> None:
        super().__init__(PROFILE, reach=ReachabilityFilter(PROFILE, KINEMATICS))
        self.joints_rad, self.joints_of_tcp = HOME_RAD, False
        self.place(KINEMATICS.forward(HOME_RAD))

    def place(self, pose: Pose) -> None:
        self.position_m, self.quat_xyzw = pose.position_m, quat_from_rotation(pose.rotation)


def limits_told(arm: Rig) -> list[tuple[str, str, float | None, float | None]]:
    return [(e.what, e.why, e.value, e.limit) for e in arm.events if e.kind == "limit"]


def test_the_measured_arm_ends_the_activation_with_an_event_that_names_joint_value_and_limit() -> (
    None
):
    arm = Arm()
    joints_rad = HOME_RAD - 0.345 * JOINT["panda_joint4"]
    arm.stand_at(KINEMATICS, joints_rad)
    arm.activate()
    arm.blocked = True  # a person moves it
    slowest = 1.0
    for _ in range(200):
        joints_rad = joints_rad - 0.001 * JOINT["panda_joint4"]
        arm.stand_at(KINEMATICS, joints_rad)
        arm.tick()
        slowest = min(slowest, arm.commander.parts[0].motion.scaling.share)
        if arm.state != "active":
            break
    assert arm.state == "inactive"
    assert slowest < 1.0
    what, why, value, limit = limits_told(arm)[-1]
    assert (what, why) == ("joint_limit", "braked at panda_joint4")
    assert value is not None
    assert value < LIMITS.reach.joint_margin_rad == limit
    assert "joint_limit at panda_joint4" in arm.commander.why
    arm.settle()
    arm.assert_smooth()


def test_an_arm_whose_joints_are_not_heard_any_more_brakes() -> None:
    arm = Arm()
    arm.activate()
    joints_rad, arm.joints_rad = arm.joints_rad, None
    arm.run(0.5)
    assert arm.state == "inactive"
    assert "joints" in arm.commander.why
    arm.joints_rad = joints_rad
    arm.tick()
    arm.activate()


def test_a_step_is_judged_by_the_elbow_that_the_arm_really_has() -> None:
    """The elbow is swivelled; the same TCP, but not the same room."""
    arm = Arm()
    arm.activate()
    shadow = arm.commander.parts[0].reach
    assert shadow is not None
    joints_rad = HOME_RAD.copy()
    for _ in range(40):
        free = np.linalg.svd(KINEMATICS.jacobian(joints_rad))[2][-1]
        joints_rad = joints_rad + 0.008 * free * np.sign(free[0]) / np.abs(free).max()
    arm.joints_rad = joints_rad
    arm.run(0.1)
    arm.send([[0, 0, 0.001, 0, 0, 0, 0]])
    apart_rad = np.abs(shadow.joints_rad - joints_rad).max()
    assert apart_rad < 0.1 < np.abs(joints_rad - HOME_RAD).max()


def test_a_standing_arm_near_a_singularity_approaches_none_when_its_goals_become_poses() -> None:
    singular_rad = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 0.0, 0.785])
    shadow = ReachabilityFilter(PROFILE, KINEMATICS)
    shadow.reset(singular_rad)
    monitor, now_ns = JointMonitor(PROFILE, shadow), 0
    for joints_asked in [True] * 40 + [False] * 40:
        now_ns += TICK_NS
        assert monitor.update(singular_rad, singular_rad, now_ns, joints_asked=joints_asked) is None
        assert monitor.slowdown is None


def test_an_inverse_solution_that_fails_once_leaves_the_elbow_where_it_is_expected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    watching = Watching()
    joints_rad = HOME_RAD.copy()
    watching.at(joints_rad)
    way = np.linalg.svd(KINEMATICS.jacobian(joints_rad))[2][-1]
    for _ in range(40):
        now = np.linalg.svd(KINEMATICS.jacobian(joints_rad))[2][-1]
        way = now if now @ way > 0 else -now
        joints_rad = joints_rad + 0.01 * way
        watching.at(joints_rad, 20)
    apart_rad = watching.watch.elbow_rad
    assert apart_rad > 0.1
    with monkeypatch.context() as patched:
        patched.setattr(watching.watch._reach, "solve", lambda *_: None)
        watching.at(joints_rad, 20)
    watching.at(joints_rad, 20)
    assert watching.watch.elbow_rad == pytest.approx(apart_rad, abs=0.02)
