"""Every shipped profile loads, is frozen, comes back from its own text, and fits its robot."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pytest
import zenoh
from pydantic import BaseModel, ValidationError

from vla_zenoh import resources
from vla_zenoh.bus.session import session_config
from vla_zenoh.lab.profile.check import advice
from vla_zenoh.profile import Profile, load_profile, to_yaml

SHIPPED = sorted(path.stem for path in resources.shipped("profiles").glob("*.y*ml"))
HOME_MARGIN_M = 0.02  # from the workspace's walls, of the TCP in its home pose
HOME_MARGIN_RAD = 0.05  # from the joints' ends
PLACEHOLDERS = {"panda_sim_two_hosts", "panda_sim_lab", "panda_sim_two_sites"}
"""Their addresses are to be replaced, which is advised."""


loaded = cache(load_profile)


@pytest.fixture(params=SHIPPED)
def profile(request: pytest.FixtureRequest) -> Profile:
    return loaded(request.param)


def sections(value: Any) -> list[BaseModel]:
    if isinstance(value, BaseModel):
        inner = [getattr(value, name) for name in type(value).model_fields]
        return [value, *(section for item in inner for section in sections(item))]
    if isinstance(value, dict):
        return [section for item in value.values() for section in sections(item)]
    return []


def test_some_profiles_are_shipped() -> None:
    assert "panda_sim" in SHIPPED


def test_a_profile_is_frozen_all_the_way_down(profile: Profile) -> None:
    assert len(sections(profile)) > 10
    for section in sections(profile):
        for name in type(section).model_fields:
            with pytest.raises(ValidationError, match="frozen"):
                setattr(section, name, None)
            assert not isinstance(getattr(section, name), (list, set))


def test_a_profile_comes_back_from_its_own_text(profile: Profile, tmp_path: Path) -> None:
    path = tmp_path / f"{profile.name}.yaml"
    path.write_text(to_yaml(profile))
    assert load_profile(str(path)) == profile
    assert Profile.model_validate_json(profile.model_dump_json()) == profile
    json.dumps(profile.model_dump(mode="json"), allow_nan=False)


def test_a_profile_says_what_it_is_for(profile: Profile) -> None:
    assert profile.about


def test_a_shipped_profile_is_not_questionable(profile: Profile) -> None:
    assert bool(advice(profile)) == (profile.name in PLACEHOLDERS)


def test_zenoh_takes_the_session_of_every_host(profile: Profile) -> None:
    for host in profile.hosts.values():
        for mode in ("client", "router"):
            settings = session_config(profile.session, mode=mode, connect=host.connect)
            zenoh.Config.from_json5(json.dumps(settings))


def test_the_robot_has_the_joints_and_frames_that_are_named(profile: Profile) -> None:
    model = pinocchio.buildModelFromUrdf(str(resources.robot_urdf(profile.robot.description)))
    assert {*profile.robot.arm_joints, *profile.robot.finger_joints} <= set(model.names)
    assert {profile.robot.base_frame, profile.robot.tcp_frame} <= {f.name for f in model.frames}


def test_the_home_pose_is_within_joints_and_workspace(profile: Profile) -> None:
    robot = profile.robot
    model = pinocchio.buildModelFromUrdf(str(resources.robot_urdf(robot.description)))
    q = pinocchio.neutral(model)
    for name, angle_rad in zip(robot.arm_joints, robot.home_rad, strict=True):
        at = model.joints[model.getJointId(name)].idx_q
        q[at] = angle_rad
        low, high = model.lowerPositionLimit[at], model.upperPositionLimit[at]
        assert low + HOME_MARGIN_RAD < angle_rad < high - HOME_MARGIN_RAD, name
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, q)
    base = data.oMf[model.getFrameId(robot.base_frame)]
    tcp_m = base.actInv(data.oMf[model.getFrameId(robot.tcp_frame)]).translation
    space = profile.limits.workspace
    walls = np.array([space.x_m, space.y_m, space.z_m])
    assert (tcp_m > walls[:, 0] + HOME_MARGIN_M).all()
    assert (tcp_m < walls[:, 1] - HOME_MARGIN_M).all()
