"""Two workers of a recording are compared."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typed import typed
from vla_zenoh_benchmarks.disagreement import arm_state

from vla_zenoh.codec import records
from vla_zenoh.errors import RecordError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.lab.recording.sample import MSGPACK, Sample
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.policy import ActionSpec, ModelSpec
from vla_zenoh.types import ActionChunk, GripperState, Header, PoseState

KEYS = Keys("panda")
START_NS = 1_700_000_000_000_000_000
PERIOD_NS, PAIRS = 200_000_000, 10
BIAS_M, ATOL_M = 0.002, 1e-6


def spec(name: str) -> ModelSpec:
    return ModelSpec(name=name, action=ActionSpec(horizon=2, dt_s=0.1, gripper="none"))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Workers ``a`` and ``b``; b goes further along x by `BIAS_M` in two steps."""
    out = RecordingWriter(
        tmp_path / "run.mcap", KEYS, profile_yaml="about: t\n", base_frame="b", began_ns=START_NS
    )

    def write(key: str, record: object, index: int, source: str) -> None:
        stamp_ns = START_NS + index * PERIOD_NS
        header = Header(stamp_ns, index, source)
        out.write(Sample(key, records.encode(record), MSGPACK, header, stamp_ns + 1_000_000))

    for name in "ab":
        write(KEYS.spec(name), spec(name), 0, f"worker-{name}#1")
    for index in range(PAIRS):
        stamp_ns = START_NS + index * PERIOD_NS
        pose = PoseState(np.array([0.4, 0.0, 0.2]), np.array([1.0, 0, 0, 0]), np.zeros(6))
        write(KEYS.state_pose, pose, index, "sim#1")
        gripper = GripperState(0.08, moving=False, holding=False)
        write(KEYS.state_gripper, gripper, index, "sim#1")
        for name, step_m in (("a", 0.01), ("b", 0.01 + BIAS_M / 2)):
            steps = np.zeros((2, 6))
            steps[:, 0] = step_m
            times = (stamp_ns, index, stamp_ns + 10**9, steps, stamp_ns, stamp_ns, stamp_ns)
            chunk = ActionChunk(name, spec(name).hash, 1, *times)
            write(KEYS.delta(name), chunk, index, f"worker-{name}#1")
    out.finish({})
    return tmp_path / "run.mcap"


def test_their_difference_is_found(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done = typed(capsys, "compare", "a", "b", str(recording), "--json")
    assert done.code == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["pairs"], found["only_a"], found["only_b"]) == (PAIRS, 0, 0)
    assert found["bias"] == pytest.approx([BIAS_M, 0, 0, 0, 0, 0], abs=ATOL_M)
    assert found["cosine"] == pytest.approx(1.0)


def test_a_worker_that_is_not_in_it_is_named_with_those_that_are(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = typed(capsys, "compare", "a", "ghost", str(recording))
    assert done.code == 1
    assert "has no chunks of 'ghost'; it has: a, b" in done.stderr


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
