"""Two simulated arms through real nodes: the demo, and what looks at its recording."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from chain import CHAIN_PATIENCE_S, Chain, command_line
from recording_rig import recording

from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.profile import load_profile, override

pytestmark = pytest.mark.slow
PARTS = ("left", "right")
TIMEOUT_S = 110.0
PROFILE = """\
extends: two_pandas_sim
timing: {{command_timeout_s: {command}, state_timeout_s: {state}}}
cameras:
  left_wrist: null
  right_wrist: null
"""


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("pair")
    profile = home / "pair.yaml"
    profile.write_text(PROFILE.format(**CHAIN_PATIENCE_S))
    out = home / "demo"
    done = command_line(
        *("demo", "--profile", str(profile), "--output", str(out), "--json"), timeout_s=TIMEOUT_S
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def test_the_demo_of_a_pair_does_its_task_and_shows_both_arms(demo: Path) -> None:
    summary = json.loads((demo / "summary.json").read_text())
    assert summary["ok"]
    assert [task["prompt"] for task in summary["tasks"]] == ["lift the bar"]
    report = (demo / "report.html").read_text()
    assert all(f"demo/{part}" in report for part in PARTS)
    assert (demo / "tasks.jpg").exists()
    assert (demo / "video.mp4").exists()


def test_the_motion_of_each_arm_is_evaluated(demo: Path) -> None:
    done = command_line("eval", str(demo / "run.mcap"), "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert [run["record_id"] for run in found["runs"]] == ["demo/left", "demo/right"]
    for run in found["runs"]:
        assert run["trans_total_m"] > 0.3
        assert run["command_path_m"] == pytest.approx(run["trans_total_m"], rel=0.05)
    assert found["overall"]["n_rows"] == found["runs"][0]["n_rows"]


def test_what_the_policy_asked_of_both_arms_becomes_a_dataset(demo: Path, tmp_path: Path) -> None:
    words = ("dataset", "export", str(demo / "run.mcap"), "--camera", "front")
    done = command_line(*words, "--output", str(tmp_path / "bar"), "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["labels"] == {"success": 1}
    features = json.loads((tmp_path / "bar/meta/info.json").read_text())["features"]
    assert features["action"]["names"][8] == "right_panda_joint1.pos"
    assert features["action"]["names"] == features["observation.state"]["names"]


def test_states_and_commands_of_both_arms_are_replayed(
    demo: Path, shared_chain: Chain, tmp_path: Path
) -> None:
    ghost = override(load_profile("two_pandas_sim"), {"robot": {"name": "ghost"}})
    again = tmp_path / "again.mcap"
    with recording(shared_chain, again, ghost):
        done = command_line(
            *("replay", str(demo / "run.mcap"), "--robot", "ghost", "--json"),
            profile=shared_chain.profile_file,
            timeout_s=TIMEOUT_S,
        )
    assert done.returncode == 0, done.stderr
    one, other = load_run(demo / "run.mcap"), load_run(again)
    assert one.part_names == other.part_names == PARTS
    for part in PARTS:
        for kind in ("poses", "joints", "grippers", "joint_commands", "gripper_commands"):
            a, b = getattr(one.of_part(part), kind), getattr(other.of_part(part), kind)
            assert a
            assert [entry.header.seq for entry in a] == [entry.header.seq for entry in b]
            shifts = {
                y.header.stamp_wall_ns - x.header.stamp_wall_ns for x, y in zip(a, b, strict=True)
            }
            assert len(shifts) == 1
