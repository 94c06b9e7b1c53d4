"""`profile new` of an MJCF: the URDF that is made of it, judged by MuJoCo's own model."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from vla_zenoh_newarm.mended import Mended
from vla_zenoh_newarm.mjcf import FromMjcf
from vla_zenoh_newarm.structure import structure

from vla_zenoh.errors import ProfileError
from vla_zenoh.kinematics.collision import collision_shapes
from vla_zenoh.kinematics.description import Description
from vla_zenoh.types import FloatArray

SEEDS = range(20)
EXACT = 1e-9
HAND = """
<geom type="sphere" size="0.03"/>
<site name="grasp_site" pos="0 0 0.1" euler="0 90 0"/>
<body name="left" pos="0 0.01 0.05" quat="0.3 0.1 -0.5 0.8">
  <joint name="left_finger" type="slide" axis="0 1 0" range="0 0.04" ref="0.01"/>
  <geom type="box" size="0.01 0.02 0.03" pos="0.01 0 0.02" euler="10 20 30"/>
</body>
<body name="right" pos="0 -0.01 0.05">
  <joint name="right_finger" type="slide" axis="0 -1 0" range="0 0.04"/>
  <geom type="box" size="0.01 0.02 0.03"/>
</body>
"""
ARM = f"""
<mujoco>
  <compiler angle="radian"/>
  <asset>
    <mesh name="wedge" vertex="0 0 0  0.1 0 0  0 0.2 0  0 0 0.3" scale="1 0.5 1"
      refpos="0.01 0 0"/>
  </asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="cube" pos="0.5 0 0.1"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>
    <body name="base" pos="0.3 -0.2 0.5" euler="0.1 0.2 0.3">
      <geom type="cylinder" size="0.05 0.1"/>
      <body name="shoulder" pos="0 0 0.2" euler="1.5707963267948966 0 0">
        <joint name="pan" axis="0 1 0" range="-2 2.5" ref="0.4"/>
        <joint name="lift" axis="1 0.2 0" pos="0.02 0.03 -0.01" range="-1 1"/>
        <geom type="capsule" fromto="0 0 0 0 0.1 0.3" size="0.04"/>
        <geom type="box" size="0.2 0.2 0.2" contype="0" conaffinity="0"/>
        <body name="elbow" pos="0 0.1 0.3" euler="0 -1.5707963267948966 0.7">
          <joint axis="0 0 1"/>
          <geom type="mesh" mesh="wedge" pos="0.02 0 0" euler="0.3 0 0"/>
          <body name="hand" pos="0.2 0 0">
            <joint name="roll" axis="1 0 0" pos="0 0.1 0" range="-3 3"/>
            {HAND}
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality>
    <joint joint1="right_finger" joint2="left_finger" polycoef="0.002 1.5 0 0 0"/>
  </equality>
  <actuator><motor joint="pan"/></actuator>
</mujoco>
"""
JOINTS = ("pan", "lift", "elbow_joint", "roll", "left_finger", "right_finger")


class Twin:
    """An MJCF in MuJoCo, and the URDF made of it in Pinocchio."""

    def __init__(self, folder: Path, text: str) -> None:
        source = folder / "arm.xml"
        source.write_text(text)
        self.made = FromMjcf(source, folder / "meshes")
        self.urdf = folder / "arm.urdf"
        self.urdf.write_text(ElementTree.tostring(self.made.robot, encoding="unicode"))
        self.described = Description(self.urdf)
        self.model = pin.buildModelFromXML(self.described.text({}))
        self.theirs = mujoco.MjModel.from_xml_path(str(source))

    def ours_in(self, positions: Mapping[str, float]) -> dict[str, FloatArray]:
        """(4, 4) pose of each link in the root."""
        configuration = pin.neutral(self.model)
        for name, position in positions.items():
            joint = self.model.joints[self.model.getJointId(name)]
            turned = [np.cos(position), np.sin(position)]
            configuration[joint.idx_q : joint.idx_q + joint.nq] = (
                turned if joint.nq == 2 else position
            )
        data = self.model.createData()
        pin.framesForwardKinematics(self.model, data, configuration)
        links = self.described.links
        ids = {link: self.model.getFrameId(link, pin.FrameType.BODY) for link in links}
        return {link: data.oMf[frame].homogeneous for link, frame in ids.items()}

    def theirs_in(self, positions: Mapping[str, float], root: str) -> dict[str, FloatArray]:
        """(4, 4) pose of each body and site in the body `root`, by MuJoCo."""
        data = mujoco.MjData(self.theirs)
        for index in range(self.theirs.njnt):
            name = self.theirs.joint(index).name or "elbow_joint"
            if name in positions:
                data.qpos[self.theirs.jnt_qposadr[index]] = positions[name]
        mujoco.mj_kinematics(self.theirs, data)
        places = {self.theirs.body(i).name: data.body(i) for i in range(1, self.theirs.nbody)}
        places |= {self.theirs.site(i).name: data.site(i) for i in range(self.theirs.nsite)}
        poses = {name: np.eye(4) for name in places}
        for name, place in places.items():
            poses[name][:3, :3] = place.xmat.reshape(3, 3)
            poses[name][:3, 3] = place.xpos
        return {name: np.linalg.inv(poses[root]) @ pose for name, pose in poses.items()}


@pytest.mark.parametrize("seed", SEEDS)
def test_links_and_sites_are_where_mujoco_has_them(tmp_path: Path, seed: int) -> None:
    twin = Twin(tmp_path, ARM)
    random = np.random.default_rng(seed)
    drawn = random.uniform(-3.0, 3.0, len(JOINTS)).tolist()
    positions: dict[str, float] = dict(zip(JOINTS, drawn, strict=True))
    ours = twin.ours_in(positions)
    theirs = twin.theirs_in(positions, "base")
    for name in ("base", "shoulder", "elbow", "hand", "left", "right", "grasp_site"):
        np.testing.assert_allclose(ours[name], theirs[name], atol=EXACT)


def test_joints_have_the_ranges_of_the_mjcf_and_one_without_is_endless(tmp_path: Path) -> None:
    joints = Twin(tmp_path, ARM).described.joints
    assert (joints["pan"].lower, joints["pan"].upper) == (-2.0, 2.5)
    assert (joints["left_finger"].lower, joints["left_finger"].upper) == (0.0, 0.04)
    assert joints["elbow_joint"].kind == "continuous"


def test_a_finger_follows_as_the_equality_says(tmp_path: Path) -> None:
    twin = Twin(tmp_path, ARM)
    follows = twin.described.follows("right_finger")
    data = mujoco.MjData(twin.theirs)
    data.joint("left_finger").qpos = 0.03
    data.joint("right_finger").qpos = follows.multiplier * 0.03 + follows.offset
    mujoco.mj_forward(twin.theirs, data)
    assert data.efc_pos[0] == pytest.approx(0.0, abs=EXACT)
    assert follows.joint == "left_finger"


def test_masses_and_inertias_are_those_of_mujoco(tmp_path: Path) -> None:
    twin = Twin(tmp_path, ARM)
    positions = dict.fromkeys(JOINTS, 0.3)
    data = mujoco.MjData(twin.theirs)
    order = [0, 1, 2, 3, 4, 5]
    for name, index in zip(JOINTS, order, strict=True):
        data.qpos[7 + index] = positions[name]
    mujoco.mj_forward(twin.theirs, data)
    theirs = np.zeros((twin.theirs.nv, twin.theirs.nv))
    mujoco.mj_fullM(twin.theirs, data, theirs)
    ours = pin.buildModelFromXML(twin.described.text({}))
    configuration = pin.neutral(ours)
    columns = []
    for name, position in positions.items():
        joint = ours.joints[ours.getJointId(name)]
        turned = [np.cos(position), np.sin(position)]
        configuration[joint.idx_q : joint.idx_q + joint.nq] = turned if joint.nq == 2 else position
        columns.append(joint.idx_v)
    found = pin.crba(ours, ours.createData(), configuration)
    found = np.triu(found) + np.triu(found, 1).T
    np.testing.assert_allclose(found[np.ix_(columns, columns)], theirs[6:, 6:], atol=EXACT)


def test_what_can_touch_has_the_extent_that_mujoco_gives_it(tmp_path: Path) -> None:
    twin = Twin(tmp_path, ARM)
    data = mujoco.MjData(twin.theirs)
    mujoco.mj_kinematics(twin.theirs, data)
    shapes = collision_shapes(twin.model, twin.urdf).geometryObjects
    links = [twin.model.frames[shape.parentFrame].name for shape in shapes]
    # A capsule is a cylinder and two balls; what is only seen is no collision shape.
    assert [links.count(name) for name in ("base", "shoulder", "elbow", "left")] == [1, 3, 1, 1]
    shape = shapes[links.index("elbow")]
    in_link = twin.model.frames[shape.parentFrame].placement.inverse() * shape.placement
    corners_m = np.array([in_link.act(corner) for corner in shape.geometry.vertices()])
    geom = twin.theirs.geom(twin.theirs.body("elbow").geomadr[0])
    turned = np.empty(9)
    mujoco.mju_quat2Mat(turned, geom.quat)
    vertices_m = twin.theirs.mesh_vert @ turned.reshape(3, 3).T + geom.pos
    for ours, theirs in (
        (corners_m.min(0), vertices_m.min(0)),
        (corners_m.max(0), vertices_m.max(0)),
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_what_a_urdf_has_no_place_for_is_named(tmp_path: Path) -> None:
    changes = " ".join(Twin(tmp_path, ARM).made.changes)
    assert "left out, as they stand or lie beside the arm: cube" in changes
    assert "left out, a URDF has none: 1 actuator" in changes


def test_the_arm_of_an_mjcf_is_found_by_its_site(tmp_path: Path) -> None:
    source = tmp_path / "arm.xml"
    source.write_text(ARM)
    mended = Mended(source, {}, tmp_path / "meshes")
    found = structure(mended.described(), None, None)
    assert found.arm == ("pan", "lift", "elbow_joint", "roll")
    assert (found.base, found.tcp, found.fingers) == ("base", "grasp_site", ("left_finger",))


HINGE = '<joint name="j" axis="0 0 1"/>'
BODY = '<mujoco><worldbody><body name="b">{}<geom size="0.1"/></body></worldbody>{}</mujoco>'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (BODY.format('<joint name="j" type="ball"/>', ""), "has ball joint 'j'"),
        (BODY.format("", ""), "has no joint that moves"),
        (BODY.format("<freejoint/>", ""), "has no joint that moves"),
        (BODY.format("<hinge/>", ""), "MuJoCo cannot compile arm.xml: .*hinge"),
    ],
)
def test_an_mjcf_that_is_no_arm_is_refused_by_name(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ProfileError, match=says):
        Twin(tmp_path, text)


def test_a_closed_chain_is_opened_by_name(tmp_path: Path) -> None:
    loop = '<equality><connect name="loop" body1="b" anchor="0 0 0"/></equality>'
    made = Twin(tmp_path, BODY.format(HINGE, loop)).made
    assert "equality loop: left out" in " ".join(made.changes)


def test_a_curve_between_joints_is_left_out_by_name(tmp_path: Path) -> None:
    two = HINGE + HINGE.replace('"j"', '"k"')
    curve = '<equality><joint name="bent" joint1="j" joint2="k" polycoef="0 1 2 0 0"/></equality>'
    twin = Twin(tmp_path, BODY.format(two, curve))
    assert "equality bent: left out" in " ".join(twin.made.changes)
    assert twin.described.joints["j"].mimic is None
