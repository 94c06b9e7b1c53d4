"""A fault of one part, node or stream while two arms move: both stand in time, and apart.

``python -m pytest -s -m "" tests/fault/test_pair_faults.py`` prints the rows of the table in
docs/explanation/reliability.md. All figures are of the joints that MuJoCo has, as the simulator's
own process wrote them down (`netns.flight`).
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import netns.flight_log
import numpy as np
import pytest
from camera_rig import free_endpoint
from chain import CHAIN_PATIENCE_S, READY_PATIENCE_S, Chain, running_chain
from netns.flight_log import STILL_M_S, Flight
from pair_rig import DT_S, HORIZON, PARTS, apart_m, reach, shipped

from vla_zenoh.types import FloatArray

WORKER = "worker-scripted_pair"
JOINTS = 7
HOME_RAD = np.array(shipped().robot.home_rad)
AT_HOME_RAD = 0.02
FAST_RAD_S = 0.2
AROUND_S = 0.1
"""The hardest motion within this before the fault is what has to be braked."""
ARM_S = 0.15
"""The measured arm follows with a spring, and a busy machine adds to it."""
TOLERANCE_M = 1e-3
SEEN_S = 0.3
STANDS_S = 12.0
PROFILE = """\
extends: two_pandas_sim
cameras:
  top: {{width: 320, height: 240, rate_hz: 10}}
  front: null
  left_wrist: null
  right_wrist: null
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
timing: {{command_timeout_s: {command}, state_timeout_s: {state}}}
"""


@dataclass(frozen=True)
class Arms:
    """The chain, and what its processes wrote down."""

    chain: Chain
    folder: Path

    def rows(self, part: str, node: str = "sim", last: int = 0) -> FloatArray:
        """(n, 1 + 2 * JOINTS): monotonic time (s), position and velocity of each joint."""
        path = self.folder / f"{part}.{node}.joints"
        width = 8 * (1 + 2 * JOINTS)
        size = path.stat().st_size // width if path.exists() else 0
        first = max(0, size - last) if last else 0
        count = (size - first) * (1 + 2 * JOINTS)
        if not count:
            return np.empty((0, 1 + 2 * JOINTS))
        return np.fromfile(path, count=count, offset=first * width).reshape(-1, 1 + 2 * JOINTS)

    def fast(self) -> bool:
        """Both arms move."""
        ends = [self.rows(part, last=1)[:, 1 + JOINTS :] for part in PARTS]
        return all(np.abs(end).max(initial=0.0) > FAST_RAD_S for end in ends)

    def block(self, what: str, share: float = 1.0) -> None:
        """Lose that share of all records whose key has `what` in it."""
        new = self.folder / "blocked.new"
        new.write_text(f"{share} {what}")
        new.replace(self.folder / "blocked")

    def unblock(self) -> None:
        (self.folder / "blocked").unlink(missing_ok=True)

    def signal(self, node: str, number: signal.Signals) -> None:
        os.kill(self.chain.pid(node), number)


@pytest.fixture(scope="module")
def arms(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arms]:
    folder = tmp_path_factory.mktemp("pair")
    profile = folder / "pair.yaml"
    profile.write_text(PROFILE.format(endpoint=free_endpoint(), **CHAIN_PATIENCE_S))
    recorder = Path(netns.flight_log.__file__).parent / "flight"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FLIGHT_FOLDER", str(folder))
        patch.setenv("FLIGHT_PARTS", ",".join(PARTS))
        patch.setenv("PYTHONPATH", str(recorder), prepend=os.pathsep)
        with running_chain(folder, profile_file=profile) as chain:
            yield Arms(chain, folder)


def move(arms: Arms) -> None:
    """From rest: activate, and wait until both arms are fast."""
    chain = arms.chain
    arms.unblock()  # what a test that failed has left
    if chain.state() in ("stopped", "fault"):
        chain.client.publish(chain.client.keys.reset, "")
    chain.client.publish(chain.client.keys.active, "false")

    def rests() -> bool:
        return chain.state() == "inactive" and bool(chain.detail("at_rest"))

    def at_home() -> bool:
        here = [arms.rows(part, last=1)[:, 1 : 1 + JOINTS] for part in PARTS]
        if all(np.abs(row - HOME_RAD).max(initial=0.0) < AT_HOME_RAD for row in here):
            return True
        chain.client.publish(chain.client.keys.sim_reset, "")  # rejected while commands come
        return False

    chain.until("the arms stand", rests, READY_PATIENCE_S)
    chain.until("both are home, from where the way is long", at_home, READY_PATIENCE_S)
    chain.activate_when_ready()
    chain.client.set_prompt("lift the bar")
    chain.until("both arms move", arms.fast)


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong.

    Args:
        about: for the table.
        begin: makes it happen.
        patience_s: until whoever has to notices it, by the profile.
        end: ends it.
        measured_by: whose record says how the arms moved; a simulator that is dead has none.
    """

    about: str
    begin: Callable[[Arms], None]
    patience_s: float
    end: Callable[[Arms], None] = lambda _: None
    measured_by: str = "sim"


TIMING = shipped().timing
COMMANDS_S, STATES_S = CHAIN_PATIENCE_S["command"], CHAIN_PATIENCE_S["state"]
JOINTS_MORE_S = 0.1
"""Joints may be older than a pose, see docs/design.md."""
TOKEN_S = TIMING.watchdog_s
"""A process that is gone is noticed by its connection."""
CHUNK_S = HORIZON * DT_S + 1.0 / shipped().task.rate_hz + TIMING.watchdog_s
"""The last chunk may be carried out, and the next one be late."""
FROZEN_S = 1.0
LOST_SHARE, LOSSY_S, FAR_RAD = 0.3, 1.5, 0.2


def killed(node: str, about: str, patience_s: float, measured_by: str = "sim") -> Fault:
    return Fault(
        f"{about}: SIGKILL",
        lambda arms: arms.signal(node, signal.SIGKILL),
        patience_s,
        measured_by=measured_by,
    )


def silent(node: str, about: str, patience_s: float) -> Fault:
    return Fault(
        f"{about}: SIGSTOP",
        lambda arms: arms.signal(node, signal.SIGSTOP),
        patience_s,
        lambda arms: arms.signal(node, signal.SIGCONT),
    )


def blocked(what: str, about: str, patience_s: float) -> Fault:
    return Fault(about, lambda arms: arms.block(what), patience_s, Arms.unblock)


def frozen_robot() -> Fault:
    def freeze(arms: Arms) -> None:
        arms.signal("sim", signal.SIGSTOP)
        time.sleep(FROZEN_S)
        arms.signal("sim", signal.SIGCONT)

    return Fault(f"robot node: SIGSTOP for {FROZEN_S:g} s", freeze, FROZEN_S + COMMANDS_S)


def stop(arms: Arms) -> None:
    arms.chain.client.publish(arms.chain.client.keys.stop, "stop")


FAULTS = {
    "worker-killed": killed(WORKER, "worker", TOKEN_S),
    "worker-silent": silent(WORKER, "worker", CHUNK_S),
    "command-killed": killed("command", "command node", COMMANDS_S),
    "command-silent": silent("command", "command node", COMMANDS_S),
    "camera-killed": killed("camera", "camera node", TOKEN_S),
    "camera-silent": silent("camera", "camera node", CHUNK_S),
    "router-killed": killed("router", "router", COMMANDS_S),
    "router-silent": silent("router", "router", COMMANDS_S),
    "robot-killed": killed("sim", "robot node (commanded joints)", STATES_S, "command"),
    "robot-silent": frozen_robot(),
    "joints": blocked("left/state/joint", "joints of `left` not sent", STATES_S + JOINTS_MORE_S),
    "pose": blocked("left/state/pose", "pose of `left` not sent", STATES_S),
    "gripper": blocked("left/state/gripper", "gripper of `left` not sent", STATES_S),
    "states": blocked("left/state/", "no state of `left` sent", STATES_S),
    "commands": blocked("left/command/joint", "commands for `left` not sent", COMMANDS_S),
    "stop": Fault("`stop` of an operator", stop, 0.0),
}
QUICK = ("worker-killed", "command-killed", "router-killed", "states", "commands")


def least_m(rows: dict[str, FloatArray]) -> float:
    """Smallest distance between the arms at the times of the first one's rows."""
    left, right = (rows[part] for part in PARTS)
    nearest = np.searchsorted(right[:, 0], left[:, 0]).clip(max=len(right) - 1)
    return min(
        apart_m(one[1 : 1 + JOINTS], other[1 : 1 + JOINTS], 1.0)
        for one, other in zip(left[::2], right[nearest][::2], strict=True)
    )


def flight(part: str, rows: FloatArray) -> Flight:
    """The motion of the TCP that the joints make."""
    kinematics, here = reach()[part].kinematics, rows[:, 1 : 1 + JOINTS]
    found = [kinematics.pose_and_jacobian(joints_rad) for joints_rad in here]
    position_m = np.array([pose.position_m for pose, _ in found]).reshape(-1, 3)
    moves = zip(found, rows[:, 1 + JOINTS :], strict=True)
    twist = np.array([jacobian @ speed for (_, jacobian), speed in moves]).reshape(-1, 6)
    unknown = np.full(len(rows), np.nan)
    return Flight(rows[:, 0], position_m, twist, np.zeros((len(rows), 3)), unknown, unknown)


def brake_s(part: str, speed_rad_s: FloatArray) -> float:
    """The longest that a joint takes to rest within its limits, in full acceleration at first."""
    limits = shipped().of_part(part).limits.joint
    hardest = np.array(limits.acceleration_rad_s2)
    ends_s = hardest / np.array(limits.jerk_rad_s3)
    return float((speed_rad_s / hardest + 2 * ends_s).max())


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in FAULTS]
)
def test_both_arms_stand_in_time_and_apart(arms: Arms, name: str) -> None:
    fault, chain = FAULTS[name], arms.chain
    move(arms)

    def tracks(since_s: float) -> dict[str, FloatArray]:
        every = {part: arms.rows(part, fault.measured_by) for part in PARTS}
        return {part: rows[rows[:, 0] >= since_s] for part, rows in every.items()}

    def stand() -> bool:
        moved = tracks(time.monotonic() - SEEN_S)
        return all((np.abs(rows[:, 1 + JOINTS :]) < 0.01).all() for rows in moved.values())

    began_s = time.monotonic()
    try:
        fault.begin(arms)
        time.sleep(fault.patience_s + SEEN_S)
        chain.until("both stand", stand, STANDS_S)
        ended_s = time.monotonic()
    finally:
        fault.end(arms)
    chain.until("it is not active", lambda: chain.state() != "active", STANDS_S)

    least, cells, late = np.inf, [], []
    moved = tracks(began_s - AROUND_S)
    if fault.measured_by == "sim":
        least = least_m(moved)
    for part, rows in moved.items():
        rows = rows[rows[:, 0] <= ended_s]
        path = flight(part, rows)
        fast = np.flatnonzero(path.speed_m_s > STILL_M_S)
        stood_s = path.time_s[fast[-1]] - began_s
        way = path.between(began_s, began_s + stood_s).position_m
        way_m = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
        allowed_s = fault.patience_s + brake_s(part, np.abs(rows[:, 1 + JOINTS :]).max(axis=0))
        allowed_m = float(path.speed_m_s.max()) * allowed_s
        cells.append(f"{stood_s:.2f} s, {way_m:.3f} m ({allowed_s:.2f} s, {allowed_m:.3f} m)")
        late.append((stood_s - allowed_s, way_m - allowed_m, path.speed_m_s.max()))
    nearest = f"{least:.3f} m" if np.isfinite(least) else "-"
    print(f"\n| `{name}` {fault.about} | {' | '.join(cells)} | {nearest} |")
    velocity_m_s = shipped().limits.translation.velocity_m_s
    for late_s, far_m, speed_m_s in late:
        assert late_s <= ARM_S
        assert far_m <= TOLERANCE_M
        assert speed_m_s <= velocity_m_s
    assert least >= shipped().limits.reach.part_stop_m - TOLERANCE_M


@pytest.mark.slow
def test_arms_go_on_while_some_of_the_frames_of_one_are_lost(arms: Arms) -> None:
    move(arms)
    began_s = time.monotonic()
    arms.block("/left/", LOST_SHARE)
    time.sleep(LOSSY_S)
    arms.unblock()
    moved = {part: arms.rows(part) for part in PARTS}
    moved = {part: rows[rows[:, 0] >= began_s] for part, rows in moved.items()}
    assert arms.chain.state() == "active"
    for rows in moved.values():
        assert np.abs(rows[-1, 1 : 1 + JOINTS] - HOME_RAD).max() > FAR_RAD
    assert least_m(moved) >= shipped().limits.reach.part_stop_m - TOLERANCE_M
