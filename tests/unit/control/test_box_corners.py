"""An arm moved in joints whose policy asks for one corner of the workspace box after the other."""

from __future__ import annotations

import numpy as np
import pytest
from command_rig import Rig, profile, reach_of

from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import exp3, quat_from_rotation
from vla_zenoh.profile import override

HALF_M, TURN_RAD = 0.1, 0.2
STEPS, EVERY = 64, 10
GENTLE = {"acceleration_rad_s2": 3.5, "jerk_rad_s3": 300.0}
"""Three faces ask more of such joints at once than they can do in a tick."""


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "joint", "most_m"),
    [(17, {}, 1e-4), (23, {}, 1e-4), (28, {}, 1e-4), (17, GENTLE, 1e-4)],
)
def test_the_tcp_keeps_to_the_corners_of_its_box(
    seed: int, joint: dict[str, float], most_m: float
) -> None:
    base = override(profile(), {"robot": {"command": "joint"}})
    arm = make_kinematics(base)
    home_rad = arm.ordered(base.robot.arm_joints, base.robot.home_rad)
    home = arm.forward(home_rad)
    low, high = home.position_m - HALF_M, home.position_m + HALF_M
    faces = np.stack([low, high], axis=1).tolist()
    box = dict(zip(("x_m", "y_m", "z_m"), faces, strict=True))
    of = override(base, {"limits": {"workspace": box, "joint": joint}})
    action = {"kind": "absolute", "rotation": "quaternion", "gripper": "none", "dt_s": 1 / 30}
    rig = Rig(of, reach=reach_of(of), horizon=STEPS, **action)
    rig.joints_of_tcp = False
    rig.stand_at(arm, home_rad)
    rig.tick(chunks=[rig.chunk([[*home.position_m, *quat_from_rotation(home.rotation)]])])
    rig.put("active", True)
    rng = np.random.default_rng(seed)
    beyond_m: list[float] = []
    for _ in range(14):
        corner_m = home.position_m + rng.choice([-HALF_M, HALF_M], 3)
        turned = exp3(rng.uniform(-TURN_RAD, TURN_RAD, 3)) @ home.rotation
        asked = [[*corner_m, *quat_from_rotation(turned)]] * STEPS
        for tick in range(int(0.4 * rng.integers(40, 400))):
            out = rig.tick(chunks=[rig.chunk(asked)] if tick % EVERY == 0 else [])
            assert out.joint is not None
            rig.stand_at(arm, np.array(out.joint.position_rad))
            here_m = rig.position_m
            beyond_m.append(float(np.maximum(low - here_m, here_m - high).max()))
    assert -1e-3 < max(beyond_m) < most_m
