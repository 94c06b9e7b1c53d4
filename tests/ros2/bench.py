"""How much longer a picture's way to a pose is over ROS 2, and whose share is what.

    make bench-ros2        (python tests/ros2/bench.py --requests 300 -o result.json)

A DDS participant publishes pictures of 640x480, our nodes answer through the real bridge, and the
pose comes back over DDS to the same process. On its way it is seen on every Zenoh key, so that the
way can be cut into legs; all stamps are of one clock. A second process that answers pictures over
DDS by itself says what of a leg DDS takes without any bridge.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import zenoh

# Run as a program, and not by pytest, which knows where the rest of the tests' own code is.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bridge import Bridge, generated, load_script
from camera_rig import free_endpoint
from chain import Chain, running_chain
from panda_robot import CAMERAS, DESIRED_POSE
from rich.console import Console
from rich.table import Table
from rig import Robot
from ros_messages import CartesianImpedanceGoal, Header, Image, Pose, PoseStamped, Time
from ros_node import Listener, RosNode, free_domain
from vla_zenoh_benchmarks.command_runner import cpu_s

from benchmarks.picture import noisy_picture
from vla_zenoh.codec import records
from vla_zenoh.types import PoseCommand

FRONT = CAMERAS["front"]
WIDTH, HEIGHT = 640, 480
WARM_UP, PATIENCE_S = 20, 0.5
APART_S = (0.012, 0.020)
POSES = "/bench/desired_pose"
"""Stamped poses, so that each is known again wherever it comes by; the robot stands meanwhile."""

PROFILE = """\
extends: panda_ros2
cameras: {{front: {{rate_hz: 200, check: {{same_s: 0}}}}, wrist: null}}
ros2:
  domain: {domain}
  cameras: {{wrist: null}}
  pose_command: {{topic: {poses}, type: geometry_msgs/msg/PoseStamped}}
task: {{prompt: hold, rate_hz: 100, worker: scripted}}
session: {{listen: ["{endpoint}"], connect: ["{endpoint}"]}}
"""

LEGS = {
    "picture_bridge": "picture: DDS -> bridge -> Zenoh",
    "picture_node": "picture: ROS key -> our node -> camera/front/raw",
    "chain": "camera/front/raw -> worker -> command/pose",
    "pose_node": "pose: command/pose -> our node -> ROS key",
    "pose_bridge": "pose: Zenoh -> bridge -> DDS",
    "total": "the whole way: picture in DDS -> pose in DDS",
}
ALONE = {
    "picture_dds": "picture: DDS alone, from process to process",
    "pose_dds": "pose: DDS alone, from process to process",
}


class Times:
    """When what was seen: stamp -> wall clock at its first arrival."""

    def __init__(self) -> None:
        self._seen: dict[object, int] = {}
        self._news = threading.Condition()

    def first_after(self, stamp_ns: int, until_s: float) -> int:
        """The first stamp later than this; raises `TimeoutError` where none comes by."""

        def found() -> list[int]:
            return [seen for seen in self._seen if isinstance(seen, int) and seen > stamp_ns]

        with self._news:
            if not self._news.wait_for(found, until_s - time.monotonic()):
                raise TimeoutError
            return min(found())

    def see(self, key: object, at_ns: int) -> None:
        with self._news:
            self._seen.setdefault(key, at_ns)
            self._news.notify_all()

    def wait(self, key: object, until_s: float) -> int:
        """Raises `TimeoutError` where it does not come by."""
        with self._news:
            if not self._news.wait_for(lambda: key in self._seen, until_s - time.monotonic()):
                raise TimeoutError
            return self._seen[key]

    def clear(self) -> None:
        with self._news:
            self._seen.clear()


def summary(values_ms: list[float]) -> dict[str, float]:
    p50, p95 = np.percentile(values_ms, (50, 95))
    return {"p50": float(p50), "p95": float(p95), "n": len(values_ms)}


class Camera:
    """The DDS camera: publishes one picture when told."""

    def __init__(self, node: RosNode) -> None:
        self._writer = node.publisher(FRONT, Image, reliable=False, depth=1)
        noise = noisy_picture(WIDTH, HEIGHT)
        self._pixels = noise.tobytes()

    def show(self) -> int:
        """Returns the picture's stamp, which is when it was published (ns)."""
        stamp_ns = time.time_ns()
        header = Header(Time.of(stamp_ns), "front_color_optical_frame")
        self._writer.write(Image(header, HEIGHT, WIDTH, "rgb8", 0, 3 * WIDTH, self._pixels))
        return stamp_ns


def rest() -> None:
    time.sleep(random.uniform(*APART_S))


# -- DDS alone ------------------------------------------------------------------------------------
def answer_over_dds(domain: int) -> None:
    """The second process: a pose for every picture, with the time of its arrival in it."""
    node = RosNode("echo", domain)
    writer = node.publisher(DESIRED_POSE, CartesianImpedanceGoal)

    def answer(picture: Image, arrived_ns: int) -> None:
        sent_ns = time.time_ns()
        numbers = [picture.header.stamp.ns, arrived_ns, sent_ns]
        parts = [float(part) for ns in numbers for part in divmod(ns, 10**9)]
        writer.write(CartesianImpedanceGoal(Pose(), [*parts, 0.0]))

    listener = Listener({node.subscription(FRONT, Image, reliable=False, depth=1): answer})
    print("ready", flush=True)
    sys.stdin.read()
    listener.close()


def measure_dds(requests: int) -> dict[str, list[float]]:
    """What DDS takes by itself, both ways, ms."""
    domain = free_domain()
    words = [sys.executable, __file__, "--answer", str(domain)]
    found: dict[str, list[float]] = {name: [] for name in ALONE}
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        node = RosNode("bench", domain)
        camera, heard = Camera(node), Times()

        def on_pose(goal: CartesianImpedanceGoal, arrived_ns: int) -> None:
            q = [int(number) for number in goal.q_n]
            stamp_ns, there_ns, back_ns = (q[i] * 10**9 + q[i + 1] for i in (0, 2, 4))
            heard.see(stamp_ns, arrived_ns)
            heard.see(("there", stamp_ns), there_ns)
            heard.see(("back", stamp_ns), back_ns)

        listener = Listener({node.subscription(DESIRED_POSE, CartesianImpedanceGoal): on_pose})
        for number in range(-WARM_UP, requests):
            stamp_ns = camera.show()
            try:
                arrived_ns = heard.wait(stamp_ns, time.monotonic() + PATIENCE_S)
                there_ns = heard.wait(("there", stamp_ns), time.monotonic() + PATIENCE_S)
                back_ns = heard.wait(("back", stamp_ns), time.monotonic() + PATIENCE_S)
            except TimeoutError:
                continue
            if number >= 0:
                found["picture_dds"].append((there_ns - stamp_ns) / 1e6)
                found["pose_dds"].append((arrived_ns - back_ns) / 1e6)
            rest()
        listener.close()
        node.close()
        process.communicate("")
    return found


# -- the whole way --------------------------------------------------------------------------------
@contextmanager
def lab() -> Iterator[tuple[Camera, RosNode, Bridge, Chain]]:
    """Robot without cameras, bridge, our nodes; this process is the camera."""
    domain, endpoint = free_domain(), free_endpoint()
    program = load_script().find_bridge()
    if program is None:
        sys.exit("no zenoh-bridge-ros2dds here: make ros2-bridge")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-ros2-")))
        profile = folder / "bench_ros2.yaml"
        profile.write_text(PROFILE.format(endpoint=endpoint, poses=POSES, domain=domain))
        bridge = Bridge(program, folder, generated(profile, beside=True)).start()
        stack.callback(bridge.kill)
        robot = Robot(domain, "--no-cameras")
        stack.callback(robot.end)
        node = RosNode("bench", domain)
        stack.callback(node.close)
        chain = stack.enter_context(running_chain(folder, profile_file=profile))
        yield Camera(node), node, bridge, chain


def measure_chain(requests: int) -> tuple[dict[str, list[float]], dict[str, float], int]:
    """Legs of the whole way in ms, shares of one core, and how many pictures got no answer."""
    found: dict[str, list[float]] = {name: [] for name in LEGS}
    lost = 0
    with lab() as (camera, node, bridge, chain):
        keys, session = chain.profile.keys, chain.session
        on_ros, raw, posed, posed_on_ros, in_dds = (Times() for _ in range(5))

        def hear(key: str, take: Callable[[zenoh.Sample, int], None]) -> object:
            def take_now(sample: zenoh.Sample) -> None:
                take(sample, time.time_ns())

            handler = zenoh.handlers.Callback(take_now, indirect=False)
            return session.declare_subscriber(key, handler)

        def on_picture(sample: zenoh.Sample, at_ns: int) -> None:
            on_ros.see(_ros_stamp_ns(sample), at_ns)

        def on_raw(sample: zenoh.Sample, at_ns: int) -> None:
            raw.see(_header(sample).stamp_wall_ns, at_ns)

        def on_pose(sample: zenoh.Sample, at_ns: int) -> None:
            pose = records.decode(PoseCommand, sample.payload.to_bytes())
            if pose.cause is not None:
                posed.see(pose.cause.observation_stamp_ns, at_ns)

        def on_ros_pose(sample: zenoh.Sample, at_ns: int) -> None:
            posed_on_ros.see(_ros_stamp_ns(sample), at_ns)

        def in_dds_pose(pose: PoseStamped, at_ns: int) -> None:
            in_dds.see(pose.header.stamp.ns, at_ns)

        subscribers = [
            hear(FRONT[1:], on_picture),
            hear(keys.camera_raw("front"), on_raw),
            hear(keys.command_pose, on_pose),
            hear(POSES[1:], on_ros_pose),
        ]
        listener = Listener({node.subscription(POSES, PoseStamped, depth=1000): in_dds_pose})
        _activate(camera, chain)
        before_s, began_s = _cpu(bridge, chain), time.monotonic()
        for number in range(-WARM_UP, requests):
            for times in (on_ros, raw, posed, posed_on_ros, in_dds):
                times.clear()
            stamp_ns = camera.show()
            give_up = time.monotonic() + PATIENCE_S
            try:
                t_ros = on_ros.wait(stamp_ns, give_up)
                t_raw = raw.wait(stamp_ns, give_up)
                t_pose = posed.wait(stamp_ns, give_up)
                # The first that our node made after it had the command.
                pose_ns = posed_on_ros.first_after(t_pose, give_up)
                t_ros_pose = posed_on_ros.wait(pose_ns, give_up)
                t_dds = in_dds.wait(pose_ns, give_up)
            except TimeoutError:
                lost += number >= 0
                continue
            if number >= 0:
                seen_ns = (stamp_ns, t_ros, t_raw, t_pose, t_ros_pose, t_dds)
                legs_ms = (np.diff(seen_ns) / 1e6).tolist()
                for name, leg_ms in zip(LEGS, [*legs_ms, (t_dds - stamp_ns) / 1e6], strict=True):
                    found[name].append(leg_ms)
            rest()
        took_s = time.monotonic() - began_s
        after_s = _cpu(bridge, chain)
        listener.close()
        del subscribers
        chain.client.deactivate()
    return found, {name: (after_s[name] - s) / took_s for name, s in before_s.items()}, lost


def _header(sample: zenoh.Sample) -> records.Header:
    attachment = sample.attachment
    return records.decode_header(attachment.to_bytes() if attachment else None)


def _ros_stamp_ns(sample: zenoh.Sample) -> int:
    """Of a message that begins with a header, behind the four bytes of CDR's own."""
    sec, nanosec = np.frombuffer(sample.payload.to_bytes()[4:12], "<u4").tolist()
    return sec * 10**9 + nanosec


def _activate(camera: Camera, chain: Chain) -> None:
    stop = threading.Event()

    def show() -> None:
        while not stop.wait(0.03):
            camera.show()

    thread = threading.Thread(target=show)
    thread.start()
    try:
        chain.activate_when_ready()
    finally:
        stop.set()
        thread.join()


def _cpu(bridge: Bridge, chain: Chain) -> dict[str, float]:
    pids = {"bridge": bridge.pid} | chain.host.supervisor.pids()
    return {name: cpu_s(pid) for name, pid in pids.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Latency of the ROS 2 path, leg by leg")
    parser.add_argument("--requests", type=int, default=200)
    parser.add_argument("-o", "--output", type=Path, help="file for the result")
    parser.add_argument("--answer", type=int, metavar="DOMAIN", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.answer is not None:
        answer_over_dds(chosen.answer)
        return
    load = os.getloadavg()[0]
    alone = measure_dds(chosen.requests)
    legs, shares, lost = measure_chain(chosen.requests)
    measured = {name: summary(values) for name, values in (legs | alone).items()}
    both = np.add(legs["picture_bridge"], legs["pose_bridge"])
    measured["bridge"] = summary(both.tolist())
    table = Table(title=f"One picture of {WIDTH}x{HEIGHT} in DDS, one pose in DDS. ms")
    for column in ("leg", "p50", "p95"):
        table.add_column(column, justify="left" if column == "leg" else "right")
    words = LEGS | {"bridge": "of it the bridge with DDS, both legs"} | ALONE
    for name, title in words.items():
        if name in ("total", "picture_dds"):
            table.add_section()
        table.add_row(title, f"{measured[name]['p50']:.2f}", f"{measured[name]['p95']:.2f}")
    console = Console()
    console.print(table)
    console.print(
        f"{len(legs['total'])} of {chosen.requests} pictures answered, {lost} not; load {load:.1f} "
        "at the start. Shares of one core: "
        + ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
    )
    if chosen.output:
        told = {"ms": measured, "cpu": shares, "lost": lost, "load": load}
        chosen.output.write_text(json.dumps(told, indent=2))


if __name__ == "__main__":
    main()
