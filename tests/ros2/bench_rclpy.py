"""What a robot of ROS 2's own rclpy on Fast DDS shows: exactness, latency, stops and faults.

    make bench-rclpy          (python tests/ros2/bench_rclpy.py --distribution jazzy --only stops)

Robot, cameras and a ROS user are rclpy programs (`ros_side/`), between them and our nodes is the
real bridge. Motion is read from the robot's own log, stamps of all processes are of one computer's
clocks. Prints tables as they stand in docs/how-to/ros2.md.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

# Run as a program, and not by pytest, which knows where the rest of the tests' own code is.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from bridge import load_script
from rclpy_rig import (
    ANSWER,
    EMPTY,
    FRONT,
    LOSSY,
    Program,
    RosLab,
    WallClock,
    carry_out,
    hear_answers,
    heard,
    library,
    panda_dh,
    publish,
    received_tcp,
    request,
    running_ros_lab,
)

from vla_zenoh.codec import records
from vla_zenoh.errors import SessionError

POSE = "geometry_msgs/msg/PoseStamped"
FAST_M_S, FAST_HZ = 0.17, 20.0
"""20 steps of 1 cm a second: 0.2 m/s; reached is what is nearly that."""
AWAY_S = 1.0
MOVES = 3
RESTART_S = 3.0
ANSWER_S, EVERY_S = 20.0, 0.1
"""A stop is published at 10 Hz for so long at most."""
NEW_PROGRAMS = (
    ("once", 0.0, 1, 10),
    ("once, 1 s after it made the publisher", 1.0, 1, 10),
    ("20 times at 10 Hz", 0.0, 20, 10),
    ("20 times at 10 Hz, depth 1", 0.0, 20, 1),
)
"""Words, how long it waits (s), how often, and the depth of the publisher's QoS."""
HEARTBEAT_S = 4.0
"""Fast DDS repeats what was not confirmed every 3 s."""
PICTURE = (640, 480)


def p50_p95(values: Any) -> str:
    """As in a table."""
    if not len(values):
        return "none"
    p50, p95 = np.percentile(values, (50, 95))
    return f"{p50:.2f} | {p95:.2f} | {len(values)}"


def say(text: str) -> None:
    print(text, flush=True)


# -- exactness ------------------------------------------------------------------------------------
def exactness(lab: RosLab) -> None:
    """Steps and turns, by FK of the joints that another rclpy node received."""
    lab.activate_at_rest()
    say("\n| asked | reached | error (mm, rad) |\n|---|---|---|")
    for words, count, wanted in (
        ("go up", 5, "z +0.05 m"),
        ("go down", 8, "z -0.08 m"),
        ("yaw left", 10, "0.5 rad about z"),
        ("roll left", 4, "0.2 rad about x"),
        ("pitch up", 4, "0.2 rad about y"),
    ):
        began = received_tcp(lab)
        carry_out(lab, words, count)
        ended = received_tcp(lab)
        way_m = ended[:3, 3] - began[:3, 3]
        turn_rad = panda_dh.turn_between(ended[:3, :3], began[:3, :3])
        asked_m, asked_rad = np.zeros(3), np.zeros(3)
        axis = {"go": 2, "yaw": 2, "roll": 0, "pitch": 1}[words.split()[0]]
        if words.startswith("go"):
            asked_m[2] = (1 if words == "go up" else -1) * 0.01 * count
        else:
            asked_rad[axis] = np.sign(turn_rad[axis]) * 0.05 * count
        off_mm = 1e3 * np.linalg.norm(way_m - asked_m)
        off_rad = np.linalg.norm(turn_rad - asked_rad)
        reached = f"{way_m[2]:+.5f} m" if words.startswith("go") else f"{turn_rad[axis]:+.5f} rad"
        say(f"| {words} x{count}: {wanted} | {reached} | {off_mm:.1e}, {off_rad:.1e} |")
    lab.settle()


# -- latency --------------------------------------------------------------------------------------
def latency(lab: RosLab, seconds: float) -> None:
    """Poses to rclpy and pictures from rclpy, beside rclpy to rclpy, in one run; ms."""
    keys, images = lab.chain.profile.keys, []

    def on_image(sample: zenoh.Sample) -> None:
        now_ns = time.time_ns()
        attachment = sample.attachment
        if attachment is not None:
            header = records.decode_header(attachment.to_bytes())
            images.append((now_ns - header.stamp_wall_ns) / 1e6)

    handler = zenoh.handlers.Callback(on_image, indirect=False)
    other = Program("person", lab.distribution, lab.domain).start()
    try:
        sensor = {"reliable": False, "depth": 5}
        other.ask("hear", "hears", topic=FRONT, type="sensor_msgs/msg/Image", qos_of=sensor)
        other.ask("hear", "hears", topic="/probe", type=POSE)
        lab.move(0.05)
        before, began_ns = len(other.told), time.monotonic_ns()
        subscriber = lab.chain.session.declare_subscriber(keys.camera_raw("front"), handler)
        lab.person.do(
            "say", topic="/probe", type=POSE, count=int(100 * seconds), rate_hz=100.0, stamped=True
        )
        time.sleep(seconds)
        subscriber.undeclare()
        lines = [line for line in lab.arm.told if "goal" in line and line["t"] > began_ns]
        hops = [(line["wall_ns"] - line["stamp_ns"]) / 1e6 for line in lines]

        def plain(topic: str) -> list[float]:
            out = []
            for line in heard(other, topic, before):
                stamp = line["value"]["header"]["stamp"]
                stamp_ns = stamp["sec"] * 10**9 + stamp["nanosec"]
                out.append((line["wall_ns"] - stamp_ns) / 1e6)
            return out

        say("\n| leg (ms) | p50 | p95 | n |\n|---|---|---|---|")
        say(f"| pose: sent by our node `ros2` → bridge → rclpy's callback | {p50_p95(hops)} |")
        say(f"| pose: rclpy → rclpy, beside it | {p50_p95(plain('/probe'))} |")
        say(f"| image {PICTURE}: rclpy → bridge → `camera/front/raw` | {p50_p95(images)} |")
        say(f"| image {PICTURE}: rclpy → rclpy, beside it | {p50_p95(plain(FRONT))} |")
    finally:
        other.end()
    lab.settle()


# -- stops ----------------------------------------------------------------------------------------
def reset(lab: RosLab) -> None:
    """As a ROS user does; then all is as it was."""
    answer = request(lab, "reset")
    assert answer["ok"], answer
    lab.settle()


def stops(lab: RosLab, count: int) -> None:
    """A ROS user stops the arm at 0.2 m/s."""
    took_s, ways_m, speeds = [], [], []
    for _ in range(count):
        lab.move(FAST_M_S, FAST_HZ)
        speeds.append(lab.arm.speed_m_s())
        before = len(lab.person.told)
        publish(lab.chain.session, lab.person, "/vla/stop", EMPTY)
        said_ns = lab.person.since(before, "said")[0]["t"]
        lab.arm.wait_still()
        track = lab.arm.track(said_ns)
        took_s.append(track.time_to_stand_s(said_ns))
        ways_m.append(float(np.linalg.norm(track.position_m[-1] - track.position_m[0])))
        lab.chain.until("stopped", lambda: lab.chain.state() == "stopped")
        reset(lab)
    say(f"\nstop from rclpy, {count} times, at {np.median(speeds):.3f} m/s (median):")
    say("| | p50 | p95 | n | most |\n|---|---|---|---|---|")
    say(f"| published → the arm stands, s | {p50_p95(took_s)} | {max(took_s):.3f} |")
    say(f"| way, mm | {p50_p95(1e3 * np.array(ways_m))} | {1e3 * max(ways_m):.1f} |")


def first_stops(lab: RosLab, count: int) -> None:
    """Of a ROS user's new program, which publishes as soon as it has a subscriber."""
    arrived_ns: list[int] = []
    subscriber = lab.chain.session.declare_subscriber(
        "vla/stop", lambda sample: arrived_ns.append(time.monotonic_ns())
    )
    say("\n| a new program publishes a stop | lost | arrives after, s: p50 | p95 | n | most |")
    say("|---|---|---|---|---|---|")
    for words, wait_s, times, depth in NEW_PROGRAMS:
        after_s = []
        for _ in range(count):
            person = Program("person", lab.distribution, lab.domain).start()
            arrived_ns.clear()
            stop = {"topic": "/vla/stop", "type": EMPTY, "qos_of": {"depth": depth}}
            if wait_s:
                person.ask("offer", "offers", **stop)
                time.sleep(wait_s)
            said_ns = person.ask("say", "said", **stop, count=times, rate_hz=10.0)["t"]
            time.sleep(times / 10.0)
            end_s = time.monotonic() + HEARTBEAT_S
            while not arrived_ns and time.monotonic() < end_s:
                time.sleep(0.01)
            after_s += [(at_ns - said_ns) / 1e9 for at_ns in arrived_ns[:1]]
            person.end()
        lost, most_s = count - len(after_s), max(after_s, default=0.0)
        say(f"| {words} | {lost} of {count} | {p50_p95(after_s)} | {most_s:.3f} |")
    subscriber.undeclare()
    lab.chain.until("stopped", lambda: lab.chain.state() == "stopped")
    reset(lab)


def move_at_last(lab: RosLab) -> None:
    """Move; behind a bridge that was just started the arm may not follow at once, which is said."""
    for left in reversed(range(MOVES)):
        try:
            lab.move(FAST_M_S, FAST_HZ)
        except AssertionError:
            if not left:
                raise
            whys = [event.why for _, _, event in lab.chain.client.pop_events()]
            say(f"it did not move, once more: {next((why for why in whys if 'not' in why), whys)}")
            lab.settle()
        else:
            return


def stops_while_the_bridge_restarts(lab: RosLab, count: int) -> None:
    """Killed and started at once; a ROS user publishes the stop until it is answered."""
    stood_s, ways_m, latched_s, tries, moved_m = [], [], [], [], []
    hear_answers(lab)
    for number in range(count):
        move_at_last(lab)
        killed_ns = time.monotonic_ns()
        lab.bridge.kill()
        lab.bridge.start()
        time.sleep(random.uniform(0.0, 1.5))
        before = len(lab.person.told)
        times, end_s = 0, time.monotonic() + ANSWER_S
        while not any(answered(lab, before)) and time.monotonic() < end_s:
            lab.person.ask("say", "said", topic="/vla/stop", type=EMPTY, wait_s=0.0)
            times += 1
            time.sleep(EVERY_S)
        if not answered(lab, before):
            sys.exit(f"stop {number + 1}: no answer in {ANSWER_S:.0f} s\n{lab.story()}")
        said_ns = lab.person.since(before, "said")[0]["t"]
        latched_s.append((answered(lab, before)[0] - said_ns) / 1e9)
        tries.append(times)
        lab.arm.wait_still()
        track = lab.arm.track(killed_ns)
        stands_s = track.time_to_stand_s(killed_ns)
        stood_s.append(stands_s)
        ways_m.append(float(np.linalg.norm(track.position_m[-1] - track.position_m[0])))
        after = track.between(killed_ns + int(stands_s * 1e9))
        moved_m.append(float(np.ptp(after.position_m, axis=0).max()))
        assert lab.chain.state() == "stopped", lab.chain.state()
        reset(lab)
        say(f"{number + 1}: stands after {stands_s:.2f} s, answered after {latched_s[-1]:.2f} s")
    say(f"\nstop from rclpy while the bridge restarts, {count} times:")
    say("| | p50 | p95 | n | most |\n|---|---|---|---|---|")
    say(f"| bridge killed → the arm stands, s | {p50_p95(stood_s)} | {max(stood_s):.3f} |")
    say(f"| way, mm | {p50_p95(1e3 * np.array(ways_m))} | {1e3 * max(ways_m):.1f} |")
    say(f"| first stop published → answered, s | {p50_p95(latched_s)} | {max(latched_s):.3f} |")
    say(f"| how often it was published, at 10 Hz | {p50_p95(tries)} | {max(tries)} |")
    say(
        f"| moved after it stood, mm | {p50_p95(1e3 * np.array(moved_m))} | "
        f"{1e3 * max(moved_m):.2f} |"
    )


def answered(lab: RosLab, before: int) -> list[int]:
    """When a stop was answered with ok (ns)."""
    return [
        line["t"]
        for line in heard(lab.person, ANSWER, before)
        if (said := json.loads(line["value"]["data"]))["what"] == "stop" and said["ok"]
    ]


# -- faults ---------------------------------------------------------------------------------------
def faults(lab: RosLab) -> None:
    """Each process killed in motion, by the robot's own log."""

    def kill(node: str) -> Callable[[], None]:
        return lambda: os.kill(lab.chain.pid(node), signal.SIGKILL)

    def nothing() -> None:
        """Started again by what supervises it."""

    say(
        "\n| killed at 0.1 m/s | stands after, s | way, mm | moved until activated, mm | obeys "
        "again | told |\n|---|---|---|---|---|---|"
    )
    for name, harm, mend in (
        ("bridge", lab.bridge.kill, lab.bridge.start),
        ("our node `ros2`", kill("ros2"), nothing),
        ("command node", kill("command"), nothing),
        ("worker", kill("worker-scripted"), nothing),
        ("router", kill("router"), nothing),
        ("robot", lab.arm.kill, lab.arm.start),
    ):
        lab.move()
        lab.chain.client.pop_events()
        time.sleep(0.3)
        at_ns = time.monotonic_ns()
        harm()
        time.sleep(AWAY_S)
        gone = not lab.arm.alive
        mend()
        back_ns = time.monotonic_ns()
        time.sleep(RESTART_S)
        track = lab.arm.track(back_ns if gone else at_ns)
        stands_s = float("nan") if gone else track.time_to_stand_s(at_ns)
        if np.isfinite(stands_s):
            rest = track.between(at_ns + int(stands_s * 1e9))
            way_m = np.linalg.norm(rest.position_m[0] - track.position_m[0])
        else:
            rest, way_m = track, float("nan")
        moved_m = np.ptp(rest.position_m, axis=0).max()
        told = [event.what for _, _, event in lab.chain.client.pop_events()]
        try:
            lab.settle()
            began = lab.activate_at_rest()
            up = began[2, 3] < 0.4
            ended = carry_out(lab, "go up" if up else "go down", 3)
            off_mm = abs(abs(ended[2, 3] - began[2, 3]) - 0.03) * 1e3
            obeys = f"yes, 3 steps to {off_mm:.1e} mm"
        except AssertionError as error:
            obeys = f"no: {str(error).splitlines()[0]}"
        say(
            f"| {name} | {stands_s:.3f} | {1e3 * way_m:.1f} | {1e3 * moved_m:.3f} | {obeys} | "
            f"{', '.join(dict.fromkeys(told))} |"
        )
    lab.settle()


def gaps_s(lab: RosLab, since_ns: int) -> Any:
    """Between the poses that the robot heard."""
    at_ns, _ = lab.arm.goals(since_ns)
    return np.diff(at_ns) / 1e9


def to_and_fro(lab: RosLab, name: str) -> None:
    """Up x5 and down x8 under a condition."""
    began_ns = time.monotonic_ns()
    lab.chain.client.pop_events()
    try:
        began = lab.activate_at_rest()
        up = carry_out(lab, "go up", 5)
        down = carry_out(lab, "go down", 8)
    except (AssertionError, SessionError) as error:
        say(f"| {name} | {str(error).splitlines()[0]} |")
        return
    off_mm = [1e3 * abs(up[2, 3] - began[2, 3] - 0.05), 1e3 * abs(down[2, 3] - up[2, 3] + 0.08)]
    told = dict.fromkeys(event.what for _, _, event in lab.chain.client.pop_events())
    gaps = gaps_s(lab, began_ns)
    say(
        f"| {name} | up x5 off by {off_mm[0]:.1e} mm, down x8 by {off_mm[1]:.1e} mm | poses every "
        f"{1e3 * np.median(gaps):.1f} ms (p50), {1e3 * np.percentile(gaps, 99):.1f} (p99), "
        f"{1e3 * gaps.max():.0f} (most) | {', '.join(told)} |"
    )


def with_loss(folder: Path, program: Path, distribution: str, loss: float) -> None:
    """Datagrams of the robot are lost, both ways."""
    lossy = {"LD_PRELOAD": library(folder, LOSSY), "LOSS": str(loss)}
    with running_ros_lab(folder, program, distribution, arm={"environ": lossy}) as lab:
        to_and_fro(lab, f"{loss:.0%} of the robot's datagrams lost, each way")
        if lab.chain.state() == "active":
            lab.settle()


def with_clock(folder: Path, program: Path, distribution: str) -> None:
    """The robot's clock is off, and set in motion."""
    clock = WallClock(folder)
    with running_ros_lab(folder, program, distribution, arm={"environ": clock.environ}) as lab:
        for name, offset_s in (("3 s on, in motion", 3.0), ("3 s back, in motion", -3.0)):
            clock.set(0.0)
            lab.chain.activate_when_ready()
            lab.settle()
            lab.move()
            time.sleep(0.3)
            at_ns = time.monotonic_ns()
            lab.chain.client.pop_events()
            clock.set(offset_s)
            time.sleep(1.5)
            track = lab.arm.track(at_ns)
            stands_s = track.time_to_stand_s(at_ns)
            told = dict.fromkeys(event.what for _, _, event in lab.chain.client.pop_events())
            way_mm = 1e3 * np.linalg.norm(track.position_m[-1] - track.position_m[0])
            say(
                f"| robot's clock set {name} | {lab.chain.state()}, stands after {stands_s:.3f} s, "
                f"way {way_mm:.1f} mm | | {', '.join(told)} |"
            )


def returns(folder: Path, program: Path, distribution: str, count: int) -> None:
    """The robot's node is killed in motion, and started at home while the bridge keeps a pose."""
    away_mm, moved_mm, late_ms = [], [], []
    for number in range(count):
        here = folder / f"return{number}"
        here.mkdir()
        with running_ros_lab(here, program, distribution) as lab:
            lab.chain.activate_when_ready()
            lab.settle()
            lab.move()
            lab.arm.kill()
            lab.chain.until("inactive", lambda lab=lab: lab.chain.state() == "inactive")
            before = len(lab.arm.told)
            lab.arm.start()
            time.sleep(RESTART_S)
            joints = [line["q"] for line in lab.arm.since(before, "q")]
            places_m = np.array([panda_dh.forward(np.array(q))[:3, 3] for q in joints])
            goals = lab.arm.since(before, "goal")
        moved_mm.append(1e3 * np.linalg.norm(places_m - places_m[0], axis=1).max())
        if len(goals) > 1:  # the last is ours to stay
            away_mm.append(1e3 * np.linalg.norm(np.array(goals[0]["goal"]) - places_m[0]))
            late_ms.append((goals[-1]["t"] - goals[0]["t"]) / 1e6)
    say(f"\nrobot's node killed in motion and started at home, {count} times:")
    say(f"an old pose came {len(away_mm)} times\n| | p50 | p95 | n | most |\n|---|---|---|---|---|")
    for what, values in (
        ("the old pose was away, mm", away_mm),
        ("ours to stay came after it, ms", late_ms),
        ("the arm moved, mm", moved_mm),
    ):
        say(f"| {what} | {p50_p95(values)} | {max(values, default=0.0):.1f} |")


# -------------------------------------------------------------------------------------------------
IN_ONE_LAB = ("exactness", "latency", "stops", "first", "restarts", "faults")
SECTIONS = (*IN_ONE_LAB, "loss", "clock", "returns")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Figures of an rclpy robot on Fast DDS")
    parser.add_argument("--distribution", default="jazzy")
    parser.add_argument("--only", choices=SECTIONS, action="append", help="default: everything")
    parser.add_argument("--stops", type=int, default=30)
    parser.add_argument("--returns", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=10.0, help="of the measured latency")
    chosen = parser.parse_args()
    only = chosen.only or SECTIONS
    program = load_script().find_bridge()
    if program is None:
        sys.exit("no zenoh-bridge-ros2dds here: make ros2-bridge")
    say(f"{chosen.distribution}, rmw_fastrtps_cpp; load {os.getloadavg()[0]:.1f} at the start")
    with tempfile.TemporaryDirectory(prefix="bench-rclpy-") as name:
        folder = Path(name)
        size = PICTURE if "latency" in only else (160, 120)
        if set(only) & set(IN_ONE_LAB):
            with running_ros_lab(folder, program, chosen.distribution, size=size) as lab:
                lab.chain.activate_when_ready()
                lab.settle()
                if "exactness" in only:
                    exactness(lab)
                if "latency" in only:
                    latency(lab, chosen.seconds)
                if "stops" in only:
                    stops(lab, chosen.stops)
                if "first" in only:
                    first_stops(lab, chosen.stops)
                if "restarts" in only:
                    stops_while_the_bridge_restarts(lab, chosen.stops)
                if "faults" in only:
                    faults(lab)
        if {"loss", "clock"} & set(only):
            say("\n| condition | motion | poses | told |\n|---|---|---|---|")
        if "loss" in only:
            with_loss(folder, program, chosen.distribution, 0.05)
        if "clock" in only:
            with_clock(folder, program, chosen.distribution)
        if "returns" in only:
            returns(folder, program, chosen.distribution, chosen.returns)
    say(f"load {os.getloadavg()[0]:.1f} at the end")


if __name__ == "__main__":
    main()
