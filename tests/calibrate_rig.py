"""A simulated Panda with a ChArUco board on the table or in its hand, for tests of calibrations.

``PYTHONPATH=tests python tests/calibrate_rig.py FILE.jpg`` makes the picture of the how-to page.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import mujoco
import numpy as np
from vla_zenoh_calibrate.board import Board
from vla_zenoh_calibrate.hand_eye import EYES, Eye, calibrate_hand_eye
from vla_zenoh_calibrate.lens import calibrate_lens
from vla_zenoh_calibrate.picture import arm_frames, with_frames
from vla_zenoh_calibrate.sampling import Sampler
from vla_zenoh_calibrate.tour import tour
from vla_zenoh_calibrate.view import inverse, placed

from vla_zenoh.kinematics.kinematics import InverseKinematics, make_kinematics
from vla_zenoh.kinematics.so3 import Pose, exp3, log3
from vla_zenoh.nodes.camera.geometry import Intrinsics
from vla_zenoh.profile import load_profile
from vla_zenoh.simulation.backend import EGL, Backend
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import robot_models
from vla_zenoh.types import FloatArray

WIDTH, HEIGHT = 640, 480
BOARD = Board()
MARGIN = 0.5
JOINT_NOISE_RAD = 1e-4
STATE_HZ, IMAGE_EVERY_S = 20, 2.0
AHEAD_M = 0.3
SCENE = """
<mujoco>
  <asset>
    <texture name="paper" type="2d" file="board.png"/>
    <material name="paper" texture="paper" texuniform="false" specular="0" shininess="0"/>
  </asset>
  <visual>
    <headlight ambient="0.6 0.6 0.6" diffuse="0.3 0.3 0.3"/>
    <quality offsamples="8"/>
    <map znear="0.01" zfar="50"/>
  </visual>
  <worldbody>
    <geom type="plane" size="2 2 0.1" rgba="0.55 0.5 0.45 1" pos="0 0 -0.02"/>
    <body name="board" mocap="true">
      <geom type="plane" size="{width} {height} 0.1" material="paper" contype="0" conaffinity="0"/>
    </body>
    <camera name="front" pos="1.05 0.2 0.54" xyaxes="-0.2 0.6 0 -0.048 -0.016 0.4" fovy="45"/>
  </worldbody>
</mujoco>
"""
# From the plane's frame, in its middle with y up and z towards who reads it, to the board's.
CORNER = placed(
    np.diag([1.0, -1.0, -1.0]), np.array([-BOARD.size_m[0] / 2, BOARD.size_m[1] / 2, 0.0])
)


class Rig:
    """Renders what a camera sees at poses of the arm.

    Args:
        folder: for the scene.
        eye: ``in-hand``: camera wrist, board on the table; else camera front, board in the hand.
    """

    def __init__(self, folder: Path, eye: Eye) -> None:
        self.eye: Eye = eye
        cv2.imwrite(str(folder / "board.png"), BOARD.image(60, MARGIN))
        sides = [(side + 2 * MARGIN * BOARD.square_m) / 2 for side in BOARD.size_m]
        (folder / "scene.xml").write_text(SCENE.format(width=sides[0], height=sides[1]))
        profile = load_profile("panda_sim")
        self.kinematics = make_kinematics(profile)
        models = robot_models(profile)
        self.renderer = Renderer(str(folder / "scene.xml"), models, Backend(EGL))
        self.camera = "wrist" if eye == "in-hand" else "front"
        model = self.renderer._model
        self._data, self._model = mujoco.MjData(model), model
        ordered = self.kinematics.ordered
        self.home = ordered(profile.robot.arm_joints, profile.robot.home_rad)
        if eye == "in-hand":
            above = placed(self._tcp(self.home)[:3, :3], np.array([0.45, 0.0, 0.3]))
            turn = exp3(np.array([0.0, 0.0, 0.2]))
            self.board = placed(turn, np.array([0.34, 0.02, 0.0])) @ CORNER
        else:
            # The tool points forwards, at the camera, and the board is flat on it.
            forwards = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
            above = placed(forwards, np.array([0.45, 0.0, 0.46]))
            flat = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
            self.board = placed(flat, np.array([0.0, 0.0, 0.02])) @ CORNER
        self.home = self._solved(self.home, above)
        self.start = self._tcp(self.home)

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        self.renderer.close()

    def _tcp(self, joints: FloatArray) -> FloatArray:
        pose = self.kinematics.forward(joints)
        return placed(pose.rotation, pose.position_m)

    def _solved(self, near: FloatArray, pose: FloatArray) -> FloatArray:
        goal = Pose(np.asarray(pose[:3, 3]), pose[:3, :3])
        return (
            InverseKinematics(self.kinematics, near, max_iterations=400)
            .approach(goal, near)
            .joints_rad
        )

    def camera_pose(self, joints: FloatArray) -> FloatArray:
        """True pose of the optical frame in the world, which is the base."""
        self._show(joints)
        seen = self._data.camera(self.camera)
        return placed(seen.xmat.reshape(3, 3) @ np.diag([1.0, -1.0, -1.0]), np.array(seen.xpos))

    @property
    def truth(self) -> FloatArray:
        """X of `hand_eye`."""
        seen = self.camera_pose(self.home)
        return inverse(self._tcp(self.home)) @ seen if self.eye == "in-hand" else seen

    @property
    def lens(self) -> Intrinsics:
        focal = self.renderer.focal_px(self.camera, HEIGHT)
        return Intrinsics(
            width=WIDTH, height=HEIGHT, fx_px=focal, fy_px=focal, cx_px=WIDTH / 2, cy_px=HEIGHT / 2
        )

    def image(self, joints: FloatArray) -> np.ndarray:
        """What the camera sees."""
        self._show(joints)
        state = mujoco.mjtState.mjSTATE_QPOS.value | mujoco.mjtState.mjSTATE_MOCAP_POS.value
        state |= mujoco.mjtState.mjSTATE_MOCAP_QUAT.value
        vector = np.empty(mujoco.mj_stateSize(self._model, state))
        mujoco.mj_getState(self._model, self._data, vector, state)
        self.renderer.set_qpos(vector)
        return self.renderer.render(self.camera, WIDTH, HEIGHT)

    def _show(self, joints: FloatArray) -> None:
        for name, position in zip(self.kinematics.arm_joints, joints, strict=True):
            self._data.joint(f"robot/{name}").qpos[0] = position
        board = self.board if self.eye == "in-hand" else self._tcp(joints) @ self.board
        plane = board @ inverse(CORNER)
        self._data.mocap_pos[0] = plane[:3, 3]
        mujoco.mju_mat2Quat(self._data.mocap_quat[0], plane[:3, :3].ravel())
        mujoco.mj_forward(self._model, self._data)

    def poses(self, count: int) -> Iterator[FloatArray]:
        """Joints of a tour, those that the arm can reach."""
        near = self.home
        for pose in tour(self.start, self.eye, AHEAD_M, count):
            goal = Pose(pose[:3, 3], pose[:3, :3])
            found = InverseKinematics(self.kinematics, self.home, max_iterations=400).approach(
                goal, near
            )
            if found.solved:
                near = found.joints_rad
                yield near

    def fill(self, sampler: Sampler, count: int, seed: int = 0) -> None:
        """Show images and noisy states of a tour to a sampler."""
        random = np.random.default_rng(seed)
        for number, joints in enumerate(self.poses(count)):
            stamp_ns = int((1 + number * IMAGE_EVERY_S) * 1e9)
            for shift in np.arange(-0.5, 0.51, 1 / STATE_HZ):
                noisy = joints + random.normal(0, JOINT_NOISE_RAD, len(joints))
                at_ns = stamp_ns + int(shift * 1e9)
                sampler.add_state(at_ns, self._tcp(noisy), at_ns)
            image = self.image(joints)
            noise = random.normal(0, 2.0, image.shape)
            sampler.add_image(stamp_ns, (image + noise).clip(0, 255).astype(np.uint8), stamp_ns)
            sampler.settle()


def main() -> None:
    """Write the picture of docs/how-to/calibrate-a-camera.md, and print the errors it tells."""
    sides = []
    for eye in EYES:
        with TemporaryDirectory() as folder, Rig(Path(folder), eye) as rig:
            sampler = Sampler(BOARD, with_arm=True)
            rig.fill(sampler, 30 if eye == "in-hand" else 45)
            truth, known = rig.truth, rig.lens
        lens = calibrate_lens(BOARD, sampler.views, (WIDTH, HEIGHT))
        place = calibrate_hand_eye(
            BOARD, sampler.views, lens.intrinsics, eye, information=lens.information
        )
        exact = calibrate_hand_eye(BOARD, sampler.views, known, eye)
        for name, found in (("lens calibrated", place), ("lens known", exact)):
            apart = inverse(truth) @ found.camera
            off_m, off_rad = np.linalg.norm(apart[:3, 3]), np.linalg.norm(log3(apart[:3, :3]))
            print(f"{eye}, {name}: {off_m * 1e3:.2f} mm, {off_rad * 1e3:.2f} mrad")
        best = max(sampler.taken, key=lambda one: (len(one.view.ids), np.ptp(one.view.pixels)))
        assert best.view.arm is not None
        frames = arm_frames(place, best.view.arm)
        sides.append(with_frames(best.image, place.lens, frames))
    drawn = cv2.cvtColor(np.hstack(sides), cv2.COLOR_RGB2BGR)
    cv2.imwrite(sys.argv[1], cv2.resize(drawn, None, fx=0.8, fy=0.8, interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    main()
