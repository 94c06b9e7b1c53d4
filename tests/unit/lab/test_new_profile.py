"""`profile new`: what is found in a description, what is mended and guessed, who answers."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest
from described_arms import SEVEN, SIX, TOOL, Row, X, Y, arm, finger, urdf
from typer.testing import CliRunner
from vla_zenoh_newarm.answers import Answers
from vla_zenoh_newarm.arm import Arm, JointMotion
from vla_zenoh_newarm.gripper import Gripper, gripper
from vla_zenoh_newarm.mended import Mended
from vla_zenoh_newarm.picture import outline, picture
from vla_zenoh_newarm.posture import INNER, Posture, posture
from vla_zenoh_newarm.structure import structure

from vla_zenoh.errors import ProfileError
from vla_zenoh.kinematics.collision import CollisionModel
from vla_zenoh.kinematics.description import Description
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.profile import ReachLimits
from vla_zenoh.program.main import app

SHIPPED = Path(__file__).parents[3] / "profiles"
JOINTS_6 = tuple(f"j{n}" for n in range(1, 7))
OPTIONS = ("base", "tcp", "home", "workspace", "table", "acceleration", "jerk", "gripper")


class Found(NamedTuple):
    """A description, and what is found in it.

    Args:
        rows: its joints.
        arm: joints that are commanded.
        tcp: link that is controlled.
        base: link of the poses.
        fingers: joints of the hand.
        values: of its gripper.
    """

    rows: list[Row]
    arm: tuple[str, ...] = JOINTS_6
    tcp: str = "tcp"
    base: str = "base"
    fingers: tuple[str, ...] = ()
    values: Mapping[str, float] = {}


LEFT, RIGHT = finger("left", 0.0, 0.04), finger("right", 0.0, 0.04)
MIRRORED = finger("right", -0.04, 0.0, mimic=("left", -1.0, 0.0))
JAW = Row("jaw", axis=X, parent="j6_link", ends=(-0.2, 1.2), at_m=(0.0, 0.0, 0.02))
TIP = Row("jaw_tip", parent="jaw_link", kind="fixed", at_m=(0.0, 0.08, 0.0))
FOUND: dict[str, Found] = {
    "six joints and a tool": Found([*arm(SIX), TOOL]),
    "no link for the TCP": Found(arm(SIX), tcp="j6_link"),
    "a head beside the arm": Found([*arm(SIX), TOOL, Row("neck", parent="base"), Row("nod")]),
    "a torso under seven joints": Found(
        [Row("lift", kind="prismatic", ends=(0.0, 0.3)), *arm(SEVEN), TOOL],
        arm=tuple(f"j{n}" for n in range(1, 8)),
        base="lift_link",
    ),
    "wheels": Found([*arm(SIX), TOOL, Row("wheel", parent="base", kind="continuous", limit="")]),
    "fingers that slide": Found(
        [*arm(SIX), TOOL, LEFT, RIGHT],
        fingers=("left", "right"),
        values={"max_width_m": 0.08},
    ),
    "a finger that follows": Found(
        [*arm(SIX), TOOL, LEFT, MIRRORED],
        fingers=("left", "right"),
        values={"max_width_m": 0.08},
    ),
    "a jaw that turns": Found(
        [*arm(SIX), TOOL, JAW, TIP],
        fingers=("jaw",),
        values={"max_width_m": 0.112, "joint_open_rad": 1.2, "joint_shut_rad": -0.2},
    ),
}


@pytest.mark.parametrize("name", FOUND)
def test_arm_hand_and_tcp_are_found(tmp_path: Path, name: str) -> None:
    case = FOUND[name]
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(case.rows))
    found = structure(Description(path), None, None)
    assert (found.arm, found.tcp, found.base) == (case.arm, case.tcp, case.base)
    hand = gripper(Description(path), found.fingers)
    assert hand.joints == case.fingers
    assert dict(hand.values) == pytest.approx(dict(case.values), abs=2e-3)


def test_of_two_arms_one_is_taken_and_the_other_named(tmp_path: Path) -> None:
    path = tmp_path / "arms.urdf"
    other = [row._replace(name=f"o{row.name}", parent="") for row in arm(SIX)]
    other[0] = other[0]._replace(parent="base", at_m=(0.0, 0.5, 0.2))
    path.write_text(urdf([*arm(SIX), TOOL, *other]))
    found = structure(Description(path), None, None)
    assert (found.tcp, found.other_tcps) == ("tcp", ("oj6_link",))
    assert structure(Description(path), None, "oj6_link").arm == tuple(
        f"oj{n}" for n in range(1, 7)
    )


def test_a_hand_of_many_joints_is_left_still_by_name(tmp_path: Path) -> None:
    path = tmp_path / "hand.urdf"
    many = [Row(f"finger{n}", axis=X, parent="j6_link") for n in range(4)]
    path.write_text(urdf([*arm(SIX), TOOL, *many]))
    found = structure(Description(path), None, None)
    hand = gripper(Description(path), found.fingers)
    assert hand.joints == ()
    assert "finger0, finger1, finger2, finger3" in hand.why


@pytest.mark.parametrize("joints_each", [2, 7])
def test_three_branches_of_a_hand_are_no_arm_however_many_joints_they_have(
    tmp_path: Path, joints_each: int
) -> None:
    path = tmp_path / "hand.urdf"
    branches = [
        Row(f"{name}{n}", axis=X, parent="" if n else "j6_link", at_m=(0.0, 0.0, 0.02))
        for name in ("index", "middle", "ring")
        for n in range(joints_each)
    ]
    path.write_text(urdf([*arm(SIX), TOOL, *branches]))
    found = structure(Description(path), None, None)
    assert (found.arm, found.tcp) == (JOINTS_6, "tcp")
    assert len(found.fingers) == 3 * joints_each


# -- what is mended -------------------------------------------------------------------------------
MESH = '<mesh filename="package://away/link.stl"/>'
BALL = '<sphere radius="0.02"/>'


def mended(folder: Path, text: str) -> tuple[Description, Mended]:
    """The description that is saved for this one, and how it was mended."""
    source = folder / "arm.urdf"
    source.write_text(text)
    made = Mended(source, {}, folder)
    made.described()
    made.complete(JOINTS_6, FINGERS)
    return Description(made.save(folder / "copy.urdf")), made


def test_what_lacks_nothing_is_used_as_it_is(tmp_path: Path) -> None:
    found, made = mended(tmp_path, urdf([*arm(SIX), TOOL]))
    assert found.path.name == "arm.urdf"
    assert (made.changes, made.guesses) == ([], [])
    assert not (tmp_path / "copy.urdf").exists()


TURNS = '<limit effort="5" velocity="2"/>'
FINGERS = ("thumb",)


def test_an_endless_joint_of_the_arm_stays_endless(tmp_path: Path) -> None:
    endless = Row("j6", kind="continuous", limit=TURNS)
    wheel = Row("wheel", parent="base", kind="continuous", limit="")
    found, made = mended(tmp_path, urdf([*arm(SIX, j6=endless), TOOL, wheel]))
    assert found.path.name == "arm.urdf", "nothing had to be mended"
    assert (found.joints["j6"].lower, found.joints["j6"].upper) == (-np.inf, np.inf)
    assert (made.changes, made.guesses) == ([], [])


def test_an_endless_joint_of_a_finger_gets_ends(tmp_path: Path) -> None:
    thumb = Row("thumb", kind="continuous", limit=TURNS)
    found, made = mended(tmp_path, urdf([*arm(SIX), TOOL, thumb]))
    ends = found.joints["thumb"].lower, found.joints["thumb"].upper
    assert ends == pytest.approx((-3.1416, 3.1416))
    assert "thumb: endless" in made.changes[0]


def test_an_endless_joint_without_a_velocity_gets_one_as_a_guess(tmp_path: Path) -> None:
    endless = Row("j6", kind="continuous", limit="")
    found, made = mended(tmp_path, urdf([*arm(SIX, j6=endless), TOOL]))
    assert found.joints["j6"].velocity == 1.0
    assert found.joints["j6"].kind == "continuous"
    assert "velocity of j6: 1 rad/s" in made.guesses[0]


@pytest.mark.parametrize("limit", ["", '<limit lower="-2" upper="2" effort="0" velocity="0"/>'])
def test_a_joint_without_a_velocity_gets_one_as_a_guess(tmp_path: Path, limit: str) -> None:
    found, made = mended(tmp_path, urdf([*arm(SIX, j2=Row("j2", axis=Y, limit=limit)), TOOL]))
    assert found.joints["j2"].velocity == 1.0
    assert "velocity of j2: 1 rad/s" in made.guesses[0]


def test_prefixes_without_a_namespace_are_left_out_and_said(tmp_path: Path) -> None:
    text = urdf([*arm(SIX), TOOL]).replace("<limit ", '<limit drake:acceleration="2.5" ')
    text = text.replace("</robot>", "<drake:group><drake:member/></drake:group></robot>")
    found, made = mended(tmp_path, text)
    assert [*found.joints] == [*JOINTS_6, "tool"]
    (change,) = made.changes
    assert change.startswith("what begins with drake:... is left out")
    assert made.guesses == []


def test_a_link_whose_mesh_is_not_there_gets_a_plain_shape_as_a_guess(tmp_path: Path) -> None:
    text = urdf([*arm(SIX), TOOL]).replace(BALL, MESH, 3)
    found, made = mended(tmp_path, text)
    assert "shapes of base, j1_link, j2_link" in made.guesses[0]
    assert "away" not in found.path.read_text()


def test_a_link_whose_mesh_cannot_be_read_gets_a_plain_shape_too(tmp_path: Path) -> None:
    (tmp_path / "link.stl").write_bytes(b"solid")
    text = urdf([*arm(SIX), TOOL]).replace(BALL, '<mesh filename="link.stl"/>', 1)
    _, made = mended(tmp_path, text)
    assert "shapes of base" in made.guesses[0]


def test_a_description_without_any_shapes_gets_some(tmp_path: Path) -> None:
    found, made = mended(tmp_path, urdf([*arm(SIX), TOOL], shapes=False))
    assert "shapes of j1_link" in made.guesses[0]
    assert found.path.read_text().count("<collision>") >= len(JOINTS_6) - 1


def meshed(folder: Path) -> str:
    """A description that lacks a velocity, one of whose shapes is a mesh below `folder`."""
    package = folder / "away"
    package.mkdir()
    corners = ("0 0 0", "1 0 0", "0 1 0", "0 0 1")
    facets = [
        f"facet normal 0 0 1\nouter loop\n{''.join(f'vertex {c}{chr(10)}' for c in each)}endloop\n"
        "endfacet\n"
        for each in combinations(corners, 3)
    ]
    (package / "link.stl").write_text(f"solid link\n{''.join(facets)}endsolid link\n")
    endless = Row("j6", kind="continuous", limit="")
    return urdf([*arm(SIX, j6=endless), TOOL]).replace(BALL, MESH, 1)


def test_a_mesh_is_found_wherever_the_copy_is(tmp_path: Path) -> None:
    source, copy = tmp_path / "arm.urdf", tmp_path / "elsewhere" / "copy.urdf"
    source.write_text(meshed(tmp_path))
    made = Mended(source, {}, tmp_path)
    made.complete(JOINTS_6, FINGERS)
    copy.parent.mkdir()
    made.save(copy)
    assert str(tmp_path / "away" / "link.stl") in copy.read_text()


def test_a_copy_moves_together_with_its_meshes(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    found, _ = mended(here, meshed(here))
    here.rename(there)
    kinematics = Kinematics(there / found.path.name, "tcp", JOINTS_6)
    assert "base" in [
        shape.name for shape in CollisionModel(kinematics, near_m=0.0).links().geometryObjects
    ]


def test_a_xacro_is_expanded(tmp_path: Path) -> None:
    source = tmp_path / "arm.urdf.xacro"
    space = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
    argument = '<xacro:arg name="high" default="0.1"/>'
    text = urdf([*arm(SIX), TOOL]).replace('name="made">', f'name="made" {space}>{argument}', 1)
    source.write_text(text.replace('xyz="0.0 0.0 0.1"', 'xyz="0 0 $(arg high)"'))
    made = Mended(source, {"high": "0.3"}, tmp_path)
    assert made.described().joints["tool"].offset_m == (0.0, 0.0, 0.3)
    assert "expanded" in made.changes[0]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("<mujoco/>", "has no joint that moves"),
        ("robot", "is no XML"),
        ('<robot name="a"><link name="a"/></robot>', "has no joint that moves"),
        (
            '<robot name="a"><link name="a"/><joint name="j" type="fixed"><parent link="a"/>'
            '<child link="${b}"/></joint></robot>',
            "is a xacro and cannot be expanded",
        ),
    ],
)
def test_what_is_no_arm_is_refused_by_name(tmp_path: Path, text: str, says: str) -> None:
    source = tmp_path / "arm.urdf"
    source.write_text(text)
    with pytest.raises(ProfileError, match=says.replace("(", r"\(")):
        structure(Mended(source, {}, tmp_path).described(), None, None)


# -- who answers ----------------------------------------------------------------------------------
def answers(**given: str) -> Answers:
    return Answers({name: given.get(name) for name in OPTIONS}, ask=False)


def test_what_is_answered_is_no_guess_and_the_rest_is() -> None:
    person = answers(jerk="60,61")
    assert person.numbers("jerk", (1.0,), "limits.joint.jerk_rad_s3", "", (1, 2)) == (60.0, 61.0)
    assert person.numbers("home", (1.0, 0.5), "robot.home_rad", "", (2,)) == (1.0, 0.5)
    assert [guess.place for guess in person.guesses] == ["robot.home_rad"]


@pytest.mark.parametrize("text", ["60,61,62", "fast", "", "none"])
def test_an_answer_that_does_not_fit_is_refused_by_its_option(text: str) -> None:
    with pytest.raises(ProfileError, match=r"--jerk .*give 1 or 2 number"):
        answers(jerk=text).numbers("jerk", (1.0,), "limits.joint.jerk_rad_s3", "", (1, 2))


def test_enter_keeps_a_guess_unconfirmed_and_another_answer_confirms(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said = iter(["1", "2"])
    monkeypatch.setattr("typer.prompt", lambda *_, **__: next(said))
    person = Answers(dict.fromkeys(OPTIONS), ask=True)
    assert person.numbers("table", (1.0,), "limits.reach.table_z_m", "", (1,)) == (1.0,)
    assert person.numbers("jerk", (1.0,), "limits.joint.jerk_rad_s3", "", (1,)) == (2.0,)
    assert [guess.place for guess in person.guesses] == ["limits.reach.table_z_m"]


# -- the picture ----------------------------------------------------------------------------------
def test_a_home_with_the_tool_down_is_away_from_the_ends_of_every_joint(tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    stiff = Row("j4", axis=Y, ends=(-1.0, 1.0))
    file.write_text(urdf([*arm("zyyyz", j4=stiff), TOOL]))
    kinematics = Kinematics(file, "tcp", JOINTS_6[:5])
    home_rad = np.array(posture(kinematics, ReachLimits(table_z_m=0.0), ()).home_rad)
    middle = (kinematics.lower_rad + kinematics.upper_rad) / 2
    assert (np.abs(home_rad - middle) < INNER * (kinematics.upper_rad - middle)).all()


def test_the_outline_of_points_leaves_out_those_inside() -> None:
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    inside = np.random.default_rng(2).uniform(0.01, 0.99, (50, 2))
    np.testing.assert_array_equal(outline(np.concatenate([inside, square, square])), square)


def test_the_picture_shows_every_joint_and_the_tcp_where_kinematics_has_it(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(urdf([*arm(SIX), TOOL]))
    links, home = structure(Description(path), None, None), (0.3, 0.5, -0.4, 0.2, 0.6, 0.1)
    box = ((-0.5, 0.5), (-0.4, 0.4), (0.1, 0.9))
    still = JointMotion((), (), ())
    drawn = Arm(path, links, Gripper(), Posture(home, box, 0.6, True), still, 0.0, {}, [], [])
    root = ElementTree.fromstring(picture("a <b>", drawn))
    panels = [each for each in root if each.tag.endswith("}g")]
    tcp = Kinematics(path, "tcp", JOINTS_6, base_frame="base").forward(np.array(home)).position_m
    for panel, (right, up) in zip(panels, ((0, 2), (0, 1), (1, 2)), strict=True):
        joints = [each for each in panel.iter() if each.tag.endswith("}circle")]
        assert len(joints) == len(JOINTS_6)
        named = {each.text: each for each in panel.iter() if each.tag.endswith("}text")}
        px = {
            name: np.array([float(named[name].attrib[axis]) for axis in "xy"])
            for name in ("base", "TCP")
        }
        workspace = panel.findall("{*}polygon")[-1].attrib["points"].split()
        corners_px = np.array([point.split(",") for point in workspace], float)
        px_m = np.ptp(corners_px[:, 0]) / np.ptp(box[right])
        apart_m = (px["TCP"] - px["base"]) / (px_m, -px_m)
        np.testing.assert_allclose(apart_m, tcp[[right, up]], atol=1e-3)


def test_a_picture_that_exists_is_kept_and_no_profile_is_written(tmp_path: Path) -> None:
    old, profile = tmp_path / "arm.svg", tmp_path / "arm.yaml"
    old.write_text("mine")
    words = ["profile", "new", str(SHIPPED / "ur5e.urdf"), "-o", str(profile), "--yes"]
    done = CliRunner().invoke(app, [*words, "--picture", str(old)])
    assert done.exit_code == 1
    assert "arm.svg exists" in str(done.exception or done.stderr)
    assert (old.read_text(), list(tmp_path.iterdir())) == ("mine", [old])


def test_an_arm_that_cannot_be_mended_is_named_by_the_file_that_was_given(tmp_path: Path) -> None:
    source, profile = tmp_path / "stuck.urdf", tmp_path / "arm.yaml"
    stuck = Row("j2", axis=Y, ends=(0.0, 0.0), limit='<limit lower="0" upper="0" effort="1"/>')
    source.write_text(urdf([*arm(SIX, j2=stuck), TOOL]))
    done = CliRunner().invoke(app, ["profile", "new", str(source), "-o", str(profile), "--yes"])
    assert done.exit_code == 1
    said = str(done.exception or done.stderr)
    assert "stuck.urdf" in said
    assert "mended" not in said
    assert list(tmp_path.iterdir()) == [source]
