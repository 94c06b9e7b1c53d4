"""`profile new --ros2` of robots that a peer plays with the names of rmw_zenoh."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
import zenoh.ext
from camera_rig import free_endpoint
from described_arms import SIX, TOOL, arm, urdf
from typer.testing import CliRunner
from vla_zenoh_ros2 import survey as looking
from vla_zenoh_ros2.keys import Endpoint, EntityRole, Qos, RmwZenoh
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.proposal import CONTROLLER_STATE
from vla_zenoh_ros2.survey import DEFINITIONS, GET_PARAMETERS, Survey, survey

from vla_zenoh import plugins
from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import PluginError, ResourceError, SessionError
from vla_zenoh.profile import SessionProfile, load_profile, simulated
from vla_zenoh.program.main import app

JOINT_STATE, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
NUMBERS = "std_msgs/msg/Float64MultiArray"
JOINTS = tuple(f"j{n}" for n in range(1, 7))
POSITION = (0.1, -0.2, 0.3, 0.0, 0.5, 0.0)
LATCHED = Qos(depth=1, transient_local=True)
SHORT_S = 0.8
OF_ROS = """\
<ros2_control name="all" type="system">
  <hardware><plugin>mock_components/GenericSystem</plugin></hardware>
  <joint name="j1"><command_interface name="position"/><state_interface name="position"/></joint>
</ros2_control>
<transmission name="t"><joint name="j1"/><actuator name="m1"/></transmission>
<gazebo reference="j1_link"><material>Gazebo/Grey</material></gazebo>
</robot>"""
SILENT = ("writer", "rt/robot_description", "std_msgs::msg::dds_::String_")
UNREACHED = (
    "reader",
    "rq/robot_state_publisher/get_parametersRequest",
    "rcl_interfaces::srv::dds_::GetParameters_Request_",
)


class Peer:
    """Nodes with rmw_zenoh, by the tokens and keys that these have."""

    def __init__(self, session: zenoh.Session, domain: int = 4) -> None:
        self._session = session
        self.messages = Messages("jazzy", DEFINITIONS)
        self._wire = RmwZenoh(str(session.zid()), "robot", domain, self.messages.hash)
        self._declared: list[Any] = []

    def _announce(self, role: EntityRole, name: str, kind: str) -> str:
        end = Endpoint(role, name, kind, LATCHED)
        token = self._wire.token(end, len(self._declared))
        self._declared.append(self._session.liveliness().declare_token(token))
        return self._wire.key(end)

    def describe(self, topic: str, text: str) -> None:
        key = self._announce(EntityRole.PUBLISHER, topic, TEXT)
        publisher = zenoh.ext.declare_advanced_publisher(
            self._session,
            key,
            cache=zenoh.ext.CacheConfig(max_samples=1),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(
                heartbeat=None, sporadic_heartbeat=None
            ),
            publisher_detection=True,
        )
        publisher.put(self.messages.encode(self.messages.new(TEXT, data=text)))
        self._declared.append(publisher)

    def listen(self, topic: str, kind: str) -> None:
        self._announce(EntityRole.SUBSCRIBER, topic, kind)

    def parameter(self, node: str, text: str) -> None:
        service = f"{node}/get_parameters"
        key = self._announce(EntityRole.SERVER, service, GET_PARAMETERS)

        def answer(query: zenoh.Query) -> None:
            kind = "rcl_interfaces/msg/ParameterValue"
            value = self.messages.new(kind, type=4, string_value=text)
            made = self.messages.new(f"{GET_PARAMETERS}_Response", values=[value])
            with query:
                query.reply(key, self.messages.encode(made))

        handler = zenoh.handlers.Callback(answer, indirect=False)
        self._declared.append(self._session.declare_queryable(key, handler, complete=True))

    def states(self, topic: str) -> None:
        """Be in a posture from now on."""
        key = self._announce(EntityRole.PUBLISHER, topic, JOINT_STATE)
        stamp = self.messages.new("builtin_interfaces/msg/Time", sec=int(time.time()))
        made = self.messages.new(
            JOINT_STATE,
            header=self.messages.new("std_msgs/msg/Header", stamp=stamp),
            name=list(JOINTS),
            position=np.array(POSITION),
        )
        self._declared.append(Repeated(self._session, key, self.messages.encode(made)))

    def control(self, controller: str, *, active: bool) -> None:
        """A joint_trajectory_controller of all joints, whose state is longer than we read."""
        self.listen(f"{controller}/joint_trajectory", "trajectory_msgs/msg/JointTrajectory")
        key = self._announce(
            EntityRole.PUBLISHER, f"{controller}/controller_state", CONTROLLER_STATE
        )
        made = self.messages.new(CONTROLLER_STATE, joint_names=list(JOINTS))
        if active:
            payload = self.messages.encode(made) + bytes(80)
            self._declared.append(Repeated(self._session, key, payload))

    def close(self) -> None:
        for each in reversed(self._declared):
            each.undeclare()


class Repeated:
    """Puts the same at 50 Hz."""

    def __init__(self, session: zenoh.Session, key: str, payload: bytes) -> None:
        self._stop = threading.Event()

        def run() -> None:
            while not self._stop.wait(0.02):
                session.put(key, payload)

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def undeclare(self) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Peers of this process are all there: nobody is waited for as long as on a network."""
    for name in ("SETTLED_S", "LISTEN_S", "CONTROLLERS_S"):
        monkeypatch.setattr(looking, name, 0.5)


@pytest.fixture
def settings() -> SessionProfile:
    endpoint = free_endpoint()
    return SessionProfile(connect=(endpoint,), listen=(endpoint,))


@pytest.fixture
def peer(settings: SessionProfile) -> Iterator[Peer]:
    with open_session(settings, mode="router"), open_session(settings) as session:
        peer = Peer(session)
        yield peer
        peer.close()


def looked_at(settings: SessionProfile, **how: Any) -> Survey:
    return survey(settings, timeout_s=how.pop("timeout_s", 5.0), **how)


def test_the_latched_description_is_read_and_a_namespace_chooses_one_of_several(
    settings: SessionProfile, peer: Peer
) -> None:
    peer.describe("/left/robot_description", "<robot name='left'/>")
    found = looked_at(settings)
    assert (found.namespace, found.domain.number) == ("/left", 4)
    peer.describe("/right/robot_description", "<robot name='right'/>")
    with pytest.raises(ResourceError, match="--namespace: /left, /right"):
        looked_at(settings)
    found = looked_at(settings, namespace="/right")
    assert found.description == "<robot name='right'/>"
    with pytest.raises(ResourceError, match="There is: --namespace /left, --namespace /right"):
        looked_at(settings, namespace="/middle", timeout_s=SHORT_S)


def test_without_a_topic_the_parameter_of_robot_state_publisher_is_asked_for(
    settings: SessionProfile, peer: Peer
) -> None:
    peer.parameter("/robot_state_publisher", "<robot name='asked'/>")
    found = looked_at(settings)
    assert found.description == "<robot name='asked'/>"
    assert found.described_by == "parameter of /robot_state_publisher"


def test_what_is_missing_is_named_with_what_is_there(settings: SessionProfile, peer: Peer) -> None:
    with pytest.raises(SessionError, match="neither a zenoh-bridge-ros2dds nor a node with rmw"):
        looked_at(settings, timeout_s=SHORT_S)
    peer.states("/joint_states")
    with pytest.raises(ResourceError, match=r"no node publishes robot_d.*Published: /joint_states"):
        looked_at(settings, timeout_s=SHORT_S)
    with pytest.raises(SessionError, match=r"no ROS domain 9 .*rmw_zenoh, domain 4"):
        looked_at(settings, number=9, timeout_s=SHORT_S)


@pytest.mark.parametrize(
    ("end", "why"),
    [
        (
            SILENT,
            r"publishes /robot_description, and nothing .* through the bridge .*bridge-config",
        ),
        (UNREACHED, r"cannot be read: Fast DDS answers no call through the bridge"),
    ],
    ids=["a topic that the bridge does not let through", "a parameter on Fast DDS"],
)
def test_what_a_bridge_sees_and_does_not_carry_is_named(
    settings: SessionProfile, end: tuple[str, str, str], why: str
) -> None:
    side, topic, kind = end
    said: dict[str, dict[str, Any]] = {"@/b/ros2/config": {"domain": 0}}
    said[f"@/b/ros2/dds/010f00/{side}/1/{topic}"] = {"type_name": kind}

    def tell(query: zenoh.Query) -> None:
        with query:
            for key, value in said.items():
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, json.dumps(value))

    with open_session(settings, mode="router"), open_session(settings) as bridge:
        bridge.declare_queryable("@/b/ros2/**", zenoh.handlers.Callback(tell, indirect=False))
        with pytest.raises(ResourceError, match=why):
            looked_at(settings, timeout_s=SHORT_S)


def test_without_a_router_it_is_said_what_to_start(settings: SessionProfile) -> None:
    with pytest.raises(SessionError, match=r"start zenoh-bridge-ros2dds .* --connect tcp/ROBOT"):
        looked_at(settings)


def new(settings: SessionProfile, *words: str) -> tuple[int, str]:
    given = ["profile", "new", *words, "--connect", settings.connect[0], "--yes"]
    done = CliRunner().invoke(app, given)
    return done.exit_code, done.output + str(done.exception or "")


@pytest.fixture
def robot(peer: Peer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Peer:
    """A peer that is an arm, and this test in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    text = urdf([*arm(SIX), TOOL]).replace("</robot>", OF_ROS)
    peer.describe("/robot_description", text)
    peer.states("/joint_states")
    return peer


def test_an_option_chooses_the_topic_that_commands_the_arm(
    settings: SessionProfile, robot: Peer
) -> None:
    robot.listen("/first/commands", NUMBERS)
    robot.listen("/second/commands", NUMBERS)
    code, said = new(settings, "--ros2", "--command", "/nothing")
    assert (code, "Found: /first/commands, /second/commands" in said) == (1, True)
    code, said = new(settings, "--ros2", "--command", "/second/commands")
    assert code == 0, said
    made = load_profile("made.yaml")  # after the robot of the description
    assert made.ros2 is not None
    assert made.ros2.joint_command is not None
    assert made.ros2.joint_command.topic == "/second/commands"
    assert (made.ros2.bridge, made.ros2.domain) == ("rmw_zenoh", 4)
    assert "ros2.joint_command" not in made.unconfirmed
    assert simulated(made).robot.driver == "sim"
    assert "--home=0.100,-0.200,0.300,0.000,0.500,0.000" in said


def test_the_controller_that_is_active_is_taken_and_nothing_is_unconfirmed_about_it(
    settings: SessionProfile, robot: Peer
) -> None:
    robot.control("/arm_controller", active=False)
    robot.control("/scaled_arm_controller", active=True)
    robot.listen("/forward_position_controller/commands", NUMBERS)
    code, said = new(settings, "--ros2")
    assert code == 0, said
    made = load_profile("made.yaml")
    assert made.ros2 is not None
    assert made.ros2.joint_command is not None
    assert made.ros2.joint_command.topic == "/scaled_arm_controller/joint_trajectory"
    assert "ros2.joint_command" not in made.unconfirmed


def test_a_robot_without_controllers_is_simulated_by_a_description_beside_it(
    settings: SessionProfile, robot: Peer
) -> None:
    Path("mine.urdf").write_text(urdf([*arm(SIX), TOOL]))
    code, said = new(settings, "mine.urdf", "--ros2", "--output", "six.yaml")
    assert code == 0, said
    assert "no topic was found that commands the arm" in said
    assert load_profile("six.yaml").robot.driver == "sim"
    code, said = new(settings, "--ros2", "--output", "six.yaml")
    assert (code, "six.yaml exists" in said) == (1, True)


def test_options_of_a_running_robot_need_ros2_and_ros2_its_package(
    settings: SessionProfile, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, said = new(settings, "arm.urdf", "--namespace", "/left")
    assert (code, "--namespace goes with --ros2" in said) == (2, True)
    code, said = new(settings)
    assert (code, "or --ros2" in said) == (2, True)
    monkeypatch.setattr(plugins, "installed", lambda group: {})
    from vla_zenoh_newarm.running import Running, look

    with pytest.raises(PluginError, match=r"--ros2` needs the package vla-zenoh-ros2; install"):
        look(Running(ros2=True), None, print, describe=True)
