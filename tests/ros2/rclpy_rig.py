"""A lab whose robot is ROS 2 itself: rclpy programs on Fast DDS, the real bridge, and our nodes.

The programs of `ros_side/` run in ROS's own Python, as scripts/ros2_environment.py makes it, and
talk with a test by lines of JSON. Times in what they tell are of this computer's monotonic clock.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import panda_dh
import zenoh
from bridge import ROOT, Bridge, generated
from camera_rig import PATIENCE_S, free_endpoint, until
from chain import CHAIN_PATIENCE_S, Chain, Track, running_chain
from numpy.typing import NDArray
from ros_node import free_domain
from vla_zenoh_ros2.bridge_view import endpoints_key

SIDE = Path(__file__).with_name("ros_side")
ROS2_PAGE = ROOT / "docs" / "how-to" / "ros2.md"

FloatArray = NDArray[np.float64]
START_S = 30.0
FAST_DDS = "rmw_fastrtps_cpp"
MOVING_M_S = 0.05
STILL_RAD, STAND_S = 1e-8, 0.2
"""This arm is kinematics alone: it stands where no digit changes any more."""
MIDDLE_M = 0.40
WIDTH, HEIGHT, CAMERA_HZ, PICTURES = 160, 120, 30, 5
FRONT, WRIST = "/front/image_raw", "/wrist/image_raw/compressed"

PROFILE = """\
extends: panda_ros2
robot: {{name: {name}}}
cameras:
  front:
    source: "ros2:{front}"
    {size}
{mount}{unit}  wrist:
    source: "ros2:{wrist}"
    {size}
{unit}task: {{prompt: hold, rate_hz: 10, worker: scripted}}
session: {{listen: ["{endpoint}"], connect: ["{endpoint}"], lease_ms: 4000}}
timing: {{command_timeout_s: {patience_s[command]}, state_timeout_s: {patience_s[state]}}}
ros2:
  distribution: {distribution}
  domain: {domain}
  joint_states: {space}/joint_states
  cameras:
    front: {{topic: {front}, type: sensor_msgs/msg/Image{depth[front]}}}
    wrist: {{topic: {wrist}, type: sensor_msgs/msg/CompressedImage{depth[wrist]}}}
  pose_command: {{topic: {space}/desired_pose, type: geometry_msgs/msg/PoseStamped}}
  gripper: {gripper}
{more}"""
CAMERA = """\
width: {width}
    height: {height}
    rate_hz: {hz}
    check: {{same_s: 0}}"""
DEPTH_UNIT_M = 0.001
DEPTH_TOPICS = {
    "front": ", depth: {topic: /front/depth}",
    "wrist": ", depth: {topic: /wrist/depth, type: sensor_msgs/msg/CompressedImage}",
}
COMPRESSED_DEPTH = "16UC1; compressedDepth png"
BY_TOPIC = "{{topic: {space}/gripper_width, type: std_msgs/msg/Float64, position: width}}"
BY_ACTION = (
    "{{topic: {space}/gripper/move, type: franka_msgs/action/Move, grasp: {space}/gripper/grasp}}"
)


def environment_script() -> ModuleType:
    """scripts/ros2_environment.py, which knows where ROS's Python is."""
    sys.path.append(str(ROOT / "scripts"))
    spec = importlib.util.spec_from_file_location(
        "ros2_environment", ROOT / "scripts" / "ros2_environment.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def ros_python(distribution: str) -> Path:
    """ROS's Python. It is no reason to skip a test that there is none: make test-ros2 makes it."""
    python = environment_script().python_of(distribution)
    assert python is not None, f"no rclpy of {distribution} here: make test-ros2"
    return python


@cache
def fast_dds_3() -> str:
    """File of the settings that the docs give for Fast DDS 3."""
    (settings,) = re.findall(r"```xml\n(.*?)```", ROS2_PAGE.read_text("utf-8"), re.DOTALL)
    file = Path(mkdtemp()) / "fastdds.xml"
    file.write_text(settings)
    return str(file)


class Program:
    """One of the programs of `ros_side/`, as a process.

    Args:
        name: of its file, without ``.py``.
        distribution: whose Python.
        domain: ROS domain id.
        settings: its argument.
        environ: variables beside those of this process.
        arguments: of ROS, as a launch file gives them.
    """

    def __init__(
        self,
        name: str,
        distribution: str,
        domain: int,
        settings: Mapping[str, Any] | None = None,
        environ: Mapping[str, str] | None = None,
        arguments: Sequence[str] = (),
    ) -> None:
        self._words = [
            str(ros_python(distribution)),
            str(SIDE / f"{name}.py"),
            json.dumps(settings or {}),
            *arguments,
        ]
        self._environ = {
            **{key: value for key, value in os.environ.items() if not key.startswith("PYTHON")},
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": str(SIDE.parent),
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "RMW_IMPLEMENTATION": FAST_DDS,
            **({"FASTDDS_DEFAULT_PROFILES_FILE": fast_dds_3()} if distribution == "kilted" else {}),
            **(environ or {}),
        }
        self.told: list[dict[str, Any]] = []
        self._process: subprocess.Popen[str] | None = None
        self._reader: threading.Thread | None = None

    def start(self, *, wait: bool = True) -> Program:
        """Start it; with `wait`, until ROS runs in it."""
        before = len(self.told)
        self._process = subprocess.Popen(
            self._words,
            env=self._environ,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, args=(self._process,), daemon=True)
        self._reader.start()
        if wait:
            self.wait_ready(before)
        return self

    def wait_ready(self, before: int = 0) -> None:
        """Until ROS runs in it."""
        until(
            f"{self._words[1]} runs",
            lambda: not self.alive or self.since(before, "ready"),
            START_S,
        )
        assert self.since(before, "ready")[0]["ready"] == FAST_DDS

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                if line.startswith("{"):
                    self.told.append(json.loads(line))

    @property
    def alive(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def do(self, command: str, **how: Any) -> None:
        """Let it do something; see the program."""
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": command, **how}) + "\n")
        self._process.stdin.flush()

    def since(self, before: int, what: str) -> list[dict[str, Any]]:
        """What it told with this key, from the line number `before` on."""
        return [line for line in self.told[before:] if what in line]

    def ask(self, command: str, answer: str, timeout_s: float = 20.0, **how: Any) -> dict[str, Any]:
        """Let it do something and wait for a line with the key `answer`."""
        before = len(self.told)
        self.do(command, **how)
        lines = until(
            f"{command} {how} is answered",
            lambda: self.since(before, answer) or self.since(before, "failed"),
            timeout_s,
        )
        assert answer in lines[0], lines[0]
        return lines[0]

    def kill(self) -> None:
        """End it as a crash would."""
        if self._process is not None:
            self._process.kill()
            self._gone()

    def end(self) -> None:
        """Let it end by itself."""
        if self._process is None:
            return
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
            self._process.wait(5)
        except (OSError, subprocess.TimeoutExpired):
            self._process.kill()
        self._gone()

    def _gone(self) -> None:
        assert self._process is not None
        assert self._reader is not None
        self._process.wait()
        self._reader.join()
        if self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()
        self._process = None


class Arm(Program):
    """The rclpy robot; its own log says how it moved. Settings: see `ros_side/arm.py`."""

    def __init__(self, distribution: str, domain: int, **settings: Any) -> None:
        environ = settings.pop("environ", None)
        arguments = settings.pop("arguments", ())
        super().__init__("arm", distribution, domain, settings, environ, arguments)

    def track(self, since_ns: int = 0) -> Track:
        """How it moved, by the joints of its log; stamps are monotonic."""
        return track_of([(line["t"], line["q"]) for line in self._lines("q", since_ns)])

    def goals(self, since_ns: int = 0) -> tuple[NDArray[np.int64], FloatArray]:
        """(n,) when each pose arrived, and (n, 3) the positions."""
        found = self._lines("goal", since_ns)
        return (
            np.array([line["t"] for line in found], np.int64),
            np.array([line["goal"] for line in found]).reshape(-1, 3),
        )

    def _lines(self, what: str, since_ns: int) -> list[dict[str, Any]]:
        out = []
        for line in reversed(self.told):
            if line["t"] < since_ns - 1_000_000_000:  # lines of two threads may be swapped
                break
            if what in line and line["t"] >= since_ns:
                out.append(line)
        return out[::-1]

    def joints_rad(self) -> FloatArray:
        """Its joints now."""

        def newest() -> list[float]:
            return next((line["q"] for line in reversed(self.told) if "q" in line), [])

        return np.array(until("joints of the robot", newest))

    def tcp(self) -> FloatArray:
        """Its TCP now, (4, 4)."""
        return panda_dh.forward(self.joints_rad())

    def width_m(self) -> float:
        return next(line["width_m"] for line in reversed(self.told) if "width_m" in line)

    def speed_m_s(self) -> float:
        """How fast it is, over the last 60 ms."""
        track = self.track(time.monotonic_ns() - 60_000_000)
        if len(track.stamp_ns) < 2:
            return 0.0
        way_m = np.linalg.norm(track.position_m[-1] - track.position_m[0])
        return float(way_m / (track.stamp_ns[-1] - track.stamp_ns[0]) * 1e9)

    def stands(self, since_ns: int = 0) -> bool:
        """Whether it stood for `STAND_S` until its newest joints, which are of `since_ns` or later.

        On a busy computer these are few, and come late.
        """
        lines = []
        for line in reversed(self.told):
            if "q" not in line:
                continue
            lines.append(line)
            if len(lines) >= 5 and line["t"] <= lines[0]["t"] - STAND_S * 1e9:
                still = np.ptp([each["q"] for each in lines], axis=0).max() < STILL_RAD
                return bool(still) and lines[0]["t"] >= since_ns
        return False

    def wait_still(self, timeout_s: float = PATIENCE_S) -> FloatArray:
        """Until it stands; its TCP then, (4, 4)."""
        now_ns = time.monotonic_ns()
        until("the robot stands", lambda: self.stands(now_ns), timeout_s)
        return self.tcp()


def track_of(joints: list[tuple[int, list[float]]]) -> Track:
    """How an arm moved of (ns, joints rad)."""
    stamps = np.array([at_ns for at_ns, _ in joints], np.int64)
    places = np.array([panda_dh.forward(q)[:3, 3] for _, q in joints]).reshape(-1, 3)
    twist = np.zeros((len(joints), 6))
    if len(joints) > 1:
        twist[:, :3] = np.gradient(places, stamps / 1e9, axis=0)
    nobody = np.full(len(joints), "panda", object)
    return Track(stamps, places, twist, np.full_like(places, np.nan), nobody)


def pictures(folder: Path, width: int, height: int) -> list[NDArray[np.uint8]]:
    """Files of pictures for `ros_side/camera.py`, in every encoding; the pictures, RGB."""
    folder.mkdir(exist_ok=True)
    made = []
    for number in range(PICTURES):
        noise = np.random.default_rng(number).integers(0, 256, (6, 8, 3), np.uint8)
        rgb = cv2.resize(noise, (width, height), interpolation=cv2.INTER_NEAREST)
        bgr = np.ascontiguousarray(rgb[..., ::-1])
        (folder / f"{number}.rgb8").write_bytes(rgb.tobytes())
        (folder / f"{number}.bgr8").write_bytes(bgr.tobytes())
        done, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])
        assert done
        (folder / f"{number}.jpeg").write_bytes(jpeg.tobytes())
        made.append(rgb)
    return made


@dataclass
class RosLab:
    """What a test holds."""

    distribution: str
    domain: int
    bridge: Bridge
    arm: Arm
    cameras: Program
    person: Program
    chain: Chain
    pictures: list[NDArray[np.uint8]]

    def settle(self) -> None:
        """Whatever was before: inactive, standing, prompt ``hold``."""
        self.chain.settle()
        self.arm.wait_still()
        self.chain.recorder.forget()
        self.chain.client.pop_events()
        assert not self.chain.failure, self.chain.failure

    def activate_at_rest(self) -> FloatArray:
        """Activate with prompt ``hold``; where the TCP then stands, (4, 4)."""
        self.chain.client.set_prompt("hold")
        self.chain.activate_when_ready()
        return self.arm.wait_still()

    def move(self, speed_m_s: float = MOVING_M_S, rate_hz: float = 10.0) -> None:
        """Activate with an endless motion away from the nearer end; returns when it is fast."""
        up = self.arm.tcp()[2, 3] < MIDDLE_M
        self.chain.client.set_rate(rate_hz)
        self.chain.client.set_prompt("HARD: go up" if up else "HARD: go down")
        self.chain.activate_when_ready()
        self.chain.until("it moves", lambda: self.arm.speed_m_s() > speed_m_s)

    def story(self) -> str:
        """For the message of a test that fails."""
        return f"{self.chain.story()}\nbridge:\n{self.bridge.tail()}"


def write_profile(
    folder: Path,
    distribution: str,
    domain: int,
    *,
    endpoint: str | None = None,
    space: str = "",
    name: str = "panda",
    gripper: str = BY_TOPIC,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    more: str = "",
    mount: str = "",
    depth: bool = False,
    patience_s: Mapping[str, float] = CHAIN_PATIENCE_S,
) -> Path:
    """A profile of the rclpy robot; `more` is YAML at the end of the section ros2, `mount` of the
    camera front. With `depth` both cameras have it."""
    path = folder / f"{name}_rclpy.yaml"
    path.write_text(
        PROFILE.format(
            name=name,
            front=space + FRONT,
            wrist=space + WRIST,
            size=CAMERA.format(width=size[0], height=size[1], hz=CAMERA_HZ),
            endpoint=endpoint or free_endpoint(),
            distribution=distribution,
            domain=domain,
            space=space,
            patience_s=patience_s,
            gripper=gripper.format(space=space),
            more=more,
            mount=mount,
            unit=f"    depth_unit_m: {DEPTH_UNIT_M}\n" if depth else "",
            depth=DEPTH_TOPICS if depth else {"front": "", "wrist": ""},
        )
    )
    return path


def depth_counts(width: int, height: int) -> NDArray[np.uint16]:
    """Depth in mm as the cameras publish it; in the first row nothing was measured."""
    counts = np.arange(width * height, dtype=np.uint16).reshape(height, width) % 4000 + 500
    counts[0] = 0
    return counts


def depth_settings(folder: Path, width: int, height: int) -> list[dict[str, Any]]:
    """Topics of depth for `ros_side/camera.py`: raw metres, and millimetres as compressedDepth."""
    counts = depth_counts(width, height)
    metres = (counts / 1000.0).astype(np.float32)
    metres[0, :3] = np.nan, np.inf, -np.inf
    (folder / "0.32FC1").write_bytes(metres.tobytes())
    done, png = cv2.imencode(".png", counts)
    assert done
    header = struct.pack("<iff", 0, 0.0, 0.0)
    (folder / "0.depth").write_bytes(header + png.tobytes())
    return [
        {"topic": "/front/depth", "encoding": "32FC1"},
        {"topic": "/wrist/depth", "encoding": "depth", "format": COMPRESSED_DEPTH},
    ]


def camera_settings(
    folder: Path, space: str = "", size: tuple[int, int] = (WIDTH, HEIGHT)
) -> dict[str, Any]:
    """A raw camera, best effort, and a compressed one, reliable."""
    return {
        "rate_hz": CAMERA_HZ,
        "folder": str(folder),
        "width": size[0],
        "height": size[1],
        "topics": [
            {"topic": space + FRONT, "encoding": "rgb8", "reliable": False},
            {"topic": space + WRIST, "encoding": "jpeg", "reliable": True},
        ],
    }


@contextmanager
def running_ros_lab(
    folder: Path,
    program: Path,
    distribution: str,
    *,
    arm: Mapping[str, Any] | None = None,
    space: str = "",
    gripper: str = BY_TOPIC,
    more: str = "",
    mount: str = "",
    depth: bool = False,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    cameras: Callable[[dict[str, Any]], None] = lambda settings: None,
    patience_s: Mapping[str, float] = CHAIN_PATIENCE_S,
) -> Iterator[RosLab]:
    """Everything up while the block lasts.

    Args:
        folder: for profile, settings and logs.
        program: the bridge.
        distribution: of ROS 2.
        arm: settings of the robot; among them variables, `environ`, and `arguments` of ROS.
        space: what the names of topics begin with in the profile.
        gripper: its section of the profile, `BY_TOPIC` or `BY_ACTION`.
        more: YAML at the end of the profile's section ros2.
        mount: YAML at the end of its camera front.
        depth: cameras have depth, see `depth_settings`.
        size: of the pictures, width and height.
        cameras: changes their settings.
        patience_s: of the profile, with commands and states that are late.
    """
    domain = free_domain()
    profile = write_profile(
        folder,
        distribution,
        domain,
        space=space,
        gripper=gripper,
        size=size,
        more=more,
        mount=mount,
        depth=depth,
        patience_s=patience_s,
    )
    made = pictures(folder / "pictures", *size)
    seen = camera_settings(folder / "pictures", space, size)
    if depth:
        seen["topics"] += depth_settings(folder / "pictures", *size)
    cameras(seen)
    with ExitStack() as stack:
        settings = generated(profile, beside=True)
        bridge = Bridge(program, folder, settings, distribution).start()
        stack.callback(bridge.kill)
        robot = Arm(distribution, domain, **(arm or {}))
        eyes = Program("camera", distribution, domain, seen)
        person = Program("person", distribution, domain)
        for one in (robot, eyes, person):
            one.start(wait=False)
            stack.callback(one.end)
        chain = stack.enter_context(running_chain(folder, profile_file=profile))
        chain.recorder.only = {"state": "ros2#", "command": "command#"}
        for one in (robot, eyes, person):
            one.wait_ready()
        yield RosLab(distribution, domain, bridge, robot, eyes, person, chain, made)


# -- what tests do ---------------------------------------------------------------------------------
STRING, BOOL, EMPTY = "std_msgs/msg/String", "std_msgs/msg/Bool", "std_msgs/msg/Empty"
TYPES = {"stop": EMPTY, "reset": EMPTY, "active": BOOL, "prompt": STRING, "request": STRING}
ANSWER = "/vla/answer"
GID_CHUNK = 6
"""Of the key under which the bridge tells of an end."""
STEPS_PATIENCE_S = 30.0


def carry_out(lab: RosLab, prompt: str, count: int) -> FloatArray:
    """Let an active standing arm do `count` steps of a prompt; its TCP then, (4, 4)."""
    client = lab.chain.client
    client.set_prompt("hold")
    lab.arm.wait_still()
    words = f"HARD: {prompt} x{count}"
    client.set_prompt(words)
    lab.chain.wait_done(words, count, STEPS_PATIENCE_S)
    lab.chain.wait_arrived()
    return lab.arm.wait_still()


def heard(person: Program, topic: str, before: int = 0) -> list[dict[str, Any]]:
    """What a person heard of a topic."""
    return [line for line in person.told[before:] if line.get("heard") == topic]


def received_tcp(lab: RosLab) -> FloatArray:
    """TCP of the joints that another rclpy node received, said after this call; (4, 4)."""
    person, since_ns, topic = lab.person, time.time_ns(), "/joint_states"
    if not any(line.get("hears") == topic for line in person.told):
        person.ask("hear", "hears", topic=topic, type="sensor_msgs/msg/JointState", every=10)
    before = len(person.told)

    def newer() -> dict[str, Any] | None:
        for line in heard(person, topic, before):
            stamp = line["value"]["header"]["stamp"]
            if stamp["sec"] * 10**9 + stamp["nanosec"] > since_ns:
                return line["value"]
        return None

    message = until("joints in rclpy", newer)
    joints = dict(zip(message["name"], message["position"], strict=True))
    return panda_dh.forward([joints[name] for name in panda_dh.JOINTS])


def wait_known(session: zenoh.Session, end: str, topic: str, ids: Sequence[str]) -> None:
    """Until the bridge knows ends (`writer`, `reader`) of a topic by their ids in DDS.

    What a publisher of Fast DDS sends before is lost, though it says that it has a subscriber: see
    "The first message" in docs/how-to/ros2.md.
    """
    assert ids, f"ROS knows no {end} of {topic}"

    def known() -> bool:
        replies = session.get(endpoints_key(end, f"rt{topic}"), timeout=1.0)
        keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        return {*ids} <= {key.split("/")[GID_CHUNK] for key in keys}

    until(f"the bridge knows each {end} of {topic}", known, 15.0)


def publish(
    session: zenoh.Session,
    person: Program,
    topic: str,
    kind: str,
    value: Mapping[str, Any] | None = None,
    **how: Any,
) -> None:
    """Let a person publish when the bridge knows its publisher."""
    offered = person.ask("offer", "offers", topic=topic, type=kind, qos_of=how.get("qos_of"))
    wait_known(session, "writer", topic, offered["ids"])
    person.ask("say", "said", topic=topic, type=kind, value=value or {}, **how)


def hear_answers(lab: RosLab) -> None:
    """Let the person hear the answers to its requests."""
    person = lab.person
    if not any(line.get("hears") == ANSWER for line in person.told):
        hears = person.ask("hear", "hears", topic=ANSWER, type=STRING)
        wait_known(lab.chain.session, "reader", ANSWER, hears["ids"])


def request(
    lab: RosLab, what: str, value: Mapping[str, Any] | None = None, **how: Any
) -> dict[str, Any]:
    """Publish on one of our topics as a ROS user does; the answer, from its JSON."""
    person = lab.person
    hear_answers(lab)
    before = len(person.told)
    publish(lab.chain.session, person, f"/vla/{what}", TYPES[what], value, **how)

    def answer() -> dict[str, Any] | None:
        found = (json.loads(line["value"]["data"]) for line in heard(person, ANSWER, before))
        return next((each for each in found if each["what"] == what), None)

    return until(f"/vla/{what} is answered", answer, 15.0)


# -- what is preloaded into a robot ----------------------------------------------------------------
LOSSY = SIDE / "lossy.c"
WALL_CLOCK = ROOT / "reliability" / "netns" / "wall_clock.c"


def library(folder: Path, source: Path) -> str:
    """A library of a C file, for LD_PRELOAD."""
    made = folder / f"{source.stem}.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", source, "-o", made, "-ldl"], check=True)
    return str(made)


class WallClock:
    """A wall clock of its own for a robot, `environ` gives it one."""

    def __init__(self, folder: Path, offset_s: float = 0.0) -> None:
        self._file = folder / "wall_clock"
        self.set(offset_s)
        self.environ = {
            "LD_PRELOAD": library(folder, WALL_CLOCK),
            "WALL_CLOCK_FILE": str(self._file),
        }

    def set(self, offset_s: float) -> None:
        """How far it is off, from now on."""
        data = round(offset_s * 1e9).to_bytes(8, "little", signed=True)
        with self._file.open("r+b" if self._file.exists() else "wb") as file:
            file.write(data)  # in place: a running robot has it mapped
