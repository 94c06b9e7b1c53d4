"""A ROS 2 arm whose last joint turns without an end: it is sent numbers near those it reports."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from panda_arm import ARM_JOINTS, HOME_RAD
from ros2_turns import TICK_S, ros2_turns

from vla_zenoh import resources
from vla_zenoh.types import JointCommand, JointState

TURN = 2 * math.pi
SPEED_RAD_S, RAMP_S = 1.2, 0.5
NEAR_RAD = 0.02
REPORTED: dict[str, Callable[[float], float]] = {
    "from -pi to pi": lambda at: (at + math.pi) % TURN - math.pi,
    "from 0 to 2 pi": lambda at: at % TURN,
    "counted": lambda at: at + 7 * TURN,
}


def endless(folder: Path) -> str:
    """YAML of a Panda whose joint 7 has no end, commanded by joints."""
    text = resources.robot_urdf("shipped:panda.urdf").read_text()
    start = text.index('<joint name="panda_joint7"')
    end = text.index("</joint>", start)
    joint = text[start:end].replace('type="revolute"', 'type="continuous"')
    file = folder / "endless.urdf"
    file.write_text(text[:start] + joint + text[end:])
    topic = "{topic: /goal, type: trajectory_msgs/msg/JointTrajectory}"
    return (
        f"  joint_command: {topic}\n"
        f"robot: {{command: joint, posture: start, description: {file}}}\n"
    )


@pytest.mark.parametrize("form", REPORTED)
def test_what_it_is_sent_is_near_to_what_it_reports_over_a_whole_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    says, turn_1_s = REPORTED[form], math.pi / RAMP_S
    with ros2_turns(tmp_path, monkeypatch, endless(tmp_path)) as turns:
        true_rad, moved_s, apart, places = HOME_RAD.copy(), 0.0, [], []
        turns.joints_rad[6] = says(true_rad[6])
        turns.sleep(1.0)
        turns.turn()
        ours_rad = turns.newest(JointState).position_rad[6]
        assert -math.pi < ours_rad <= math.pi
        while true_rad[6] - HOME_RAD[6] < 1.1 * TURN:
            moved_s += TICK_S
            share = (1 - math.cos(turn_1_s * min(moved_s, RAMP_S))) / 2
            rates = np.zeros((2, len(ARM_JOINTS)))
            rates[0, 6] = SPEED_RAD_S * share
            if moved_s < RAMP_S:
                rates[1, 6] = SPEED_RAD_S * turn_1_s * math.sin(turn_1_s * moved_s) / 2
            true_rad[6] += SPEED_RAD_S * share * TICK_S
            goal_rad = true_rad.copy()
            goal_rad[6] += ours_rad - HOME_RAD[6]
            turns.put(JointCommand(ARM_JOINTS, goal_rad, *rates, "active"))
            sent = len(turns.goals)
            turns.turn()
            if len(turns.goals) > sent:
                position = turns.goals[-1].points[0].positions
                apart.append(position[6] - turns.joints_rad[6])
            turns.joints_rad[6] = says(true_rad[6])
            places.append(turns.newest(JointState).position_rad[6])
        assert turns.arm.guard.following, turns.node.counters
        assert len(apart) > 0.95 * moved_s / TICK_S
        assert np.abs(apart).max() < NEAR_RAD
        assert np.abs(np.diff(places)).max() < NEAR_RAD
        assert places[-1] - ours_rad == pytest.approx(1.1 * TURN, abs=NEAR_RAD)
        assert turns.newest(JointState).endless == ("panda_joint7",)
