"""Two workers of a recording are compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typed import typed
from vla_zenoh_benchmarks.disagreement import arm_state

from vla_zenoh.codec import records
from vla_zenoh.errors import RecordError
from vla_zenoh.keys import Keys
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.lab.recording.sample import MSGPACK, Sample
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.policy import ActionSpec, ModelSpec
from vla_zenoh.profile import load_profile, to_yaml
from vla_zenoh.types import ActionChunk, GripperState, Header, JointState, PoseState

KEYS = Keys("panda")
START_NS = 1_700_000_000_000_000_000
PERIOD_NS, PAIRS = 200_000_000, 10
BIAS_M, ATOL_M = 0.002, 1e-6


PANDA = load_profile("panda_sim")
HOME_RAD = np.array(PANDA.robot.home_rad)
HOME = make_kinematics(PANDA).forward(HOME_RAD)


def spec(name: str) -> ModelSpec:
    if name == "still":
        joints: dict[str, Any] = {"space": "joint", "joints": PANDA.robot.arm_joints}
        action = ActionSpec(horizon=2, dt_s=0.1, gripper="none", kind="absolute", **joints)
    else:
        action = ActionSpec(horizon=2, dt_s=0.1, gripper="none")
    return ModelSpec(name=name, action=action)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Workers ``a`` and ``b``; b goes further along x by `BIAS_M` in two steps."""
    return written(tmp_path / "run.mcap")


def written(path: Path, *, with_joints: bool = True) -> Path:
    """Worker ``still`` asks for the joints of home, where the arm is."""
    out = RecordingWriter(
        path, KEYS, profile_yaml=to_yaml(PANDA), base_frame="b", began_ns=START_NS
    )

    def write(key: str, record: object, index: int, source: str) -> None:
        stamp_ns = START_NS + index * PERIOD_NS
        header = Header(stamp_ns, index, source)
        out.write(Sample(key, records.encode(record), MSGPACK, header, stamp_ns + 1_000_000))

    for name in ("a", "b", "still"):
        write(KEYS.spec(name), spec(name), 0, f"worker-{name}#1")
    for index in range(PAIRS):
        stamp_ns = START_NS + index * PERIOD_NS
        pose = PoseState(HOME.position_m.copy(), quat_from_rotation(HOME.rotation), np.zeros(6))
        write(KEYS.state_pose, pose, index, "sim#1")
        if with_joints:
            joint = JointState(PANDA.robot.arm_joints, HOME_RAD, np.zeros(7), None)
            write(KEYS.state_joint, joint, index, "sim#1")
        gripper = GripperState(0.08, moving=False, holding=False)
        write(KEYS.state_gripper, gripper, index, "sim#1")
        for name, step_m in (("a", 0.01), ("b", 0.01 + BIAS_M / 2), ("still", 0.0)):
            steps = np.zeros((2, 6))
            steps[:, 0] = step_m
            if name == "still":
                steps = np.stack([HOME_RAD, HOME_RAD])
            times = (stamp_ns, index, stamp_ns + 10**9, steps, stamp_ns, stamp_ns, stamp_ns)
            chunk = ActionChunk(name, spec(name).hash, 1, *times)
            write(KEYS.delta(name), chunk, index, f"worker-{name}#1")
    out.finish({})
    return path


def test_their_difference_is_found(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done = typed(capsys, "compare", "a", "b", str(recording), "--json")
    assert done.code == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["pairs"], found["only_a"], found["only_b"]) == (PAIRS, 0, 0)
    assert found["bias"] == pytest.approx([BIAS_M, 0, 0, 0, 0, 0], abs=ATOL_M)
    assert found["cosine"] == pytest.approx(1.0)


def test_joints_and_poses_are_compared_where_they_bring_the_tcp(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = typed(capsys, "compare", "a", "still", str(recording), "--json")
    assert done.code == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["pairs"], found["unreadable"]) == (PAIRS, 0)
    assert found["bias"] == pytest.approx([-0.02, 0, 0, 0, 0, 0], abs=ATOL_M)


def test_pairs_none_of_which_can_be_compared_are_an_error_with_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = typed(
        capsys, "compare", "a", "still", str(written(tmp_path / "r.mcap", with_joints=False))
    )
    assert done.code == 1
    assert "none of the 10 pairs can be compared" in " ".join(done.stderr.split())
    assert "state/joint" in done.stderr


def test_a_worker_that_is_not_in_it_is_named_with_those_that_are(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = typed(capsys, "compare", "a", "ghost", str(recording))
    assert done.code == 1
    assert "has no chunks of 'ghost'; it has: a, b, still" in done.stderr


def test_where_the_arm_was_is_the_nearest_state_and_unknown_without_one(recording: Path) -> None:
    run = load_run(recording)
    for index, entry in enumerate(run.poses):
        entry.record.position_m.setflags(write=True)
        entry.record.position_m[0] = 0.1 * index
    for at_ns, nearest_m in ((-PERIOD_NS, 0.0), (PERIOD_NS * 1.4, 0.1), (PERIOD_NS * 1.6, 0.2)):
        found = arm_state(run, START_NS + round(at_ns))
        assert found.pose.position_m[0] == pytest.approx(nearest_m)
    assert arm_state(run, START_NS + 10**12).pose.position_m[0] == pytest.approx(0.9)
    run.poses.clear()
    with pytest.raises(RecordError, match="pose of the arm is unknown"):
        arm_state(run, START_NS)
