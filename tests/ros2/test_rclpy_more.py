"""Further robots of ROS 2's own rclpy: names, domains, QoS, clocks and links as labs have them."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from camera_rig import free_endpoint, until
from chain import LONG_PATIENCE_S, running_chain

pytest.importorskip("ros_messages", exc_type=ImportError)

from bridge import Bridge, generated
from rclpy_rig import (
    BY_ACTION,
    LOSSY,
    STRING,
    Arm,
    Program,
    RosLab,
    WallClock,
    camera_settings,
    carry_out,
    heard,
    library,
    pictures,
    publish,
    request,
    running_ros_lab,
    write_profile,
)
from ros_node import free_domain

from vla_zenoh.errors import SessionError

if TYPE_CHECKING:
    from chain import Chain

pytestmark = [pytest.mark.rclpy, pytest.mark.slow]

STEP_M, EXACT_M = 0.01, 1e-6
STANDS_M = 1e-6
CALL_S = 20.0
LEASE_PATIENCE_S = 45.0
"""Fast DDS gives a participant up after 20 s; then the bridge is asked every few seconds."""


def up_and_down(lab: RosLab) -> None:
    """Five steps up and eight down, exactly."""
    began_m = lab.activate_at_rest()[2, 3]
    up_m = carry_out(lab, "go up", 5)[2, 3]
    down_m = carry_out(lab, "go down", 8)[2, 3]
    assert up_m - began_m == pytest.approx(5 * STEP_M, abs=EXACT_M), lab.story()
    assert down_m - up_m == pytest.approx(-8 * STEP_M, abs=EXACT_M), lab.story()


# -- names and domains ----------------------------------------------------------------------------
@contextmanager
def two_robots(
    folder: Path, program: Path, distribution: str
) -> Iterator[tuple[list[Arm], list[Chain], Program]]:
    """Two robots of one domain, apart by their namespaces, behind one bridge."""
    domain, ours = free_domain(), free_endpoint()
    made = pictures(folder / "pictures", 160, 120)
    assert made
    with ExitStack() as stack:
        arms, chains = [], []
        person = Program("person", distribution, domain).start()
        stack.callback(person.end)
        for name in ("robot1", "robot2"):
            space = f"/{name}"
            arms.append(Arm(distribution, domain, namespace=space).start())
            stack.callback(arms[-1].end)
            seen = camera_settings(folder / "pictures", space)
            eyes = Program("camera", distribution, domain, seen).start()
            stack.callback(eyes.end)
            endpoint = ours if name == "robot1" else None
            reach = "" if name == "robot1" else f'  connect: ["{ours}"]\n'
            profile = write_profile(
                folder,
                distribution,
                domain,
                endpoint=endpoint,
                space=space,
                name=name,
                patience_s=LONG_PATIENCE_S,
                more=f"  prefix: {space}/vla\n{reach}",
            )
            if name == "robot1":
                settings = generated(profile, beside=True, all_names=True)
                bridge = Bridge(program, folder, settings, distribution).start()
                stack.callback(bridge.kill)
            chains.append(stack.enter_context(running_chain(folder, profile_file=profile)))
            chains[-1].recorder.only = {"state": "ros2#", "command": "command#"}
        yield arms, chains, person


def test_two_robots_of_one_domain_move_each_by_its_own_topics(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    with two_robots(tmp_path, built_bridge, distribution) as (arms, chains, person):
        for chain in chains:
            chain.activate_when_ready()
            chain.settle()
        for mine, chain in enumerate(chains):
            before = [arm.wait_still()[:3, 3] for arm in arms]
            text = json.dumps({"prompt": "HARD: go up x5", "active": True})
            topic = f"/robot{mine + 1}/vla/request"
            publish(chains[0].session, person, topic, STRING, {"data": text})
            chain.wait_done("HARD: go up x5", 5, 20.0)
            chain.wait_arrived()
            after = [arm.wait_still()[:3, 3] for arm in arms]
            assert after[mine] - before[mine] == pytest.approx((0, 0, 5 * STEP_M), abs=EXACT_M)
            assert after[1 - mine] == pytest.approx(before[1 - mine], abs=STANDS_M)
            chain.settle()


def test_a_robot_whose_launch_file_remaps_its_names_moves_exactly(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    names = ("joint_states", "desired_pose", "gripper_width")
    remapped = [word for name in names for word in ("-r", f"{name}:=/cell/{name}")]
    launched = {"arguments": ["--ros-args", *remapped, "-r", "__node:=panda_of_a_cell"]}
    with running_ros_lab(tmp_path, built_bridge, distribution, arm=launched, space="/cell") as lab:
        lab.chain.activate_when_ready()
        lab.settle()
        up_and_down(lab)


def test_a_robot_of_another_domain_is_not_seen_and_the_wrong_domain_is_told(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    theirs = free_domain()
    ours = (theirs + 1 - 20) % 80 + 20
    profile = write_profile(tmp_path, distribution, ours)
    config = generated(profile, beside=True).replace(f'"domain": {ours}', f'"domain": {theirs}')
    with ExitStack() as stack:
        bridge = Bridge(built_bridge, tmp_path, config, distribution).start()
        stack.callback(bridge.kill)
        arm = Arm(distribution, ours).start()
        stack.callback(arm.end)
        chain = stack.enter_context(running_chain(tmp_path, profile_file=profile))
        chain.until("a status", lambda: chain.detail("ros2_faults", "ros2"), 30.0)
        said = chain.detail("ros2_faults", "ros2")["ros_domain"]
        assert str(theirs) in said
        assert str(ours) in said
        with pytest.raises(SessionError):
            chain.client.activate()


def test_a_bridge_with_settings_older_than_the_profile_is_named(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    domain = free_domain()
    profile = write_profile(tmp_path, distribution, domain)
    config = generated(profile, beside=True)
    assert "^/desired_pose$" in config
    config = config.replace("^/desired_pose$", "^/pose_of_yesterday$")
    with ExitStack() as stack:
        bridge = Bridge(built_bridge, tmp_path, config, distribution).start()
        stack.callback(bridge.kill)
        arm = Arm(distribution, domain).start()
        stack.callback(arm.end)
        chain = stack.enter_context(running_chain(tmp_path, profile_file=profile))
        why = chain.until(
            "it is told",
            lambda: (chain.detail("ros2_faults", "ros2") or {}).get("not_routed"),
            30.0,
        )
        assert "bridge-config" in why


# -- QoS, encodings, bytes ------------------------------------------------------------------------
def test_cameras_of_every_reliability_and_states_of_a_bag_are_read(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    def other_way_round(settings: dict[str, Any]) -> None:
        front, wrist = settings["topics"]
        front.update(encoding="bgr8", reliable=True)
        wrist.update(reliable=False)

    bag = {"serialized": True, "states": {"reliable": False}}
    with running_ros_lab(
        tmp_path, built_bridge, distribution, arm=bag, cameras=other_way_round
    ) as lab:
        lab.chain.activate_when_ready()
        lab.settle()
        up_and_down(lab)


def test_a_controller_that_asks_for_the_last_pose_gets_no_old_one(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    """Transient local at the robot: what it is told when it comes back is where it stands."""
    late = {"goals": {"transient_local": True, "depth": 1}}
    with running_ros_lab(tmp_path, built_bridge, distribution, arm=late) as lab:
        lab.chain.activate_when_ready()
        lab.settle()
        up_and_down(lab)
        lab.settle()
        lab.arm.kill()
        time.sleep(0.5)
        lab.arm.start()
        since_ns = time.monotonic_ns()
        time.sleep(2.0)
        _, goals = lab.arm.goals(since_ns)
        print(f"\n{len(goals)} poses after the restart")
        home = lab.arm.tcp()[:3, 3]
        assert np.linalg.norm(goals - home, axis=1).max(initial=0.0) < STANDS_M, goals


def test_a_robot_that_subscribes_best_effort_and_is_restarted_gets_no_old_pose(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    """Nothing is kept for it. One that is reliable gets one, see test_rclpy_faults.py.

    What it gets is one of ours: to stay where it is.
    """
    eager = {"goals": {"reliable": False, "depth": 1}}
    with running_ros_lab(tmp_path, built_bridge, distribution, arm=eager) as lab:
        lab.chain.activate_when_ready()
        lab.settle()
        lab.move()
        time.sleep(0.2)
        lab.arm.kill()
        lab.chain.until("inactive", lambda: lab.chain.state() == "inactive")
        since_ns = time.monotonic_ns()
        lab.arm.start()
        lab.arm.wait_still()
        time.sleep(2.0)
        _, goals = lab.arm.goals(since_ns)
        home = lab.arm.tcp()[:3, 3]
        assert np.linalg.norm(goals - home, axis=1).max(initial=0.0) < STANDS_M, goals


def test_a_robot_that_the_bridge_lost_after_a_restart_is_named_with_the_remedy(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    """The bridge knows nodes by name, and ends the routes when the lease of the old one ends."""
    with running_ros_lab(tmp_path, built_bridge, distribution) as lab:
        lab.chain.activate_when_ready()
        lab.settle()
        lab.arm.kill()
        lab.arm.start()

        def faults() -> dict[str, str]:
            return lab.chain.detail("ros2_faults", "ros2")

        why = lab.chain.until("it is told", lambda: faults().get("not_routed"), LEASE_PATIENCE_S)
        assert "restart the bridge" in why
        with pytest.raises(SessionError, match="not listening"):
            lab.chain.client.activate()
        lab.bridge.kill()
        lab.bridge.start()
        lab.chain.activate_when_ready()
        lab.settle()
        up_and_down(lab)
        lab.chain.until("it is routed", lambda: "not_routed" not in faults())


def test_a_node_on_fast_dds_3_that_the_bridge_does_not_match_is_named_with_the_remedy(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    """Without the settings of the docs a node that is started again is never heard."""
    if distribution != "kilted":
        pytest.skip("Fast DDS 3 comes with Kilted")
    without = {"environ": {"FASTDDS_DEFAULT_PROFILES_FILE": ""}}
    with running_ros_lab(tmp_path, built_bridge, distribution, arm=without) as lab:
        lab.chain.activate_when_ready()
        lab.settle()
        lab.arm.kill()
        lab.arm.start()
        why = lab.chain.until(
            "it is told",
            lambda: (lab.chain.detail("ros2_faults", "ros2") or {}).get("not_matched"),
            LEASE_PATIENCE_S,
        )
        assert "/joint_states" in why
        assert "fastdds.type_propagation" in why


# -- services on Fast DDS -------------------------------------------------------------------------
def test_a_caller_of_our_services_on_fast_dds_is_named_and_its_topic_stops_the_arm(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    """The bridge carries no call of Fast DDS: the caller waits, and the status tells why."""
    with (
        running_ros_lab(tmp_path, built_bridge, distribution, more="  services: true\n") as lab,
        ExitStack() as stack,
    ):
        lab.chain.activate_when_ready()
        lab.settle()
        lab.move()
        caller = Program("person", distribution, lab.domain).start()
        stack.callback(caller.end)
        caller.do("call", service="/vla/stop", type="std_srvs/srv/Trigger", patience_s=CALL_S)
        why = lab.chain.until(
            "it is told",
            lambda: lab.chain.detail("ros2_faults", "ros2").get("services_middleware"),
            CALL_S,
        )
        assert "Fast DDS" in why
        assert "topics below /vla" in why
        assert lab.chain.state() != "stopped"
        assert request(lab, "stop")["ok"]
        assert lab.chain.state() == "stopped"
        said = until("the call is given up", lambda: caller.since(0, "called"), 2 * CALL_S)
        assert said[0]["found"]
        assert said[0]["answer"] is None


# -- the gripper's actions ------------------------------------------------------------------------
def test_a_gripper_action_on_fast_dds_is_named_and_the_arm_moves(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    """Move and Grasp stand on services, which the bridge does not carry to Fast DDS."""
    with running_ros_lab(
        tmp_path, built_bridge, distribution, arm={"actions": True}, gripper=BY_ACTION
    ) as lab:
        faults = lab.chain.until(
            "it is told", lambda: lab.chain.detail("ros2_faults", "ros2") or None, 30.0
        )
        assert "topic" in faults["gripper_middleware"]
        lab.chain.activate_when_ready()
        lab.settle()
        up_and_down(lab)
        lab.chain.client.set_prompt("HARD: close gripper x1")
        lab.chain.until("it is rejected", lambda: lab.chain.refused().get("ros2.middleware"), 10.0)
        assert lab.arm.width_m() == pytest.approx(0.08)


# -- clocks and links -----------------------------------------------------------------------------
@pytest.mark.parametrize("speed", [1.0, 0.5])
def test_a_robot_of_simulated_time_moves_exactly(
    tmp_path: Path, built_bridge: Path, distribution: str, speed: float
) -> None:
    with running_ros_lab(
        tmp_path,
        built_bridge,
        distribution,
        arm={"sim_time": speed},
        more="  use_sim_time: true\n",
    ) as lab:
        lab.chain.activate_when_ready()
        lab.settle()
        up_and_down(lab)


def test_a_robot_whose_clock_is_3_s_off_is_not_activated(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    clock = WallClock(tmp_path, 3.0)
    with running_ros_lab(
        tmp_path, built_bridge, distribution, arm={"environ": clock.environ}
    ) as lab:
        lab.chain.until("states", lambda: lab.chain.recorder.newest_state(), 30.0)
        with pytest.raises(SessionError, match="clock"):
            lab.chain.client.activate()
        clock.set(0.0)
        lab.chain.activate_when_ready()
        lab.settle()
        up_and_down(lab)


def test_with_five_per_cent_of_the_robots_datagrams_lost_the_arm_moves_exactly(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    lossy = {"LD_PRELOAD": library(tmp_path, LOSSY), "LOSS": "0.05"}
    with running_ros_lab(tmp_path, built_bridge, distribution, arm={"environ": lossy}) as lab:
        lab.chain.activate_when_ready()
        lab.settle()
        up_and_down(lab)


def test_a_transform_and_a_static_one_are_as_in_ros(
    tmp_path: Path, built_bridge: Path, distribution: str
) -> None:
    """The robot's own /tf, by rclpy: without `ros2.tf` nothing of ours is there."""
    with running_ros_lab(tmp_path, built_bridge, distribution) as lab:
        person, kind = lab.person, "tf2_msgs/msg/TFMessage"
        late = {"transient_local": True, "depth": 1}
        person.ask("hear", "hears", topic="/tf_static", type=kind, qos_of=late)
        person.ask("hear", "hears", topic="/tf", type=kind, every=10)
        until("/tf", lambda: heard(person, "/tf"))
        static = until("/tf_static", lambda: heard(person, "/tf_static"))
        transform = static[0]["value"]["transforms"][0]
        assert transform["child_frame_id"] == "front_color_optical_frame"
        moving = heard(person, "/tf")[-1]["value"]["transforms"][0]["transform"]["translation"]
        tcp = lab.arm.tcp()[:3, 3]
        assert [moving[name] for name in "xyz"] == pytest.approx(tcp, abs=EXACT_M)
