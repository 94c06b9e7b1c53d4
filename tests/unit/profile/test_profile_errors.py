"""Every fault in a profile is told with file, line, path, and what would have been right."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh import resources
from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import (
    CameraProfile,
    SessionProfile,
    as_robot,
    load_profile,
    override,
    profile_names,
)
from vla_zenoh.profile.session import SecurityProfile, is_loopback

Write = Callable[..., str]

SIM = load_profile("panda_sim")


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes a profile that begins with panda_sim, and gives its path."""

    def write(text: str, name: str = "lab.yaml", begin: str = "extends: panda_sim\n") -> str:
        path = tmp_path / name
        path.write_text(begin + text)
        return str(path)

    return write


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "own" / "profiles"
    folder.mkdir(parents=True)
    monkeypatch.setenv(resources.SEARCH_PATH_VARIABLE, str(folder.parent))
    return folder


def told(path: str) -> list[str]:
    """What is said of a profile, without the folder."""
    with pytest.raises(ProfileError) as caught:
        load_profile(path)
    return [line.replace(f"{Path(path).parent}/", "") for line in str(caught.value).splitlines()]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "limts: {}",
            r"lab.yaml:2: limts: unknown key; did you mean 'limits'? Known here: about, ",
        ),
        (
            "limits:\n  translation:\n    velocity_ms: 1",
            "lab.yaml:4: limits.translation.velocity_ms: unknown key; did you mean 'velocity_m_s'? "
            "Known here: acceleration_m_s2, jerk_m_s3, velocity_m_s",
        ),
        (
            "cameras:\n  front: {soruce: 'sim:front'}",
            "lab.yaml:3: cameras.front.soruce: unknown key; did you mean 'source'? Known here: ",
        ),
        ("limits: {step_m: true}", "lab.yaml:2: limits.step_m: wants a number (given: True)"),
        ("limits: {step_m: '0.05'}", "lab.yaml:2: limits.step_m: wants a number (given: '0.05')"),
        ("limits: {step_m: .nan}", "lab.yaml:2: limits.step_m: wants a finite number (given: nan)"),
        (
            "limits: {step_m: 1e999}",
            "lab.yaml:2: limits.step_m: wants a finite number (given: inf)",
        ),
        ("limits: {step_m: 50}", "lab.yaml:2: limits.step_m: must be at most 0.2 (given: 50)"),
        ("limits: {step_m: 0}", "lab.yaml:2: limits.step_m: must be greater than 0 (given: 0)"),
        ("sim: {seed: 1.5}", "lab.yaml:2: sim.seed: wants a whole number (given: 1.5)"),
        (
            "limits:",
            "lab.yaml:2: limits: wants a map of: approach_m_s, approach_rad_s, contact, elbow_rad,",
        ),
        (
            "limits: [1]",
            "lab.yaml:2: limits: wants a map of: approach_m_s, approach_rad_s, contact, elbow_rad,",
        ),
        ("workers: scripted", "lab.yaml:2: workers: wants a list (given: 'scripted')"),
        ("workers: [scripted, a, a]", "lab.yaml:2: workers: a: given more than once"),
        ("workers: [scripted, 'a b']", "lab.yaml:2: workers.1: name 'a b' cannot be part of a key"),
        (
            "workers: [scripted, ./nod.py]",
            "lab.yaml:2: workers: './nod.py' is a path: give that model a name, as models: "
            "{nod: ./nod.py}, and write nod here",
        ),
        (
            "models: {scriptd: ./nod.py}",
            "lab.yaml:2: models: 'scriptd' is not among workers; did you mean 'scripted'? Known: "
            "scripted",
        ),
        ("models: {scripted: 5}", "lab.yaml:2: models.scripted: wants text; put it in quotes"),
        ("models: {scripted: ''}", "lab.yaml:2: models.scripted: must not be empty"),
        ("models: {'a b': x.py}", "lab.yaml:2: models.a b: name 'a b' cannot be part of a key"),
        ("models: [scripted]", "lab.yaml:2: models: wants a map"),
        (
            "serves: {scriptd: [panda]}",
            "lab.yaml:2: serves: 'scriptd' is not among workers; did you mean 'scripted'? Known: "
            "scripted",
        ),
        (
            "serves:\n  scripted: [left, right]",
            "lab.yaml:3: serves.scripted: lacks panda, the robot of this profile: name all that",
        ),
        ("serves: {scripted: panda}", "lab.yaml:2: serves.scripted: wants a list (given: 'panda')"),
        ("serves: {scripted: []}", "lab.yaml:2: serves.scripted: "),
        ("serves: {scripted: [panda, b, b]}", "serves.scripted: b: given more than once"),
        ("serves: {scripted: [panda, b/c]}", "serves.scripted.1: name 'b/c' cannot be part of a"),
        ("serves: [panda]", "lab.yaml:2: serves: wants a map"),
        ("options: {scriptd: {a: b}}", "lab.yaml:2: options: 'scriptd' is not among workers; did"),
        ("options: {scripted: {a-b: c}}", "options.scripted.a-b: 'a-b' cannot be the name of an"),
        ("options: {scripted: {dt_s: 0.1}}", "options.scripted.dt_s: wants text; put it in quotes"),
        ("about: 5", "lab.yaml:2: about: wants text; put it in quotes (given: 5)"),
        ('about: "\\ud800"', "lab.yaml:2: about: holds half a character (a surrogate)"),
        (
            "session: {shared_memory: yes}",
            "session.shared_memory: wants true or false (given: 'yes')",
        ),
        (
            "session: {router: zenod}",
            "wants 'own' or 'zenohd'; did you mean 'zenohd'? (given: 'zenod')",
        ),
        ("session: {mode: peer}", "session.mode: "),
        ("root: lab/*", "lab.yaml:2: root: root '*' cannot be part of a key"),
        (
            "limits:\n  workspace:\n    x_m: [200, 750]",
            "lab.yaml:4: limits.workspace.x_m: [200, 750] is beyond 3 m; give metres",
        ),
        (
            "limits: {workspace: {z_m: [0.9, 0.1]}}",
            "limits.workspace.z_m: [0.9, 0.1] is empty: give [smallest, largest]",
        ),
        (
            "limits: {workspace: {z_m: [0.9]}}",
            "limits.workspace.z_m.1: is missing: the list is too",
        ),
        (
            "limits: {workspace: {z_m: [0, 1, 2]}}",
            "limits.workspace.z_m: has 3 entries, at most 2 fit",
        ),
        ("limits: {step_m: 0.2}", "limits.step_m: is 0.2, longer than the leash lead_m (0.15)"),
        (
            "limits: {step_rad: 0.7}",
            "limits.step_rad: is 0.7, longer than the leash lead_rad (0.6)",
        ),
        (
            "limits: {reach: {collision_slow_m: 0.01}}",
            "limits.reach.collision_stop_m: is 0.02, which must not be above collision_slow_m",
        ),
        (
            "timing:\n  command_hz: 50\n  command_timeout_s: 0.05",
            "lab.yaml:4: timing.command_timeout_s: is 0.05, less than 3 periods of command_hz (50)",
        ),
        (
            "timing: {command_hz: 50, watchdog_s: 0.05}",
            "timing.watchdog_s: is 0.05, less than 3 periods of command_hz (50)",
        ),
        (
            "timing: {state_hz: 20, state_timeout_s: 0.14}",
            "timing.state_timeout_s: is 0.14, less than 3 periods of state_hz (20)",
        ),
        ("robot:\n  home_rad: [0, 0]", "lab.yaml:3: robot.home_rad: has 2 angles for 7 arm_joints"),
        (
            "robot: {home_rad: [0, -45, 0, -135, 0, 90, 45]}",
            "robot.home_rad.1: is -45: more than a turn; give radians",
        ),
        (
            "robot: {finger_joints: [panda_joint1]}",
            "finger_joints: repeats arm_joints: panda_joint1",
        ),
        (
            "robot: {gripper: {max_width_m: 0.01, dead_band_m: 0.02}}",
            "robot.gripper.dead_band_m: must be less than max_width_m (0.01): nothing would move",
        ),
        (
            "robot: {gripper: {joint_open_rad: 0}}",
            "lab.yaml:2: robot.gripper.joint_open_rad: needs joint_shut_rad beside it",
        ),
        (
            "robot: {gripper: {joint_open_rad: 0, joint_shut_rad: 45}}",
            "robot.gripper.joint_shut_rad: is 45: more than a turn; give radians",
        ),
        (
            "robot: {gripper: {joint_open_m: 0.0, joint_shut_m: 0.0}}",
            "robot.gripper.joint_shut_m: is that of joint_open_m: nothing would move",
        ),
        (
            "robot: {gripper: {joint_open_rad: 0, joint_shut_rad: 1, joint_open_m: 0.1,"
            " joint_shut_m: 0}}",
            "robot.gripper.joint_open_m: is for a joint that slides, joint_open_rad for one",
        ),
        (
            "ros2: {pose_command: {topic: /t, type: geometry_msgs/msg/PoseStamped}, "
            "gripper: {topic: /g, type: control_msgs/action/GripperCommand}}",
            "ros2.gripper.position: is missing: does the driver take the m between the fingers",
        ),
        (
            "ros2: {pose_command: {topic: /t, type: geometry_msgs/msg/PoseStamped}, "
            "gripper: {topic: /g, type: std_msgs/msg/Float64, position: joint}}",
            "ros2.gripper.position: is joint, which needs joint_open_rad and joint_shut_rad",
        ),
        (
            "ros2: {pose_command: {topic: /t, type: geometry_msgs/msg/PoseStamped}, "
            "gripper: {topic: /g, type: franka_msgs/action/Move, position: finger}}",
            "ros2.gripper.position: is not for franka_msgs/action/Move, which takes the width",
        ),
        (
            "robot: {driver: ros}",
            "wants 'sim', 'ros2' or 'arm'; did you mean 'ros2'? (given: 'ros')",
        ),
        ("robot: {tcp_frame: ''}", "robot.tcp_frame: must not be empty"),
        (
            "task: {worker: scritped}",
            "task.worker: 'scritped' is not among workers; did you mean 'scrip",
        ),
        ("task: {prompt: true}", "task.prompt: wants text; put it in quotes (given: True)"),
        (
            "cameras: {front: {source: webcam}}",
            "'webcam' is not a camera: write one of sim:CAMERA, v4l2",
        ),
        ("cameras: {front: {source: 'sim:'}}", "'sim:' is not a camera: write one of sim:CAMERA"),
        (
            "cameras: {front: {source: 'rtsp://'}}",
            "'rtsp://' lacks the host: write rtsp://HOST/PATH",
        ),
        ("cameras: {front: {source: 'ros2:/a'}}", "is 'ros2:/a', which needs a section ros2"),
        ("cameras: {'a/b': {source: 'sim:x'}}", "cameras.a/b: name 'a/b' cannot be part of a key"),
        ("hosts: {}", "lab.yaml:2: hosts: is empty: name at least one host and its nodes"),
        ("hosts: {a: {nodes: []}}", "lab.yaml:2: hosts.a.nodes: has 0 entries, wants at least 1"),
        ("hosts: {a: {}}", "lab.yaml:2: hosts.a.nodes: is missing"),
        (
            "hosts:\n  a:\n    nodes: [router, camer]",
            "lab.yaml:4: hosts.a.nodes.1: wants 'router', 'sim', 'ros2', 'arm', 'camera', "
            "'command' or 'worker'; did you mean 'camera'?",
        ),
        ("hosts: {a: {nodes: [sim, sim]}}", "hosts.a.nodes: sim: given more than once"),
        (
            "hosts:\n  a: {nodes: [camera], cameras: [frnt]}",
            "lab.yaml:3: hosts.a.cameras: 'frnt' is not among cameras; did you mean 'front'? "
            "Known: front, wrist",
        ),
        (
            "hosts: {a: {nodes: [worker], workers: [vla]}}",
            "hosts.a.workers: 'vla' is not among workers Known: scripted",
        ),
        (
            "hosts: {a: {nodes: [command]}, b: {nodes: [command]}}",
            "hosts.b.nodes: command runs on a and b: the robot obeys one command node",
        ),
        (
            "hosts: {a: {nodes: [router]}, b: {nodes: [router]}}",
            "hosts.b.link: is missing: routers do not discover each other, and a runs one as well",
        ),
        (
            "hosts: {a: {nodes: [worker]}, b: {nodes: [worker]}}",
            "hosts.b.workers: scripted runs on a and b: each key has one writer. List on each host",
        ),
        (
            "hosts: {a: {nodes: [camera], cameras: [wrist]}, b: {nodes: [camera]}}",
            "hosts.b.cameras: wrist runs on a and b: each key has one writer",
        ),
        (
            "session: {listen: [tcp/10.0.0.2:7447]}",
            "session.listen.0: lets anyone on that network command the robot. Make certificates",
        ),
        (
            "session: {listen: [tls/10.0.0.2:7447]}",
            "session.listen.0: tls needs certificates: make them with `vla-zenoh secure init`",
        ),
        (
            "session: {security: {}, listen: [tls/a:1], connect: [tcp/a:1]}",
            "session.connect.0: tcp verifies no certificate, but there is a section security",
        ),
        (
            "session: {security: {}, listen: [tls/a:1], connect: [tls/a:1], insecure: true}",
            "session.insecure: is true, beside a section security: leave one out",
        ),
        (
            "session: {security: {people: {desk: boss}}, listen: [tls/a:1], connect: [tls/a:1]}",
            "session.security.people.desk: wants 'operator', 'viewer' or 'replay'",
        ),
        (
            "hosts: {a: {nodes: [router, sim, camera, command], pictures: {rate_hz: 5}}}",
            "hosts.a.pictures: is for workers, and this host runs none",
        ),
        (
            "hosts: {a: {nodes: [router, sim, camera, command, worker], pictures: {}}}",
            "hosts.a.pictures: is for cameras elsewhere, and this host has its own",
        ),
        (
            "session: {separate_links: true, connect: [tcp/127.0.0.1:65535]}",
            "session.connect.0: separate_links needs PROTOCOL/HOST:PORT, and the next port too",
        ),
        (
            "hosts: {a: {nodes: [router], listen: [tcp/10.0.0.3:7447]}}",
            "hosts.a.listen.0: lets anyone on that network command the robot",
        ),
        (
            "hosts: {a: {nodes: [command], link: [tcp/127.0.0.1:7447]}}",
            "hosts.a.link: is for a router, and this host runs none",
        ),
        ("robot: {driver: ros2}", "ros2: is missing: robot.driver is ros2"),
        ("robot: {driver: ros2}", "cameras.wrist.source: is 'sim:wrist', and robot.driver is ros2"),
        ("robot: {driver: ros2}", "hosts.here.nodes: has sim, and robot.driver is ros2"),
        (
            "ros2: {pose_command: {topic: pose, type: a}}",
            "'pose' is not a ROS topic: write its full name",
        ),
        (
            "ros2: {pose_command: {topic: /p, type: a}}",
            "ros2.pose_command.type: 'a' is not a ROS type: write package/msg/Name",
        ),
        (
            "robot: {driver: ros2}\nros2: {domain: 1}",
            "ros2: lacks pose_command: robot.command is pose",
        ),
        (
            "cameras: {front: {source: 'ros2:/a'}}\nros2: {cameras: {front: {topic: /b}}}",
            "ros2.cameras.front.topic: is not that of cameras.front: 'ros2:/a'",
        ),
        (
            "ros2: {gripper: {topic: /g, type: std_msgs/msg/Float64, grasp: /h}}",
            "ros2.gripper.grasp: goes with type franka_msgs/action/Move only",
        ),
        (
            "ros2: {joint_command: {topic: /j, type: std_msgs/msg/Float64}}",
            "ros2.joint_command.type: is std_msgs/msg/Float64: joints are sent as trajectory_msgs/",
        ),
        (
            "hosts: {a: {nodes: [ros2]}}",
            "hosts.a.nodes: has ros2, which needs a section ros2",
        ),
        (
            "ros2: {cameras: {frotn: {topic: /f}}}",
            "ros2.cameras: 'frotn' is not among cameras; did you mean 'front'?",
        ),
        ("session: {connect: []}", "session.connect: is empty: nodes need a router"),
        ("session: {listen: []}", "session.listen: is empty: the router needs an address"),
        ("session: {connect: ['tcp/a:0']}", "session.connect.0: port 0 leads nowhere"),
        ("session: {lease_ms: 10}", "session.lease_ms: must be at least 200 (given: 10)"),
        ("extends: panda_simm", "extends is given twice"),
    ],
)
def test_a_fault_is_told_so_that_it_can_be_mended(write: Write, text: str, said: str) -> None:
    lines = told(write(text))
    assert any(said in line for line in lines), lines
    assert all(re.match(r"[\w./]+\.yaml:\d+: ", line) for line in lines), lines


def test_every_fault_of_a_file_is_told_at_once(write: Write) -> None:
    text = "limts: {}\nlimits: {step_m: 9}\ntiming: {state_hz: 1}\nsession: {connect: [x]}\n"
    assert [line.split(":")[1] for line in told(write(text))] == ["3", "4", "5", "2"]


def test_a_fault_in_what_is_extended_is_told_with_its_own_file(write: Write) -> None:
    write("limits: {step_m: 9}\nabout: base\n", "base.yaml")
    child = write("about: child\nlimts: {}\n", "child.yaml", begin="extends: base\n")
    assert told(child) == [
        "base.yaml:2: limits.step_m: must be at most 0.2 (given: 9)",
        told(child)[1],
    ]
    assert told(child)[1].startswith("child.yaml:3: limts: unknown key")


def test_a_replaced_section_does_not_keep_the_lines_of_the_old_one(write: Write) -> None:
    write("hosts:\n  a: {nodes: [worker]}\n", "base.yaml")
    child = write("hosts:\n  a: {}\n", "child.yaml", begin="extends: base\n\n\n")
    assert told(child) == ["child.yaml:5: hosts.a.nodes: is missing"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"lab.yaml:1: robot: is missing: describe the robot, or start from another profile"),
        ("# only a remark\n", "lab.yaml:1: robot: is missing"),
        ("- a\n", "lab.yaml:1: a profile is a map of sections, this is a list"),
        ("robot: {name: a}\n", "lab.yaml:1: robot.description: is missing"),
        ("extends: nobody\n", "lab.yaml:1: extends: no profile called 'nobody'"),
        (
            "\nextends: panda_sin\n",
            "lab.yaml:2: extends: no profile called 'panda_sin'; did you mean",
        ),
        ("extends: [panda_sim]\n", "lab.yaml:1: extends: wants the name of one profile"),
        ("extends:\n", "lab.yaml:1: extends: wants the name of one profile"),
        ("extends: lab\n", "lab.yaml:1: extends: 'lab' is this file, and no other profile"),
        ("extends: ./lab.yaml\n", "profiles extend each other in a circle"),
        ("extends: absent.yaml\n", "lab.yaml:1: extends: there is no file or folder 'absent.yaml'"),
        ('extends: "a\\0b"\n', "lab.yaml:1: extends: "),
        ("extends: ~nobody_here/x.yaml\n", "lab.yaml:1: extends: '~nobody_here/x.yaml' cannot be"),
        (f"extends: {'x' * 5000}\n", "cannot be the name of a profile"),
    ],
)
def test_a_beginning_that_is_wrong_is_told(write: Write, text: str, said: str) -> None:
    assert said in told(write(text, begin=""))[0]


def test_profiles_that_extend_each_other_are_refused(write: Write) -> None:
    one = write("", "one.yaml", begin="extends: two\n")
    write("", "two.yaml", begin="extends: one\n")
    assert "one.yaml:1: profiles extend each other in a circle" in told(one)[0]
    assert "one.yaml -> two.yaml -> one.yaml" in told(one)[0]


def test_a_long_line_of_ancestors_is_refused(write: Write) -> None:
    write("", "p0.yaml")
    for number in range(1, 9):
        path = write("", f"p{number}.yaml", begin=f"extends: p{number - 1}\n")
    assert "too deep" in told(path)[0]


@pytest.mark.parametrize(
    "name", ["", "nobody", "/nobody.yaml", "a\0b", "x" * 5000, "~nobody_here/x.yaml"]
)
def test_a_name_that_leads_nowhere_is_one_error(name: str) -> None:
    with pytest.raises(ProfileError) as caught:
        load_profile(name)
    assert len(str(caught.value)) < 6000


def test_a_folder_or_a_pipe_is_not_a_profile(tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    os.mkfifo(tmp_path / "pipe.yaml")
    for name in ("folder", "pipe"):
        with pytest.raises(ProfileError, match=rf"{name}\.yaml is not a file"):
            load_profile(str(tmp_path / f"{name}.yaml"))


# -- own profiles -----------------------------------------------------------------------------
def test_an_own_profile_stands_before_the_shipped_one(own_folder: Path) -> None:
    (own_folder / "panda_sim.yaml").write_text("extends: panda_sim\nabout: mine\nsim: {seed: 7}\n")
    profile = load_profile("panda_sim")
    assert (profile.about, profile.sim.seed, profile.name) == ("mine", 7, "panda_sim")
    assert profile.robot.arm_joints[0] == "panda_joint1"


def test_who_extends_a_name_gets_the_own_one(own_folder: Path) -> None:
    (own_folder / "panda_sim.yaml").write_text("extends: panda_sim\nsim: {seed: 7}\n")
    (own_folder / "lab.yaml").write_text("extends: panda_sim\n")
    assert load_profile("lab").sim.seed == 7
    assert load_profile("panda_sim_two_hosts").sim.seed == 0  # shipped ones keep to each other


def test_the_next_of_three_is_meant(
    own_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    second = tmp_path / "second" / "profiles"
    second.mkdir(parents=True)
    path = os.pathsep.join([str(own_folder.parent), str(second.parent)])
    monkeypatch.setenv(resources.SEARCH_PATH_VARIABLE, path)
    (own_folder / "panda_sim.yaml").write_text("extends: panda_sim\nsim: {seed: 7}\n")
    (second / "panda_sim.yml").write_text("extends: panda_sim\nabout: second\nsim: {seed: 6}\n")
    profile = load_profile("panda_sim")
    assert (profile.sim.seed, profile.about) == (7, "second")


def test_a_file_elsewhere_may_extend_its_own_name(write: Write) -> None:
    assert load_profile(write("sim: {seed: 7}", "panda_sim.yaml")).sim.seed == 7


def test_a_profile_beside_it_is_extended_first(write: Write) -> None:
    write("sim: {seed: 3}", "base.yml")
    assert load_profile(write("", "a.yaml", begin="extends: base\n")).sim.seed == 3
    assert load_profile(write("", "b.yaml", begin="extends: base.yml\n")).sim.seed == 3


def test_own_names_are_listed(own_folder: Path) -> None:
    (own_folder / "lab.yaml").write_text("extends: panda_sim\n")
    assert "lab" in profile_names()


# -- merging ----------------------------------------------------------------------------------
def test_sections_are_merged_and_lists_and_hosts_replaced(write: Write) -> None:
    base = load_profile("panda_sim")
    profile = load_profile(
        write(
            "limits: {translation: {velocity_m_s: 0.1}}\nworkers: [scripted, replay]\n"
            "hosts: {lab: {nodes: [router]}}\n"
        )
    )
    assert profile.limits.translation.velocity_m_s == 0.1
    assert profile.limits.translation.jerk_m_s3 == base.limits.translation.jerk_m_s3
    assert profile.limits.workspace == base.limits.workspace
    assert profile.workers == ("scripted", "replay")
    assert list(profile.hosts) == ["lab"]


def test_null_takes_an_inherited_camera_away(write: Write) -> None:
    assert list(load_profile(write("cameras: {wrist: null}")).cameras) == ["front"]
    assert (
        "cameras.side: wants a map of: check, fit_for_workers, height"
        in told(write("cameras: {side: null}"))[0]
    )


def test_options_of_a_worker_are_merged_with_those_inherited_and_null_ends_them(
    write: Write,
) -> None:
    write("options: {scripted: {a: b, c: d}}", "base.yaml")
    more = write("options: {scripted: {c: 'no'}}", "more.yaml", begin="extends: base\n")
    assert load_profile(more).options == {"scripted": {"a": "b", "c": "no"}}
    none = write("options: {scripted: null}", begin="extends: base\n")
    assert load_profile(none).options == {}


def test_null_ends_that_a_worker_serves_several_robots(write: Write) -> None:
    several = load_profile(write("serves: {scripted: [panda, left]}", "several.yaml"))
    assert several.serves == {"scripted": ("panda", "left")}
    alone = write("serves: {scripted: null}", begin="extends: several\n")
    assert load_profile(alone).serves == {}


def test_a_robot_called_otherwise_is_served_by_those_who_name_it() -> None:
    served = {"workers": ["scripted", "twin"], "serves": {"scripted": ["panda", "left"]}}
    several = override(SIM, served | {"task": {"worker": "twin"}})
    assert as_robot(several, "left").serves == several.serves
    assert as_robot(several, "other").serves == {}
    with pytest.raises(ProfileError, match="name 'a b' cannot"):
        as_robot(several, "a b")


def test_values_given_otherwise_are_checked_as_a_whole() -> None:
    profile = load_profile("panda_sim")
    other = override(profile, {"session": {"connect": ["tcp/10.0.0.2:7447"]}})
    assert other.session.connect == ("tcp/10.0.0.2:7447",)
    assert other.session.listen == profile.session.listen
    assert override(profile, {}) == profile
    with pytest.raises(ProfileError, match=r"^session\.connect\.0: 'x' is not an endpoint"):
        override(profile, {"session": {"connect": ["x"]}})


# -- endpoints --------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("endpoint", "here"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/127.8.9.1:7447", True),
        ("tcp/localhost:7447#iface=lo", True),
        ("tcp/[::1]:7447", True),
        ("unixsock-stream/run/vla.sock", True),
        ("tcp/localhost.lab.edu:7447", False),
        ("tcp/127.lab:7447", False),
        ("tcp/127.0.0.1.lab.edu:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/[::1234]:7447", False),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/10.0.0.2:7447", False),
    ],
)
def test_only_what_cannot_be_another_computer_is_loopback(endpoint: str, here: bool) -> None:
    assert is_loopback(endpoint) is here
    if here:
        assert SessionProfile(listen=(endpoint,)).listen == (endpoint,)
    else:
        with pytest.raises(ValueError, match="lets anyone on that network command the robot"):
            SessionProfile(listen=(endpoint,))


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "tcp/[fe80::1%eth0]:7447",
        "udp/lab-pc.example.org:7447",
        "tls/robot:7447#root_ca_certificate=ca.pem",
        "quic/10.0.0.2:7447",
        "ws/10.0.0.2:80",
        "tcp/10.0.0.2:7447?prio=1-3#iface=eth0",
        "unixsock-stream/run/vla.sock",
    ],
)
def test_an_endpoint_that_is_taken_is_one_that_zenoh_takes(endpoint: str) -> None:
    security = SecurityProfile() if endpoint.startswith(("tls", "quic")) else None
    listen = ("tls/127.0.0.1:7447" if security else "tcp/127.0.0.1:7447",)
    session = SessionProfile(connect=(endpoint,), listen=listen, security=security)
    assert session.connect == (endpoint,)
    zenoh.Config.from_json5(f'{{connect: {{endpoints: ["{endpoint}"]}}}}')


@pytest.mark.parametrize(
    ("endpoint", "said"),
    [
        ("10.0.0.2:7447", "is not an endpoint: write tcp/HOST:PORT"),
        ("", "is not an endpoint"),
        ("tpc/10.0.0.2:7447", r"unknown protocol; did you mean 'tcp'\? Known: tcp, udp, tls, quic"),
        ("http/10.0.0.2:80", "unknown protocol Known: tcp"),
        ("tcp/10.0.0.2", "write tcp/HOST:PORT, as tcp/10.0.0.2:7447"),
        ("tcp/:7447", "write tcp/HOST:PORT"),
        ("tcp/10.0.0.2:port", "write tcp/HOST:PORT"),
        ("tcp/10.0.0.2:99999", "a port is at most 65535"),
        ("tcp//10.0.0.2:7447", "write tcp/HOST:PORT"),
        ("tcp/::1:7447", "write tcp/HOST:PORT"),
        ("tcp/a b:7447", "write tcp/HOST:PORT"),
        ("unixsock-stream/", "write unixsock-stream/PATH"),
    ],
)
def test_an_endpoint_that_leads_nowhere_is_refused(endpoint: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        SessionProfile(connect=(endpoint,))


@pytest.mark.parametrize(
    "source",
    ["sim:front", "v4l2:/dev/video0", "v4l2:0", "rtsp://h/a", "rtsps://h", "file:a.mp4", "ros2:/a"],
)
def test_every_sort_of_camera_is_taken(source: str) -> None:
    assert CameraProfile(source=source).source == source


# -- anything ---------------------------------------------------------------------------------
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=6),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=6,
)
SECTIONS = st.sampled_from(
    [
        "robot",
        "limits",
        "timing",
        "cameras",
        "sim",
        "workers",
        "task",
        "session",
        "hosts",
        "ros2",
        "root",
    ]
)


@given(SECTIONS, VALUES)
def test_a_section_may_hold_anything_and_is_refused_or_read(section: str, value: object) -> None:
    # Any error but ProfileError goes on to pytest.
    with contextlib.suppress(ProfileError):
        assert override(SIM, {section: value}) is not None
