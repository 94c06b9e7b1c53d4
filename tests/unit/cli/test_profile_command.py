"""vla-zenoh profile: list, show and check, as a person and as a script see them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vla_zenoh import resources
from vla_zenoh.profile import load_profile
from vla_zenoh.program.main import app
from vla_zenoh.resources import names, robot_urdf

RUNNER = CliRunner()


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "profiles"
    folder.mkdir()
    monkeypatch.setenv(resources.SEARCH_PATH_VARIABLE, str(tmp_path))
    monkeypatch.setenv("COLUMNS", "200")
    return folder


def test_every_profile_is_listed(own_folder: Path) -> None:
    (own_folder / "lab.yaml").write_text("extends: panda_sim\nabout: our [lab] \u202e\n")
    result = RUNNER.invoke(app, ["profile", "list"])
    assert result.exit_code == 0
    assert all(name in result.stdout for name in names("profiles"))
    assert "our [lab] \\u202e" in result.stdout


def test_a_profile_that_is_wrong_is_listed_with_its_fault(own_folder: Path) -> None:
    (own_folder / "lab.yaml").write_text("extends: nobody\n")
    result = RUNNER.invoke(app, ["profile", "list"])
    assert result.exit_code == 0
    assert "no profile called 'nobody'" in result.stdout
    rows = {
        row["name"]: row
        for row in json.loads(RUNNER.invoke(app, ["profile", "list", "--json"]).stdout)
    }
    assert "lab.yaml:1: extends" in rows["lab"]["fault"]
    assert rows["panda_sim"]["hosts"] == ["here"]
    assert set(rows) == set(names("profiles"))


def test_what_is_shown_is_the_effective_profile_and_can_be_read_again(own_folder: Path) -> None:
    (own_folder / "lab.yaml").write_text("extends: panda_sim\nabout: ours\n")
    result = RUNNER.invoke(app, ["profile", "show", "lab"])
    assert result.exit_code == 0
    assert "\x1b" not in result.stdout
    again = own_folder / "again.yaml"
    again.write_text(result.stdout)
    assert load_profile("again") == load_profile("lab")


def test_a_script_gets_json() -> None:
    result = RUNNER.invoke(app, ["profile", "show", "panda_sim", "--json"])
    assert json.loads(result.stdout) == load_profile("panda_sim").model_dump(mode="json")


def test_a_terminal_gets_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    result = RUNNER.invoke(app, ["profile", "show", "panda_sim"])
    assert "\x1b[" in result.stdout
    assert "arm_joints" in result.stdout


def test_nothing_of_that_name_is_one_line_on_stderr() -> None:
    result = RUNNER.invoke(app, ["profile", "show", "panda_simm"])
    assert result.exit_code == 1
    assert result.stdout == ""
    assert result.stderr.startswith(
        "error: no profile called 'panda_simm'; did you mean 'panda_sim'?"
    )


def test_right_profiles_are_ok(own_folder: Path) -> None:
    result = RUNNER.invoke(app, ["profile", "check", "panda_sim", "panda_ros2"])
    assert result.exit_code == 0
    assert result.stdout == "ok panda_sim\nok panda_ros2\n"
    assert result.stderr == ""


def test_wrong_ones_are_told_line_by_line_on_stderr(own_folder: Path) -> None:
    path = own_folder / "lab.yaml"
    path.write_text("extends: panda_sim\nlimts: {}\nlimits: {step_m: 9}\n")
    result = RUNNER.invoke(app, ["profile", "check", str(path), "panda_sim"])
    assert result.exit_code == 1
    assert result.stdout == "ok panda_sim\n"
    lines = result.stderr.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith(f"{path}:3: limits.step_m: must be at most 0.2 (given: 9)")
    assert lines[1].startswith(f"{path}:2: limts: unknown key; did you mean 'limits'?")


@pytest.mark.parametrize(
    ("robot", "told"),
    [
        ("tcp_frame: panda_hand_tpc", "has no link 'panda_hand_tpc'; did you mean"),
        ("finger_joints: [panda_finger]", "has no joint 'panda_finger'; did you mean"),
        ("base_frame: panda_hand", "base_frame 'panda_hand' of panda.urdf moves"),
        (
            "gripper: {joint_open_rad: 0.0, joint_shut_rad: 0.8}",
            "slides: write gripper: {joint_open_m: ..., joint_shut_m: ...}",
        ),
    ],
)
def test_what_the_description_of_the_robot_does_not_have_is_a_fault(
    own_folder: Path, robot: str, told: str
) -> None:
    (own_folder / "lab.yaml").write_text(f"extends: panda_sim\nrobot: {{{robot}}}\n")
    result = RUNNER.invoke(app, ["profile", "check", "lab"])
    assert result.exit_code == 1
    assert result.stdout == ""
    assert result.stderr.startswith(f"{own_folder / 'lab.yaml'}:2: robot: ")
    assert told in result.stderr


def test_a_description_that_is_none_is_a_fault_wherever_it_is(own_folder: Path) -> None:
    urdf = own_folder / "arm.urdf"
    urdf.write_text("no robot")
    (own_folder / "lab.yaml").write_text(f"extends: panda_sim\nrobot: {{description: {urdf}}}\n")
    result = RUNNER.invoke(app, ["profile", "check", "lab"])
    assert result.exit_code == 1
    assert "arm.urdf is no XML" in result.stderr


TWO_HOSTS = """\
extends: panda_sim
robot: {{description: {urdf}}}
hosts: {{desk: {{nodes: [router, sim, command]}}, gpu: {{nodes: [worker, camera]}}}}
"""


@pytest.mark.parametrize("what", ["description", "meshes"])
def test_a_robot_that_is_not_here_is_a_fault_where_the_command_node_runs_and_elsewhere_advice(
    own_folder: Path, what: str
) -> None:
    urdf, told = own_folder / "arm.urdf", "is not a file"
    if what == "meshes":
        other = robot_urdf("example-robot-data:panda_description/urdf/panda.urdf")
        urdf.write_text(other.read_text())  # its meshes are not below this folder
        told = "package://NAME/... is looked for as NAME/... beside the URDF"
    (own_folder / "lab.yaml").write_text(TWO_HOSTS.format(urdf=urdf))
    for words, code in (([], 0), (["--host", "gpu"], 0), (["--host", "desk"], 1)):
        result = RUNNER.invoke(app, ["profile", "check", "lab", *words])
        assert result.exit_code == code, result.stderr
        assert result.stderr.count(told) == 1
        assert result.stderr.count("advice robot.description") == 1 - code

    (own_folder / "one.yaml").write_text(
        "extends: lab\nhosts: {here: {nodes: [router, sim, command, camera, worker]}}\n"
    )
    assert RUNNER.invoke(app, ["profile", "check", "one"]).exit_code == 1
    result = RUNNER.invoke(app, ["profile", "check", "lab", "--host", "robot"])
    assert result.exit_code == 1
    assert "hosts: has no 'robot'. It has: desk, gpu" in result.stderr


def test_what_is_questionable_is_advice_and_no_failure() -> None:
    result = RUNNER.invoke(app, ["profile", "check", "panda_sim_two_hosts"])
    assert result.exit_code == 0
    assert result.stdout == "ok panda_sim_two_hosts\n"
    assert (
        "advice session.listen: the router on robot is reachable "
        "on that computer only" in result.stderr
    )


@pytest.mark.parametrize(("acceleration", "said"), [(0.25, False), (0.2, True)])
@pytest.mark.parametrize("driver", ["sim", "ros2"])
def test_a_brake_that_up_would_cut_short_is_told(
    own_folder: Path, driver: str, acceleration: float, said: bool
) -> None:
    (own_folder / "lab.yaml").write_text(
        f"extends: panda_{driver}\nlimits: {{translation: {{acceleration_m_s2: {acceleration}}}}}\n"
    )
    result = RUNNER.invoke(app, ["profile", "check", "lab"])
    assert result.exit_code == 0
    told = "advice limits: braking from full speed may take 2.6 s" in result.stderr
    assert told == (said and driver == "ros2"), result.stderr


def test_check_wants_a_name() -> None:
    assert RUNNER.invoke(app, ["profile", "check"]).exit_code == 2
