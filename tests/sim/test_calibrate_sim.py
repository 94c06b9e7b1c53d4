"""A camera of the simulated Panda is calibrated from rendered images, with noise in both senses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calibrate_rig import BOARD, HEIGHT, WIDTH, Rig
from vla_zenoh_calibrate.hand_eye import EYES, Eye, calibrate_hand_eye
from vla_zenoh_calibrate.lens import calibrate_lens
from vla_zenoh_calibrate.sampling import Sampler
from vla_zenoh_calibrate.view import inverse

from vla_zenoh.kinematics.so3 import angle_between
from vla_zenoh.simulation.backend import why_no_opengl

pytestmark = [pytest.mark.gl, pytest.mark.long]
POSES = {"in-hand": 30, "to-hand": 45}


@pytest.mark.parametrize("eye", EYES)
def test_lens_and_place_are_found_within_a_millimetre_and_two_milliradians(
    eye: Eye, tmp_path: Path
) -> None:
    if reason := why_no_opengl():
        pytest.skip(reason)
    with Rig(tmp_path, eye) as rig:
        sampler = Sampler(BOARD, with_arm=True)
        rig.fill(sampler, POSES[eye])
        lens = calibrate_lens(BOARD, sampler.views, (WIDTH, HEIGHT))
        found = calibrate_hand_eye(
            BOARD, sampler.views, lens.intrinsics, eye, information=lens.information
        )
        apart = inverse(rig.truth) @ found.camera
        true_px = rig.lens.fx_px
    assert np.linalg.norm(apart[:3, 3]) < 1e-3
    assert angle_between(apart[:3, :3], np.eye(3)) < 2e-3
    assert found.lens.fx_px == pytest.approx(true_px, rel=3e-3)
    assert found.rms_px < 0.3
    assert found.square_m == pytest.approx(BOARD.square_m, rel=5e-3)
