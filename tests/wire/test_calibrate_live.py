"""Views of a calibration are taken off the bus while an arm goes from place to place."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from calibrate_rig import BOARD
from camera_rig import await_match, free_endpoint
from chain import LONG_PATIENCE_S, running_chain
from typer.testing import CliRunner
from vla_zenoh_calibrate.arm import Arm
from vla_zenoh_calibrate.errors import CalibrationError
from vla_zenoh_calibrate.sampling import Sampler
from vla_zenoh_calibrate.streams import Live

from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.keys import PRIMITIVES, worker_node
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.program.main import app
from vla_zenoh.types import Header, JointState

WIDTH, HEIGHT = 640, 480
HOSTS = "hosts: {here: {nodes: [router, sim, camera, command, worker, primitives]}}\n"
STANDS_S = 1.1
LENS = {"fx_px": 500.0, "fy_px": 501.0, "cx_px": 320.0, "cy_px": 240.0}


@pytest.fixture
def profile() -> Iterator[Profile]:
    endpoint = free_endpoint()
    where = {"listen": [endpoint], "connect": [endpoint]}
    made = override(load_profile("panda_sim"), {"session": where})
    with open_session(made.session, mode="router"):
        yield made


def picture() -> bytes:
    drawn = BOARD.image(40, 0.5)
    image = np.full((HEIGHT, WIDTH), 128, np.uint8)
    image[40 : 40 + drawn.shape[0], 60 : 60 + drawn.shape[1]] = drawn
    return np.repeat(image[..., None], 3, axis=2).tobytes()


def test_a_view_is_taken_wherever_the_arm_stands(profile: Profile) -> None:
    keys, home = profile.keys, np.array(profile.robot.home_rad)
    over, told = threading.Event(), list[str]()
    with open_session(profile.session) as here, open_session(profile.session) as there:
        client = Client(profile, here).subscribe()
        sampler, arm = Sampler(BOARD, with_arm=True), Arm(profile, "joint")
        live = Live(client, sampler, "wrist", arm, told.append)
        await_match(there, keys.camera_raw("wrist"))
        await_match(there, keys.state_joint)
        node, shown = Node("camera", profile, there), picture()
        detail = {"cameras": {"wrist": {"intrinsics": LENS}}}
        node.publish_status("running", detail=detail, now=True)

        def publish() -> None:
            began_s, seq = time.monotonic(), 0
            while not over.wait(0.02):
                seq += 1
                at = int((time.monotonic() - began_s) / STANDS_S)
                joints = home + 0.1 * at * np.eye(7)[6 - at % 2]
                state = JointState(profile.robot.arm_joints, joints, np.zeros(7), None)
                header = records.encode_header(Header(time.time_ns(), seq, "sim#1"))
                there.put(keys.state_joint, records.encode(state), attachment=header)
                if seq % 5 == 0:
                    there.put(
                        keys.camera_raw("wrist"),
                        shown,
                        encoding=f"zenoh/bytes;rgb8;{HEIGHT}x{WIDTH}",
                        attachment=records.encode_header(Header(time.time_ns(), seq, "camera#1")),
                    )

        publisher = threading.Thread(target=publish)
        publisher.start()
        try:
            give_up_s = time.monotonic() + 40
            while len(sampler.taken) < 3 and time.monotonic() < give_up_s:
                live.pump(0.2)
        finally:
            over.set()
            publisher.join()
            node.close()
        assert len(sampler.taken) >= 3
        assert dict(live.lens) == LENS
        poses = [view.arm for view in sampler.views if view.arm is not None]
        assert len({tuple(pose.round(3).ravel()) for pose in poses}) == len(poses)
        assert any(line.startswith("view 3") for line in told)


def test_a_camera_that_is_silent_is_named(
    profile: Profile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vla_zenoh_calibrate.streams.SILENT_S", 0.3)
    with open_session(profile.session) as here:
        client = Client(profile, here).subscribe()
        live = Live(client, Sampler(BOARD, with_arm=False), "front", None, print)
        with pytest.raises(CalibrationError, match=r"camera/front/raw for 0\.3 s"):
            live.pump(2.0)


@pytest.mark.long
def test_a_tour_moves_the_arm_only_when_a_person_says_yes(tmp_path: Path) -> None:
    with running_chain(tmp_path, more=HOSTS, patience_s=LONG_PATIENCE_S) as chain:
        chain.until("it answers", lambda: worker_node(PRIMITIVES) in chain.client.alive, 40)
        chain.settle()
        began = chain.measured().position_m
        words = ["camera", "calibrate", "front", "-p", str(chain.profile_file), "--eye", "in-hand"]
        words += ["--tour", "--views", "6", "-o", str(tmp_path / "out")]
        declined = CliRunner().invoke(app, words, input="n\n")
        assert declined.exit_code == 1
        assert "move it to 6 poses" in declined.output
        assert np.linalg.norm(chain.measured().position_m - began) < 2e-3
        agreed = CliRunner().invoke(app, words, input="y\n")
        # There is no board in this scene, so that the tour ends without a view.
        assert "no view was taken" in str(agreed.exception) + agreed.output
        assert np.linalg.norm(chain.measured().position_m - began) > 0.01
        assert not chain.moves()
