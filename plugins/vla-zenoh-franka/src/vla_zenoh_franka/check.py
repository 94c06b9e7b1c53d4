"""Checks of a host that drives a Franka arm, and of the arm itself."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.errors import MissingExtraError, NodeError, how_to_install
from vla_zenoh.kinematics.kinematics import Kinematics, make_kinematics
from vla_zenoh.kinematics.so3 import Pose, pose_distance
from vla_zenoh.lab.doctor.computer import may_use_priority
from vla_zenoh.lab.doctor.needs import HostFinding, Level, judged
from vla_zenoh.profile import Profile
from vla_zenoh_franka.arm import FrankaArm, error_names, flange_pose
from vla_zenoh_franka.plugin import FrankaOptions

REALTIME_KERNEL = Path("/sys/kernel/realtime")
NETWORK = Path("/sys/class/net")
LIBRARY = "franky-control"
FITS = {5: ((0, 9), (0, 10)), 10: ((0, 18), None)}
"""FCI version -> oldest libfranka that speaks it, first that does not."""
HIGHEST_PRIORITY = 99
PINGS, PING_S, PING_TIMEOUT_S = 50, 0.02, 10
MOST_MS = 1.0
"""A cycle of the robot."""
LOOKS = 200
APART_M, APART_RAD = 1e-3, 2e-3
JOINTS = 7


@dataclass(frozen=True)
class Published:
    """Ranges and limits that Franka publishes for one kind of arm, joint 1 to 7.

    Source: "Robot and interface specifications" of the Franka Control Interface documentation.

    Args:
        fci: version of the interface that the robot speaks.
        velocity_rad_s: of the joints; the FR3's are smaller near the ends of the ranges.
        translation: of the end effector: m/s, m/s^2, m/s^3.
        rotation: of the end effector: rad/s, rad/s^2, rad/s^3.
        near_end: offset (rad/s) and deceleration (rad/s^2) of each joint: a joint this far from an
            end of its range (rad) may move at ``sqrt(2 * deceleration * far) - offset``, no more;
            empty: everywhere at `velocity_rad_s`.
    """

    fci: int
    lower_rad: tuple[float, ...]
    upper_rad: tuple[float, ...]
    velocity_rad_s: tuple[float, ...]
    acceleration_rad_s2: tuple[float, ...]
    jerk_rad_s3: tuple[float, ...]
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float]
    torque_nm: tuple[float, ...] = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
    near_end: tuple[tuple[float, float], ...] = ()


PANDA = Published(
    fci=5,
    lower_rad=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    upper_rad=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    velocity_rad_s=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    acceleration_rad_s2=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
    jerk_rad_s3=(7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
    translation=(1.7, 13.0, 6500.0),
    rotation=(2.5, 25.0, 12500.0),
)
FR3 = Published(
    fci=10,
    lower_rad=(-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159),
    upper_rad=(2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159),
    velocity_rad_s=(2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26),
    acceleration_rad_s2=(10.0,) * JOINTS,
    jerk_rad_s3=(5000.0,) * JOINTS,
    translation=(3.0, 9.0, 4500.0),
    rotation=(2.5, 17.0, 8500.0),
    near_end=(
        (0.30, 6.0),
        (0.20, 2.585),
        (0.20, 3.5),
        (0.30, 4.0),
        (0.35, 17.0),
        (0.35, 5.5),
        (0.35, 17.0),
    ),
)
BY_FCI: Mapping[int, Published] = {limits.fci: limits for limits in (PANDA, FR3)}


# -- the host ---------------------------------------------------------------------------------
def fci_host(franka: FrankaOptions) -> Iterator[HostFinding]:
    """What the 1 kHz loop of a Franka arm needs of this computer."""
    yield library(franka)
    yield kernel(franka)
    yield priority(franka)
    yield network_card(franka)
    yield round_trip(franka)


def library(franka: FrankaOptions) -> HostFinding:
    """franky is installed, on a libfranka that speaks the version of the profile."""
    name = "FCI: library"
    try:
        found = metadata.distribution(LIBRARY)
    except metadata.PackageNotFoundError:
        return HostFinding(
            name, "fail", f"no {LIBRARY}", how_to_install("franky", "vla-zenoh-franka")
        )
    files = [Path(str(file)).name for file in found.files or ()]
    versions = [
        match[1] for file in files if (match := re.match(r"libfranka.*\.so\.([\d.]+)$", file))
    ]
    text = f"{LIBRARY} {found.version}, libfranka {versions[0] if versions else 'unknown'}"
    oldest, first_unfit = FITS[franka.fci]
    numbers = tuple(map(int, versions[0].split("."))) if versions else oldest
    if numbers < oldest or (first_unfit is not None and numbers >= first_unfit):
        wanted = ".".join(map(str, oldest)) + (" or newer" if first_unfit is None else "")
        advice = f"FCI {franka.fci} needs a franky built with libfranka {wanted}"
        return HostFinding(name, "fail", text, advice)
    return HostFinding(name, "ok", f"{text}, for FCI {franka.fci}")


def kernel(franka: FrankaOptions, flag: Path = REALTIME_KERNEL) -> HostFinding:
    """The kernel is a real-time one."""
    real_time = flag.exists() and flag.read_text().strip() == "1"
    what = " is no real-time kernel; the robot ends a motion after 20 lost cycles"
    return judged(
        "FCI: kernel",
        real_time,
        os.uname().release + (", real time" if real_time else what),
        "install a kernel with PREEMPT_RT",
        _level(franka),
    )


def priority(franka: FrankaOptions) -> HostFinding:
    """This user may use the priority that libfranka takes."""
    may = may_use_priority(HIGHEST_PRIORITY)
    found = f"SCHED_FIFO {HIGHEST_PRIORITY} is {'' if may else 'not '}permitted"
    advice = f"allow this user rtprio {HIGHEST_PRIORITY} and memlock unlimited (limits.conf)"
    return judged("FCI: priority", may, found, advice, _level(franka))


def network_card(franka: FrankaOptions, folder: Path = NETWORK) -> HostFinding:
    """The way to the robot is a cable of 1 Gbit/s."""
    name, address = "FCI: network card", franka.address
    route = _output("ip", "-o", "route", "get", address)
    match = re.search(r"\bdev (\S+)", route)
    if match is None:
        advice = "plug the robot into a card of its own, with an address in the robot's network"
        return HostFinding(name, "warn", f"no route to {address} found", advice)
    card = match[1]
    if card == "lo":
        return HostFinding(name, "ok", f"{address} is this computer: a simulator")
    if (folder / card / "wireless").exists():
        return HostFinding(name, "fail", f"{card} is wireless", "use a cable to the control box")
    try:
        speed = int((folder / card / "speed").read_text())
    except (OSError, ValueError):
        speed = -1
    if speed <= 0:  # Linux writes -1 where it is not known
        return HostFinding(name, "warn", f"{card}, of unknown speed", "it should be 1 Gbit/s")
    advice = "use 1 Gbit/s, without a hub"
    return judged(name, speed >= 1000, f"{card}, {speed} Mbit/s", advice)


def round_trip(franka: FrankaOptions) -> HostFinding:
    """Packets to the robot and back take less than one of its cycles."""
    name, address = "FCI: round trip", franka.address
    if shutil.which("ping") is None:
        return HostFinding(name, "warn", "not measured: no ping", "sudo apt install iputils-ping")
    said = _output("ping", "-q", "-c", str(PINGS), "-i", str(PING_S), "-W", "1", address)
    match = re.search(r"= [\d.]+/([\d.]+)/([\d.]+)/", said)
    if match is None:
        return HostFinding(name, "fail", f"{address} does not answer", "is the control box on?")
    mean_ms, most_ms = float(match[1]), float(match[2])
    found = f"mean {mean_ms:.2f} ms, largest {most_ms:.2f} ms of {PINGS}"
    found += f"; a cycle is {MOST_MS:g} ms" if most_ms >= MOST_MS else ""
    advice = "a card of its own, no switch, no power saving (ethtool --set-eee), a quiet host"
    return judged(name, most_ms < MOST_MS, found, advice)


def _level(franka: FrankaOptions) -> Level:
    return "fail" if franka.realtime == "enforce" else "warn"


def _output(*command: str) -> str:
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=PING_TIMEOUT_S
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout


# -- the arm ----------------------------------------------------------------------------------
def fci_arm(profile: Profile, franka: FrankaOptions) -> Iterator[HostFinding]:
    """Connect to the arm, read it and compare it with the profile; moves and sets nothing."""
    try:
        arm = FrankaArm(profile, franka)
        arm.connect()
    except (NodeError, MissingExtraError) as error:
        yield HostFinding("connection", "fail", str(error), "see `vla-zenoh doctor --profile`")
        return
    try:
        robot = arm.robot
        yield HostFinding("connection", "ok", f"{franka.address}, FCI {franka.fci}")
        yield _state(robot)
        yield _readings(robot)
        yield _flange(robot)
        if franka.fci >= BY_FCI[10].fci:  # an older one sends no description
            yield from _description(robot.model_urdf, profile)
        yield _limits(profile, franka)
    finally:
        arm.close()


def _state(robot: Any) -> HostFinding:
    state = robot.state
    mode, errors = state.robot_mode.name, error_names(state.current_errors)
    found = f"mode {mode}" + (f", errors {', '.join(errors)}" if errors else "")
    advice = "unlock the joints and activate FCI in Desk; a reflex ends with `vla-zenoh reset`"
    return judged("state", mode == "Idle" and not errors, found, advice)


def _readings(robot: Any) -> HostFinding:
    times = [robot.state.time.to_msec() for _ in range(LOOKS)]
    lost = int(np.maximum(np.diff(times) - 1, 0).sum())
    found = f"{LOOKS} states in {times[-1] - times[0]} ms of the robot, {lost} lost"
    advice = "see `FCI: round trip` of vla-zenoh doctor"
    return judged("readings", lost <= LOOKS // 20, found, advice)


def _flange(robot: Any) -> HostFinding:
    """The robot's own flange is where Franka's published kinematics puts it."""
    state = robot.state
    own = state.O_T_EE.matrix @ np.linalg.inv(state.F_T_EE.matrix)
    ours = flange_pose(np.array(state.q))
    return _apart("flange", "published kinematics", _pose(own), _pose(ours))


def _description(urdf: str, profile: Profile) -> Iterator[HostFinding]:
    """The robot's own description against that of the profile."""
    joints = re.findall(r'<joint name="([^"]*joint[1-7])"', urdf)
    links = re.findall(r'<link name="([^"]*link8)"', urdf)
    if len(joints) != JOINTS or not links:
        yield HostFinding("description", "warn", "the robot's URDF has other joints than expected")
        return
    with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
        file.write(urdf)
        file.flush()
        own = Kinematics(Path(file.name), links[0], joints)
    ours, random = make_kinematics(profile), np.random.default_rng(0)
    middle_rad = np.mean(ours.sampled_rad, axis=0)
    # (4, 4): our TCP in the frame of the flange.
    tool = np.linalg.inv(flange_pose(middle_rad)) @ _matrix(ours.forward(middle_rad))
    worst = Pose(np.zeros(3), np.eye(3)), Pose(np.zeros(3), np.eye(3))
    for _ in range(LOOKS):
        joints_rad = random.uniform(*ours.sampled_rad)
        there = _pose(_matrix(ours.forward(joints_rad)) @ np.linalg.inv(tool))
        pair = own.forward(joints_rad), there
        worst = max(worst, pair, key=lambda poses: pose_distance(*poses)[0])
    yield _apart("description", f"the robot's own, in {LOOKS} poses", *worst)
    beyond = np.flatnonzero(
        (ours.lower_rad < own.lower_rad - 1e-6) | (ours.upper_rad > own.upper_rad + 1e-6)
    )
    names = ", ".join(ours.arm_joints[joint] for joint in beyond)
    found = f"beyond the robot's: {names}" if names else "within the robot's own"
    yield judged("joint ranges", not names, found, "narrow robot.joint_range_rad", "fail")


def _limits(profile: Profile, franka: FrankaOptions) -> HostFinding:
    published = BY_FCI[franka.fci]
    above = [
        f"limits.joint.{name}"
        for name in ("velocity_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
        if np.any(np.array(profile.limits.joint.of(name, JOINTS)) > getattr(published, name))
    ]
    for section in ("translation", "rotation"):
        values = [value for _, value in getattr(profile.limits, section)]
        if np.any(np.array(values) > getattr(published, section)):
            above.append(f"limits.{section}")
    within = f"within those published for FCI {franka.fci}"
    found = f"above the published ones: {', '.join(above)}" if above else within
    return judged("limits", not above, found, level="fail")


def _apart(name: str, of: str, own: Pose, ours: Pose) -> HostFinding:
    apart_m, apart_rad = pose_distance(own, ours)
    found = f"{1e3 * apart_m:.2f} mm and {1e3 * apart_rad:.2f} mrad from {of}"
    near = apart_m <= APART_M and apart_rad <= APART_RAD
    return judged(name, near, found, "is it another arm, or another description?", "fail")


def _pose(matrix: np.ndarray) -> Pose:
    return Pose(matrix[:3, 3], matrix[:3, :3])


def _matrix(pose: Pose) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.position_m
    return matrix
