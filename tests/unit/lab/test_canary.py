"""Figures of a model in shadow, and why it is not promoted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vla_zenoh_canary.figures import RobotFigures, RobotWatch
from vla_zenoh_canary.judge import Demands, Present, refusals
from vla_zenoh_canary.record import CanaryRecord, Promoted, read_record, write_record

from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.policy import ActionSpec, ModelSpec
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.types import ActionChunk, GripperState, Header, JointState, PoseState, Stamped, Task

PROFILE = load_profile("panda_sim")
TASK = Task(1, True, "go", "old", 10.0)
START_NS, PERIOD_NS = 10**18, 100_000_000
INFERENCE_NS, AGE_NS = 20_000_000, 30_000_000
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
DELTA = ActionSpec(horizon=2, dt_s=0.1, gripper="none")
METRES = DELTA
MILLIMETRES = DELTA.model_copy(update={"position_scale_m": 0.001})
HOME_RAD = np.array(PROFILE.robot.home_rad)
ATOL_MM = 0.01
UP_CM = [[0, 0, 0.01, 0, 0, 0]] * 2
DOWN_CM = [[0, 0, -0.01, 0, 0, 0]] * 2
SECONDS = 40.0


class Pair:
    """Two workers of one robot, which answer ten images a second."""

    def __init__(
        self, old: ActionSpec = DELTA, new: ActionSpec = DELTA, profile: Profile = PROFILE
    ) -> None:
        self.watch = RobotWatch(profile, "new", "old", lambda _: make_kinematics(profile), 0.0)
        self.specs = {
            "old": ModelSpec(name="old", action=old),
            "new": ModelSpec(name="new", action=new),
        }
        for name, spec in self.specs.items():
            self.watch.workers[name].take_spec(spec, f"worker-{name}#1")
        self.seq, self.now_s = 0, 0.0

    def answer(self, name: str, asked: Sequence[Sequence[float]], **changes: Any) -> None:
        at_ns = START_NS + self.seq * PERIOD_NS
        chunk = ActionChunk(
            *(name, self.specs[name].hash, 1, at_ns, self.seq, at_ns + 10**10),
            *(np.array(asked, np.float32), at_ns, at_ns, at_ns + INFERENCE_NS),
        )
        header = Header(at_ns + AGE_NS, self.seq, f"worker-{name}#1")
        stamped = Stamped(header, replace(chunk, **changes), 0)
        self.watch.workers[name].take_chunk(stamped, TASK, self.now_s)

    def next(self, joints_rad: np.ndarray | None = None, task: Task = TASK) -> None:
        """Another image: the arm stands, 0.1 s pass."""
        header = Header(START_NS + self.seq * PERIOD_NS, self.seq, "sim#1")
        pose = PoseState(np.array([0.4, 0.0, 0.3]), DOWN, np.zeros(6))
        joint = None
        if joints_rad is not None:
            zeros = np.zeros(len(joints_rad))
            joint = JointState(PROFILE.robot.arm_joints, joints_rad, zeros, zeros)
        self.watch.take_state("", Stamped(header, pose, 0), joint, GripperState(0.08, False, False))
        self.seq += 1
        self.now_s += PERIOD_NS / 1e9
        self.watch.tick(task, self.now_s)

    def run(
        self, old: Sequence[Sequence[float]], new: Sequence[Sequence[float]], seconds: float
    ) -> RobotFigures:
        for _ in range(round(seconds * 10)):
            self.answer("old", old)
            self.answer("new", new)
            self.next()
        return self.watch.figures(self.now_s)


def test_the_same_motion_in_other_units_is_no_distance() -> None:
    millimetres = (np.array(UP_CM) * [1, 1, 1000, 1, 1, 1]).tolist()
    found = Pair(METRES, MILLIMETRES).run(UP_CM, millimetres, 10.0)
    assert found.apart.pairs == 100
    assert found.apart.distance_mm == pytest.approx((0.0, 0.0), abs=ATOL_MM)
    assert (found.seconds, found.active_s) == pytest.approx((10.0, 10.0), abs=0.01)
    assert found.new.inference_ms == pytest.approx((20.0, 20.0))
    assert found.new.age_ms == pytest.approx((30.0, 30.0))
    assert (found.new.chunks, found.new.rate_hz, found.new.rejected) == (100, 10.0, {})


def test_opposite_motions_end_four_steps_apart() -> None:
    found = Pair().run(UP_CM, DOWN_CM, 5.0)
    assert found.apart.distance_mm == pytest.approx((40.0, 40.0), abs=ATOL_MM)
    assert found.apart.after_s == pytest.approx(0.2)


def test_joints_and_poses_are_compared_where_the_tcp_ends() -> None:
    joints = ActionSpec(
        horizon=1,
        dt_s=0.1,
        kind="absolute",
        space="joint",
        gripper="none",
        joints=PROFILE.robot.arm_joints[::-1],
    )
    poses = ActionSpec(horizon=1, dt_s=0.1, kind="absolute", rotation="quaternion", gripper="none")
    end_rad = HOME_RAD + 0.05
    tcp = make_kinematics(PROFILE).forward(end_rad)
    pose = [[*tcp.position_m, *quat_from_rotation(tcp.rotation)]]
    pair = Pair(poses, joints)
    for _ in range(20):
        pair.answer("old", pose)
        pair.answer("new", [end_rad[::-1].tolist()])
        pair.next(HOME_RAD)
    found = pair.watch.figures(pair.now_s).apart
    assert (found.pairs, found.uncompared) == (20, 0)
    assert found.distance_mm == pytest.approx((0.0, 0.0), abs=ATOL_MM)


def test_numbers_that_no_arm_may_do_are_counted_by_the_command_nodes_reason() -> None:
    found = Pair().run(UP_CM, [[0, 0, 10.0, 0, 0, 0]] * 2, 1.0)
    assert found.new.rejected == {"position_units": 10}
    assert found.new.rejected_percent == 100.0
    assert found.apart.pairs == 0


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"spec_hash": "0" * 16}, "spec_mismatch"),
        ({"observation_stamp_ns": START_NS - 10**10}, "stale"),
        ({"valid_until_ns": START_NS}, "expired"),
        ({"steps": np.zeros((2, 7), np.float32)}, "shape"),
    ],
)
def test_a_chunk_is_judged_as_if_its_worker_were_obeyed(
    changes: dict[str, Any], reason: str
) -> None:
    pair = Pair()
    pair.answer("new", UP_CM, **changes)
    assert pair.watch.figures(1.0).new.rejected == {reason: 1}


def test_failures_of_a_worker_are_those_since_it_is_watched() -> None:
    pair = Pair()
    worker = pair.watch.workers["new"]
    worker.take_counters({"refused.inference_failed": 7, "clock.steps": 1})
    worker.take_counters({"refused.inference_failed": 9, "clock.steps": 5})
    assert pair.watch.figures(1.0).new.failed == {"inference_failed": 2}


def test_a_workers_silence_counts_only_while_it_is_asked() -> None:
    pair = Pair()
    pair.answer("new", UP_CM)
    for _ in range(50):
        pair.next(task=replace(TASK, speed_percent=0.0))
    assert pair.watch.figures(pair.now_s).new.longest_silence_s == 0.0
    for _ in range(30):
        pair.next()
    assert pair.watch.figures(pair.now_s).new.longest_silence_s == pytest.approx(3.0, abs=0.01)


def test_pairs_do_not_depend_on_when_they_are_counted() -> None:
    late = Pair()
    for _ in range(30):
        late.answer("old", UP_CM)
        late.next()
    late.seq = 0
    for _ in range(30):
        late.answer("new", DOWN_CM)
        late.next()
    assert late.watch.figures(late.now_s).apart.pairs == 30


# -- reasons --------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def good() -> RobotFigures:
    return Pair().run(UP_CM, UP_CM, SECONDS)


def now(found: RobotFigures, **changes: Any) -> Present:
    specs = {each.worker: (each.spec, each.source) for each in (found.new, found.other)}
    alive = frozenset({"command", "worker-old", "worker-new"})
    return Present(alive, "old", specs)._replace(**changes)


def names(found: RobotFigures | None, present: Present, demands: Demands | None = None) -> set[str]:
    return {each.name for each in refusals("panda", found, present, demands or Demands())}


def test_good_figures_of_workers_that_are_still_there_are_no_reason(good: RobotFigures) -> None:
    assert names(good, now(good)) == set()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda f: replace(f, seconds=10.0), "figures_missing"),
        (lambda f: replace(f, apart=replace(f.apart, pairs=3)), "figures_missing"),
        (lambda f: replace(f, new=replace(f.new, chunks=0)), "shadow_absent"),
        (lambda f: replace(f, new=replace(f.new, longest_silence_s=9.0)), "shadow_absent"),
        (lambda f: replace(f, other=replace(f.other, longest_silence_s=9.0)), "obeyed_absent"),
        (lambda f: replace(f, obeyed_changed=True), "obeyed_differs"),
        (lambda f: replace(f, new=replace(f.new, restarts=1)), "restarted"),
        (lambda f: replace(f, new=replace(f.new, rejected={"stale": 40})), "rejected"),
        (lambda f: replace(f, new=replace(f.new, failed={"contract": 40})), "rejected"),
    ],
)
def test_poor_figures_have_a_reason(
    good: RobotFigures, change: Callable[[RobotFigures], RobotFigures], reason: str
) -> None:
    assert names(change(good), now(good)) == {reason}


def test_a_robot_that_was_not_watched_has_no_figures(good: RobotFigures) -> None:
    assert names(None, now(good)) == {"figures_missing"}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"alive": frozenset({"command", "worker-old"})}, "shadow_absent"),
        ({"alive": frozenset({"command", "worker-new"})}, "obeyed_absent"),
        ({"obeyed": "third"}, "obeyed_differs"),
        ({"obeyed": None}, "obeyed_differs"),
    ],
)
def test_what_has_changed_since_is_a_reason(
    good: RobotFigures, changes: dict[str, Any], reason: str
) -> None:
    assert names(good, now(good, **changes)) == {reason}


def test_another_spec_or_another_process_of_the_name_is_a_reason(good: RobotFigures) -> None:
    old, new = (good.other.spec, good.other.source), (good.new.spec, good.new.source)
    assert names(good, now(good, specs={"old": old})) == {"shadow_absent"}
    other = {"old": old, "new": ("f" * 16, good.new.source)}
    assert names(good, now(good, specs=other)) == {"spec_differs"}
    again = {"old": old, "new": (new[0], "worker-new#2")}
    assert names(good, now(good, specs=again)) == {"restarted"}


def test_bounds_that_are_asked_for_are_kept(good: RobotFigures) -> None:
    assert names(good, now(good), Demands(age_ms=29.0)) == {"late"}
    far = replace(good, apart=replace(good.apart, distance_mm=(1.0, 12.0), angle_mrad=(1.0, 9.0)))
    assert names(far, now(far), Demands(apart_mm=10.0, apart_mrad=9.0)) == {"apart"}
    assert names(far, now(far)) == set()


# -- the file -------------------------------------------------------------------------------------
def test_a_file_is_read_as_it_was_written(good: RobotFigures, tmp_path: Path) -> None:
    promoted = {"panda": Promoted("old", 5, {"refused.stale": 2})}
    record = CanaryRecord("new", 7, {"panda": good}, promoted)
    write_record(tmp_path / "new.json", record)
    assert read_record(tmp_path / "new.json") == record


def test_a_file_without_figures_says_how_to_make_them(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"figures_missing: .*none.json: No such file.*watch"):
        read_record(tmp_path / "none.json")
    (tmp_path / "other.json").write_text('{"new": 3}')
    with pytest.raises(RecordError, match=r"figures_missing: .*other.json has no figures: .*new"):
        read_record(tmp_path / "other.json")
