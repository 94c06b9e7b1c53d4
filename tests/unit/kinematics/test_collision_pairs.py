"""Which pairs of an arm are checked: all that can touch, however rarely the samples see it; and how
large what is checked is."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from described_arms import SEVEN, TOOL, Row, Y, arm, urdf

from vla_zenoh.kinematics.collision import HELD, TABLE, CollisionModel
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.profile import KeepOut
from vla_zenoh.types import HeldBox

NEAR_M = 0.05
JOINTS = tuple(f"j{n}" for n in range(1, 8))


@pytest.mark.parametrize("seed", range(3))
def test_what_only_few_configurations_touch_is_checked(tmp_path: Path, seed: int) -> None:
    """Small things of the robot's own body, each where some configuration has the TCP."""
    rows = [*arm(SEVEN), TOOL]
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(rows))
    kinematics = Kinematics(path, "tcp", JOINTS)
    random = np.random.default_rng(seed)
    span_rad = kinematics.upper_rad - kinematics.lower_rad
    for number in range(4):
        joints_rad = kinematics.lower_rad + span_rad * random.random(kinematics.size)
        x, y, z = kinematics.forward(joints_rad).position_m.tolist()
        rows.append(Row(f"to_{number}", parent="base", kind="fixed", at_m=(x, y, z)))
    path.write_text(urdf(rows))
    pairs = CollisionModel(Kinematics(path, "tcp", JOINTS), near_m=NEAR_M).pairs
    for number in range(4):
        assert any({pair.first, pair.second} == {"tcp", f"to_{number}_link"} for pair in pairs)


def test_the_hand_is_what_moves_with_the_tcp_whichever_joint_comes_last(tmp_path: Path) -> None:
    """A rod that keeps a linkage parallel is a joint of its own, and no hand to the table."""
    rod = Row("rod", axis=Y, parent="j2_link", mimic=("j3", -1.0, 0.0))
    path = tmp_path / "arm.urdf"
    path.write_text(urdf([*arm(SEVEN), TOOL, rod]))
    collisions = CollisionModel(Kinematics(path, "tcp", JOINTS), near_m=1.0, table_z_m=-0.05)
    hand = {pair.first for pair in collisions.pairs if pair.is_hand}
    assert hand == {"j7_link", "tcp", HELD}


@pytest.mark.parametrize("size", [0.3, 0.15, 0.07])
def test_a_small_arm_has_the_pairs_of_a_large_one(tmp_path: Path, size: float) -> None:
    def pairs(size: float) -> set[str]:
        rows = [*arm(SEVEN), TOOL]
        made = [row._replace(at_m=tuple(size * each for each in row.at_m)) for row in rows]
        path = tmp_path / f"{size}.urdf"
        path.write_text(urdf(made).replace('radius="0.02"', f'radius="{0.02 * size}"'))
        found = CollisionModel(Kinematics(path, "tcp", JOINTS), near_m=1.0).pairs
        return {str(pair) for pair in found}

    assert pairs(1.0) <= pairs(size)


@pytest.mark.parametrize(("slides_m", "checked"), [(0.0015, True), (0.0005, False)])
def test_a_distance_that_a_joint_changes_by_more_than_a_millimetre_is_checked(
    tmp_path: Path, slides_m: float, checked: bool
) -> None:
    lift = Row("lift", kind="prismatic", ends=(0.0, slides_m))
    path = tmp_path / "arm.urdf"
    path.write_text(urdf([lift, *arm(SEVEN), TOOL]))
    kinematics = Kinematics(path, "tcp", ("lift", *JOINTS))
    table_z_m = lift.at_m[2] - 0.05
    pairs = CollisionModel(kinematics, near_m=NEAR_M, table_z_m=table_z_m).pairs
    assert (("lift_link", TABLE) in [pair[:2] for pair in pairs]) == checked


CORNERS = ((0, 0, 0), (100, 0, 0), (0, 20, 0), (0, 0, 20))
"""Of a mesh, in the unit of its file."""


@pytest.mark.parametrize(
    ("scale", "tip_m"),
    [("0.001 0.001 0.001", (0.1, 0.0, 0.0)), ("-0.002 0.001 0.001", (-0.2, 0.0, 0.0))],
    ids=["millimetres", "a mirror image"],
)
def test_a_mesh_is_as_large_as_its_scale_says(
    tmp_path: Path, scale: str, tip_m: tuple[float, float, float]
) -> None:
    """The hull of the first link reaches the tip of its mesh: a keep-out there is touched."""
    facets = [
        f"facet normal 0 0 1 outer loop vertex {' vertex '.join(' '.join(map(str, c)) for c in f)} "
        "endloop endfacet "
        for f in combinations(CORNERS, 3)
    ]
    (tmp_path / "link.stl").write_text(f"solid link\n{''.join(facets)}\nendsolid link\n")
    mesh, ball = f'<mesh filename="link.stl" scale="{scale}"/>', '<sphere radius="0.02"/>'
    before, _, after = urdf([*arm(SEVEN), TOOL]).partition(f'<link name="{arm(SEVEN)[0].link}">')
    path = tmp_path / "arm.urdf"
    path.write_text(f'{before}<link name="{arm(SEVEN)[0].link}">{after.replace(ball, mesh, 1)}')
    kinematics = Kinematics(path, "tcp", JOINTS)
    centre_m = np.array(arm(SEVEN)[0].at_m) + tip_m
    point = KeepOut(centre_m=tuple(centre_m.tolist()), radius_m=0.001)
    collisions = CollisionModel(kinematics, near_m=NEAR_M, keep_out={"point": point})
    distances_m = collisions.distances(np.zeros(kinematics.size))
    first = [pair.first == arm(SEVEN)[0].link for pair in collisions.pairs]
    apart = [pair.second == "point" for pair in collisions.pairs]
    assert distances_m[np.logical_and(first, apart)] == pytest.approx(-0.001, abs=0.001)


def test_a_held_box_is_where_the_gripper_holds_it(tmp_path: Path) -> None:
    """A box of 0.04 m whose middle is 0.1 m before the TCP, along its z axis."""
    path = tmp_path / "arm.urdf"
    path.write_text(urdf([*arm(SEVEN), TOOL]))
    kinematics = Kinematics(path, "tcp", JOINTS)
    tcp = kinematics.forward(np.zeros(kinematics.size))
    end_m = tcp.position_m + tcp.rotation @ [0.0, 0.0, 0.15]
    point = KeepOut(centre_m=tuple(end_m.tolist()), radius_m=0.01)
    collisions = CollisionModel(kinematics, near_m=NEAR_M, keep_out={"point": point})
    collisions.hold(HeldBox((0.04, 0.04, 0.04), (0.0, 0.0, 0.1)))
    distances_m = collisions.distances(np.zeros(kinematics.size))
    held = [(pair.first, pair.second) == (HELD, "point") for pair in collisions.pairs]
    assert distances_m[held] == pytest.approx(0.15 - 0.12 - 0.01, abs=1e-4)
