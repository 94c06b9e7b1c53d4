"""rmw_zenoh's wire against somebody else's: the package zenoh-ros2-sdk, in its own environment.

Both directions: pictures, joint states, poses, text, a service; and the node ``ros2`` with a robot
that the SDK plays.
"""

from __future__ import annotations

import json
import queue
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from camera_rig import until
from panda_arm import ARM_JOINTS, HOME_RAD, panda
from ros2_rig import write_profile
from vla_zenoh_ros2.driver import Ros2Driver
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.readers import IMAGE, JOINT_STATE, read
from vla_zenoh_ros2.ros_graph import Request, RosGraph

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import records
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.profile.robot import Ros2Profile
from vla_zenoh.robots.node import RobotNode
from vla_zenoh.types import PoseState

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

SDK = "zenoh-ros2-sdk==0.1.8"
START_S, WAIT_S = 60.0, 10.0
POSITION_TOLERANCE_M = 1e-6
POSE, TEXT = "geometry_msgs/msg/PoseStamped", "std_msgs/msg/String"
SET_BOOL = "std_srvs/srv/SetBool"
HEADER = {"stamp": {"sec": 5, "nanosec": 7}, "frame_id": "base"}
FIELDS: dict[str, dict[str, Any]] = {
    JOINT_STATE: {
        "header": HEADER,
        "name": ["a", "b"],
        "position": [0.5, -1.0],
        "velocity": [0.0, 1.0],
        "effort": [],
    },
    IMAGE: {
        "header": HEADER,
        "height": 2,
        "width": 3,
        "encoding": "rgb8",
        "is_bigendian": 0,
        "step": 9,
        "data": list(range(18)),
    },
    POSE: {
        "header": HEADER,
        "pose": {
            "position": {"x": 1.0, "y": 2.0, "z": 3.0},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
    },
    TEXT: {"data": "hello"},
}


class Sdk:
    """The other side's process."""

    def __init__(self, port: int) -> None:
        uv = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
        if uv is None:
            pytest.skip("no uv to make an environment for zenoh-ros2-sdk with")
        with_it = ["--with", SDK, "--with", f"eclipse-zenoh=={version('eclipse-zenoh')}"]
        program = str(Path(__file__).with_name("sdk_peer.py"))
        python = ["--python", sys.executable, "python", program, str(port)]
        self._process = subprocess.Popen(
            [uv, "run", "--quiet", "--no-project", *with_it, *python],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._lines: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._readers: list[threading.Thread] = []
        self.errors: list[str] = []
        for stream, take in ((self._process.stdout, self._heard), (self._process.stderr, None)):
            assert stream is not None
            reader = threading.Thread(target=self._reader(stream, take), daemon=True)
            reader.start()
            self._readers.append(reader)
        if self.wait("ready", START_S) is None:
            pytest.skip(f"no environment with {SDK}: {' '.join(self.errors)[-500:]}")

    def _reader(self, stream: Any, take: Callable[[str], None] | None) -> Callable[[], None]:
        def read() -> None:
            for line in stream:
                (take or self.errors.append)(line)
            if take is not None:
                self._lines.put(None)

        return read

    def _heard(self, line: str) -> None:
        if line.startswith("{"):
            self._lines.put(json.loads(line))

    def wait(self, word: str, timeout_s: float = WAIT_S) -> dict[str, Any] | None:
        """The next line with this word; None when there is none in time."""
        give_up = time.monotonic() + timeout_s
        while (left_s := give_up - time.monotonic()) > 0:
            try:
                line = self._lines.get(timeout=left_s)
            except queue.Empty:
                return None
            if line is None or word in line:
                return line
        return None

    def do(self, what: str, **words: Any) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": what, **words}) + "\n")
        self._process.stdin.flush()

    def forget(self) -> None:
        while not self._lines.empty():
            self._lines.get_nowait()

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for reader in self._readers:
            reader.join(WAIT_S)
        for stream in (self._process.stdout, self._process.stderr):
            assert stream is not None
            stream.close()


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Profile, Sdk]]:
    """A router and the SDK's node."""
    more = f"  pose_command: {{topic: /target, type: {POSE}}}\n  gripper: null\n  services: true\n"
    path = write_profile(tmp_path_factory.mktemp("rmw"), "rmw_zenoh", more)
    profile = load_profile(str(path))
    with open_session(profile.session, mode="router"):
        sdk = Sdk(int(profile.session.listen[0].rsplit(":", 1)[1]))
        yield profile, sdk
        sdk.close()


@pytest.fixture
def link(lab: tuple[Profile, Sdk]) -> Iterator[RosGraph]:
    profile, sdk = lab
    sdk.forget()
    with open_session(profile.session) as session:
        link = RosGraph(session, Ros2Profile(bridge="rmw_zenoh"), Messages("jazzy"), "vla_panda")
        yield link
        link.close()


JAZZY = Messages("jazzy")


def message(kind: str, fields: dict[str, Any]) -> Any:
    """Of plain fields, as `FIELDS` has them."""
    values = {}
    for name, described in JAZZY.fields(kind).items():
        value = fields[name]
        if isinstance(value, dict):
            value = message(described[1], value)
        elif isinstance(value, list) and not (value and isinstance(value[0], str)):
            value = np.array(value, np.dtype(described[1][0][1][0]))
        values[name] = value
    return JAZZY.new(kind, **values)


def holds(found: Any, fields: dict[str, Any]) -> bool:
    """Whether what was heard has these fields, whatever rosbags put beside them."""
    return all(
        holds(found[name], value) if isinstance(value, dict) else found[name] == value
        for name, value in fields.items()
    )


@pytest.mark.parametrize("kind", FIELDS)
def test_what_we_write_is_read_by_the_other_side(
    lab: tuple[Profile, Sdk], link: RosGraph, kind: str
) -> None:
    _, sdk = lab
    topic = f"/ours/{kind.rsplit('/', 1)[1].lower()}"
    sdk.do("subscribe", name=topic, kind=kind)
    assert sdk.wait("done")
    writer = link.publisher(topic, kind)
    payload = JAZZY.encode(message(kind, FIELDS[kind]))
    stop = threading.Event()

    def write() -> None:
        while not stop.wait(0.05):
            writer.publish(payload)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        line = sdk.wait("got")
    finally:
        stop.set()
        thread.join()
    assert line is not None, sdk.errors[-5:]
    assert line["got"] == topic
    assert holds(line["fields"], FIELDS[kind])


@pytest.mark.parametrize("kind", FIELDS)
def test_what_the_other_side_writes_is_read_by_us(
    lab: tuple[Profile, Sdk], link: RosGraph, kind: str
) -> None:
    _, sdk = lab
    topic = f"/theirs/{kind.rsplit('/', 1)[1].lower()}"
    inbox = link.subscribe(topic, kind, CallbackRing(8))
    sdk.do("advertise", name=topic, kind=kind)
    announced = sdk.wait("hash")
    assert announced is not None, sdk.errors[-5:]
    assert announced["hash"] == JAZZY.hash(kind)
    assert sdk.wait("done")

    def heard() -> Any:
        sdk.do("publish", name=topic, kind=kind, fields=FIELDS[kind])
        time.sleep(0.05)
        return inbox.drain()

    sample = until("a sample", heard)[0].sample
    found = JAZZY.decode(kind, sample.payload.to_bytes())
    assert JAZZY.encode(found) == JAZZY.encode(message(kind, FIELDS[kind]))
    if kind != POSE:
        read(JAZZY, kind, sample.payload.to_bytes())


def test_our_service_answers_the_other_side(lab: tuple[Profile, Sdk], link: RosGraph) -> None:
    _, sdk = lab
    asked: list[Any] = []

    def take(request: Request) -> None:
        asked.append(JAZZY.decode(f"{SET_BOOL}_Request", request.payload).data)
        answer = JAZZY.new(f"{SET_BOOL}_Response", success=True, message="by us")
        request.answer(JAZZY.encode(answer))

    link.serve("/ours/set_active", SET_BOOL, take)
    time.sleep(0.3)  # it is declared on its way
    sdk.do("call", name="/ours/set_active", kind=SET_BOOL, fields={"data": True})
    line = sdk.wait("answered")
    assert line is not None, sdk.errors[-5:]
    assert line["fields"] is not None, sdk.errors[-5:]
    assert holds(line["fields"], {"success": True, "message": "by us"})
    assert asked == [True]


def test_the_other_sides_service_answers_us(lab: tuple[Profile, Sdk], link: RosGraph) -> None:
    _, sdk = lab
    sdk.do("serve", name="/theirs/set_active", kind=SET_BOOL)
    announced = sdk.wait("hash")
    assert announced is not None, sdk.errors[-5:]
    assert announced["hash"] == JAZZY.hash(SET_BOOL)
    assert sdk.wait("done")
    time.sleep(0.3)  # it is declared on its way
    answers: queue.Queue[bytes | None] = queue.Queue()
    request = JAZZY.encode(JAZZY.new(f"{SET_BOOL}_Request", data=True))
    link.client("/theirs/set_active", SET_BOOL).call(request, answers.put)
    payload = answers.get(timeout=WAIT_S)
    assert payload is not None, sdk.errors[-5:]
    answer = JAZZY.decode(f"{SET_BOOL}_Response", payload)
    assert (answer.success, answer.message) == (True, "by the SDK")


def test_the_node_drives_a_robot_of_the_other_side(lab: tuple[Profile, Sdk]) -> None:
    profile, sdk = lab
    sdk.forget()
    poses: list[PoseState] = []

    def keep(sample: zenoh.Sample) -> None:
        poses.append(records.decode(PoseState, sample.payload.to_bytes()))

    with open_session(profile.session) as ours, open_session(profile.session) as watcher:
        subscriber = watcher.declare_subscriber(
            profile.keys.state_pose, zenoh.handlers.Callback(keep, indirect=False)
        )
        node, stop = RobotNode(Ros2Driver(profile), ours), threading.Event()
        thread = threading.Thread(target=node.run, args=(stop,))
        thread.start()
        try:
            sdk.do("advertise", name="/joint_states", kind=JOINT_STATE)
            assert sdk.wait("done")

            def state() -> bool:
                now_ns = time.time_ns()
                stamp = {"sec": now_ns // 10**9, "nanosec": now_ns % 10**9}
                fields = {
                    "header": {"stamp": stamp, "frame_id": ""},
                    "name": list(ARM_JOINTS),
                    "position": HOME_RAD.tolist(),
                    "velocity": [0.0] * 7,
                    "effort": [0.0] * 7,
                }
                sdk.do("publish", name="/joint_states", kind=JOINT_STATE, fields=fields)
                time.sleep(0.02)
                return bool(poses)

            until("a pose of ours", state)
            expected = panda().forward(HOME_RAD).position_m
            assert np.abs(poses[-1].position_m - expected).max() < POSITION_TOLERANCE_M
            sdk.forget()
            sdk.do("call", name="/vla/set_active", kind=SET_BOOL, fields={"data": True})
            line = sdk.wait("answered")
            assert line is not None
            assert line["fields"]["success"] is False
            assert "no command node" in line["fields"]["message"]
        finally:
            stop.set()
            thread.join(5.0)
            subscriber.undeclare()
    assert not thread.is_alive()
