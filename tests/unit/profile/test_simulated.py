"""`up --sim`: the robot of any profile, simulated."""

from __future__ import annotations

import pytest

from vla_zenoh.profile import load_profile, read_profile, simulated, to_yaml
from vla_zenoh.resources import names

REAL = [name for name in names("profiles") if load_profile(name).robot.driver != "sim"]


def test_there_are_real_robots_to_simulate() -> None:
    assert {"fr3", "panda_ros2", "so101_lerobot", "ur5e_rtde"} <= set(REAL)


@pytest.mark.parametrize("name", REAL)
def test_a_real_robot_is_simulated_with_what_its_profile_says_else(name: str) -> None:
    real = load_profile(name)
    made = simulated(real)
    assert made.robot.driver == "sim"
    assert made.robot.model_copy(update={"driver": real.robot.driver}) == real.robot
    assert made.limits == real.limits
    assert set(made.cameras) == set(real.cameras)
    assert all(camera.source.startswith("sim:") for camera in made.cameras.values())
    kinds = [kind for host in made.hosts.values() for kind in host.nodes]
    assert "sim" in kinds
    assert not {"arm", "ros2"} & set(kinds)
    assert ("camera" in kinds) is bool(real.cameras)
    assert read_profile(to_yaml(made), "again") == made


def test_a_simulated_robot_stays_as_it_is() -> None:
    profile = load_profile("panda_sim")
    assert simulated(profile) is profile
