"""What is allowed and yet worth a second look is said, and nothing else is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from vla_zenoh import resources
from vla_zenoh.lab.profile.check import advice, check_profile
from vla_zenoh.lab.profile.robot_check import barriers_advice, table_advice
from vla_zenoh.profile import load_profile, override

SIM = load_profile("panda_sim")
ROBOT = {"robot": {"nodes": ["router", "sim", "camera", "command"]}}
NET = "tls/10.0.0.2:7447"


def gpu(**more: Any) -> dict[str, Any]:
    return {**ROBOT, "gpu": {"nodes": ["worker"], **more}}


def test_a_plain_profile_needs_no_advice() -> None:
    assert advice(SIM) == []


def test_two_hosts_with_real_addresses_need_no_advice() -> None:
    session = {"listen": [NET], "connect": [NET], "security": {}}
    assert advice(override(SIM, {"session": session, "hosts": gpu()})) == []


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"session": {"listen": ["tcp/0.0.0.0:7447"], "insecure": True}},
            "session.insecure: anyone on any network of the router's computer can command",
        ),
        (
            {"session": {"listen": ["tcp/10.0.0.2:7447"], "insecure": True}},
            "session.insecure: anyone on the network of the router's computer can command",
        ),
        (
            {"hosts": gpu()},
            "session.listen: the router on robot is reachable on that",
        ),
        ({"hosts": gpu()}, "hosts.gpu: looks for the router on itself, and it runs on robot"),
        ({"hosts": {"a": {"nodes": ["command"]}}}, "hosts: none runs the router"),
        ({"hosts": {"a": {"nodes": ["router"]}}}, "hosts: none runs the command node"),
        ({"hosts": {"a": {"nodes": ["router"]}}}, "hosts: none runs the simulator"),
        ({"hosts": {"a": {"nodes": ["router"]}}}, "cameras: no host runs front, wrist"),
        ({"hosts": {"a": {"nodes": ["router"]}}}, "workers: no host runs scripted"),
        (
            {"hosts": {"a": {"nodes": ["router"], "workers": ["scripted"]}}},
            "hosts.a.workers: has no effect without worker in hosts.a.nodes",
        ),
        (
            {"hosts": {"a": {"nodes": ["router"], "cameras": ["front"]}}},
            "hosts.a.cameras: has no effect without camera in hosts.a.nodes",
        ),
        (
            {"cameras": {"front": {"rate_hz": 0.5}}},
            "cameras.front.rate_hz: a picture every 2 s is older than timing.max_observation_age_s",
        ),
    ],
)
def test_what_is_odd_is_told(changes: dict[str, Any], said: str) -> None:
    found = advice(override(SIM, changes))
    assert any(line.startswith(said) for line in found), found


def test_a_host_that_looks_elsewhere_is_not_warned_about_itself() -> None:
    elsewhere = gpu(connect=["tcp/10.0.0.2:7447"])
    found = advice(override(SIM, {"hosts": elsewhere}))
    assert not any(line.startswith("hosts.gpu") for line in found)


TOOL = """
  <link name="probe"><visual><geometry><sphere radius="0.01"/></geometry></visual></link>
  <joint name="to_probe" type="fixed">
    <parent link="panda_hand"/><child link="probe"/><origin xyz="0 0 0.4"/>
  </joint>
</robot>
"""


def test_a_link_and_a_tool_without_a_collision_shape_are_named(tmp_path: Path) -> None:
    text = resources.robot_urdf(SIM.robot.description).read_text()
    path = tmp_path / "probe.urdf"
    path.write_text(text.replace("</robot>", TOOL))
    probe = {"robot": {"description": str(path), "tcp_frame": "probe"}}
    bare, tool = barriers_advice(override(SIM, probe))
    assert bare.endswith(": probe")
    assert "the TCP is 0.290 m from every collision shape" in tool


def test_the_shipped_arms_have_shapes_up_to_their_tool() -> None:
    assert list(barriers_advice(SIM)) == []


def test_a_table_that_is_not_where_the_simulator_has_it_is_told() -> None:
    raised = {"limits": {"reach": {"table_z_m": 0.25}}}
    assert "stays at 0 m" in "".join(table_advice(override(SIM, raised)))
    for others in ({}, {"limits": {"reach": {"table_z_m": None}}}):
        assert not list(table_advice(override(SIM, others)))
    assert not list(table_advice(override(load_profile("fr3"), raised)))


EXAMPLES = Path(__file__).parents[3] / "examples"


def test_a_robot_that_is_a_program_of_its_own_is_not_imported_as_a_driver() -> None:
    report = check_profile(str(EXAMPLES / "wire" / "robot.yaml"))
    assert not report.errors
    (said,) = report.advice
    assert said.startswith("hosts: none runs the node arm")
    assert "the program that is the robot" in said


@pytest.mark.parametrize("runs_here", [True, False])
def test_the_file_of_an_arm_is_checked_where_a_host_runs_it(
    runs_here: bool, tmp_path: Path
) -> None:
    (tmp_path / "helper.py").write_text("NUMBER = 7\n")
    (tmp_path / "driver.py").write_text("import helper\n")
    host = "here" if runs_here else "there"
    hosts = f"hosts: {{{host}: {{nodes: [router, arm, command]}}, other: {{nodes: [worker]}}}}"
    robot = "extends: panda_sim\nrobot: {driver: arm, command: joint}\narm: {file: driver.py}"
    path = tmp_path / "robot.yaml"
    path.write_text(f"{robot}\ncameras: {{front: null, wrist: null}}\n{hosts}\n")
    report = check_profile(str(path), "here" if runs_here else "other")
    (said,) = (each for each in (*report.errors, *report.advice) if "helper" in each)
    assert (said in report.errors) is runs_here
    assert "it lies beside the file" in said
    assert f"PYTHONPATH={tmp_path}" in said
    assert "PEP 723" not in said
