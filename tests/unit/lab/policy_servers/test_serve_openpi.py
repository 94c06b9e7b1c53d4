"""Our models for openpi's clients: the command as a process, asked over real WebSockets."""

from __future__ import annotations

import http.client
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from camera_rig import until
from model_wires import openpi
from peer_rig import OPENPI_CLIENT, free_port, python_with
from vla_zenoh_serve.served_policy import make_served_policy
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import Observation, Policy
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile

START_S, WAIT_S = 30.0, 10.0
STEP_M, ATOL_M = 0.01, 1e-6
KEY = "a key"
WITH_OPENPI = """\
import json, sys
import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from openpi_client.action_chunk_broker import ActionChunkBroker
client = WebsocketClientPolicy("127.0.0.1", int(sys.argv[1]))
asked = {
    "observation/front": np.zeros((480, 640, 3), np.uint8),
    "observation/pose": np.array([0.4, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0]),
    "observation/gripper": np.array([0.05]),
    "prompt": "HARD: go up",
}
broker = ActionChunkBroker(client, 1)
steps = [broker.infer(asked)["actions"].tolist() for _ in range(2)]
try:
    client.infer({"prompt": "HARD: go up"})
    said = ""
except RuntimeError as error:
    said = str(error)
print(json.dumps([client.get_server_metadata()["action_dim"], steps, said]))
"""


@contextmanager
def serving(*more: str) -> Iterator[int]:
    """The command, until the block ends; gives its port."""
    port = free_port()
    command = [sys.executable, "-m", "vla_zenoh", "serve", "policy", "--port", str(port), *more]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert "'s clients at ws://" in process.stdout.readline()
            yield port
            process.send_signal(signal.SIGINT)
            assert process.wait(WAIT_S) == 0
        finally:
            if process.poll() is None:
                process.kill()


@contextmanager
def connected(port: int, key: str = "") -> Iterator[tuple[ClientConnection, dict[str, Any]]]:
    headers = {"Authorization": f"Api-Key {key}"} if key else None
    url = f"ws://127.0.0.1:{port}"
    with connect(url, compression=None, proxy=None, additional_headers=headers) as connection:
        yield connection, openpi.read_metadata(connection.recv(WAIT_S))


def question(prompt: str = "HARD: go up", **changes: Any) -> bytes:
    fields = {
        "observation/front": np.zeros((48, 64, 3), np.uint8),
        "observation/pose": np.array([0.4, 0, 0.3, 1, 0, 0, 0]),
        "observation/gripper": np.array([0.05], np.float32),
        "prompt": prompt,
        **changes,
    }
    return openpi.request({name: value for name, value in fields.items() if value is not None})


def health(port: int, path: str = "/healthz") -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)
    connection.request("GET", path)
    response = connection.getresponse()
    try:
        return response.status, response.read()
    finally:
        connection.close()


def test_a_client_learns_what_is_served_gets_actions_and_is_told_what_is_wrong() -> None:
    with serving("--worker", "scripted", "--api-key", KEY) as port:
        assert health(port) == (200, b"OK\n")
        with connected(port, KEY) as (connection, said):
            assert said["action_dim"] == 7
            assert said["vla_zenoh_action"]["gripper"] == "delta_m"
            assert set(said["observation"]) == set(msgpack.unpackb(question()))
            for _ in range(2):
                connection.send(question())
                answer = openpi.read_answer(connection.recv(WAIT_S))
                np.testing.assert_allclose(
                    answer["actions"], [[0, 0, STEP_M, 0, 0, 0, 0]], atol=ATOL_M
                )
            assert {"infer_ms", "prev_total_ms"} <= set(answer["server_timing"])
            # One at a time, and only with the key; health is for everybody.
            with pytest.raises(InvalidStatus, match="503"), connected(port, KEY):
                pass
            with pytest.raises(InvalidStatus, match="401"), connected(port, "another"):
                pass
            assert health(port)[0] == 200
            connection.send(question(prompt="dance"))
            told = connection.recv(WAIT_S)
            assert isinstance(told, str)
            assert "does not know the prompt 'dance'" in told
            with pytest.raises(ConnectionClosed):
                connection.recv(WAIT_S)

        # The place is free again at once, and every other slip is named too.
        for wrong, named in (
            (question(**{"observation/pose": None}), "lacks observation/pose"),
            (question(**{"observation/pose": np.zeros(3)}), "wanted (7,)"),
            (question(**{"observation/pose": np.zeros(7)}), "quaternion"),
            (question(**{"observation/front": np.zeros((4, 4), np.uint8)}), "front"),
            (question(**{"observation/gripper": "wide"}), "gripper"),
            (b"\xc1", "cannot be read"),
        ):
            until("the place is free", partial(_asks, port, wrong, named), START_S)


def _asks(port: int, frame: bytes, named: str) -> bool:
    try:
        with connected(port, KEY) as (connection, _):
            connection.send(frame)
            told = connection.recv(WAIT_S)
    except InvalidStatus:
        return False
    assert isinstance(told, str)
    assert named in told, told
    return True


def test_our_own_adapter_drives_our_own_server() -> None:
    with serving("--worker", "scripted") as port:
        settings = {"url": f"ws://127.0.0.1:{port}", "preset": "own", "gripper": "delta_m"}
        policy = make_policy(find_model("openpi"), settings)
        try:
            seen = example_observation(policy.spec, prompt="HARD: go up")
            steps = np.asarray(policy.infer(seen).steps)
            np.testing.assert_allclose(steps, [[0, 0, STEP_M, 0, 0, 0, 0]], atol=ATOL_M)
        finally:
            policy.close()  # pyright: ignore[reportAttributeAccessIssue]
        other = make_policy(find_model("openpi"), {**settings, "gripper": "absolute_m"})
        until("the first one has left", partial(_rejects, other, seen), START_S)


def _rejects(policy: Policy, seen: Observation) -> bool:
    with pytest.raises(PeerError) as told:
        policy.infer(seen)
    if "503" in str(told.value) or "retrying in" in str(told.value):
        return False
    assert "its gripper is 'delta_m', 'absolute_m' is set" in str(told.value)
    return True


def test_a_new_episode_of_our_adapter_is_one_of_our_server() -> None:
    """A fixed number of steps, done in shadow mode, is done again after an activation."""
    with serving("--worker", "scripted") as port:
        settings = {"url": f"ws://127.0.0.1:{port}", "preset": "own", "gripper": "delta_m"}
        policy: Any = make_policy(find_model("openpi"), settings)
        seen = example_observation(policy.spec, prompt="HARD: go up x1")
        try:
            up_m = [policy.infer(seen).steps[0][2] for _ in range(2)]
            policy.reset()
            up_m += [policy.infer(seen).steps[0][2] for _ in range(2)]
        finally:
            policy.close()
    np.testing.assert_allclose(up_m, [STEP_M, 0, STEP_M, 0], atol=ATOL_M)


@pytest.mark.slow
def test_openpis_own_client_is_served(tmp_path: Path) -> None:
    python = python_with(*OPENPI_CLIENT)
    with serving("--worker", "scripted") as port:
        done = subprocess.run(
            [python, "-c", WITH_OPENPI, str(port)],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            check=False,
            timeout=60,
        )
    assert done.returncode == 0, done.stderr
    dim, steps, said = json.loads(done.stdout)
    assert dim == 7
    np.testing.assert_allclose(steps, [[0, 0, STEP_M, 0, 0, 0, 0]] * 2, atol=ATOL_M)
    assert "Error in inference server" in said
    assert "the observation lacks observation/front" in said


# -- names ----------------------------------------------------------------------------------------
def model() -> Policy:
    return make_policy(find_model("scripted"))


def offer(names: str = "") -> Any:
    return make_served_policy(model(), names, load_profile("panda_sim"))


def test_the_names_of_an_offer_can_be_those_of_liberos_clients() -> None:
    names = "observation/image=camera:front, observation/state=position+rotvec+fingers_m"
    given = {
        "observation/image": np.zeros((256, 256, 3), np.uint8),
        "observation/state": np.array([0.4, 0, 0.3, np.pi, 0, 0, 0.03, -0.03]),
        "prompt": "go",
        "more": 1,
    }
    seen = offer(names).observe(given, 5)
    assert seen.pose.position_m.tolist() == [0.4, 0.0, 0.3]
    assert abs(seen.pose.quat_xyzw[0]) == pytest.approx(1.0)
    assert seen.gripper.width_m == pytest.approx(0.06)
    assert seen.images["front"].shape == (256, 256, 3)
    assert (seen.prompt, seen.task.active, seen.stamp_wall_ns) == ("go", True, 5)


ASKED = {
    "observation/front": np.full((48, 64, 3), 51, np.uint8),
    "observation/pose": np.array([0.4, 0, 0.3, 1, 0, 0, 0]),
    "observation/gripper": np.array([0.05]),
    "prompt": "go",
}


@pytest.mark.parametrize(
    "width", [0.05, np.float32(0.05), np.array(0.05), [0.05], np.array([0.05])]
)
def test_a_gripper_comes_with_or_without_a_shape(width: Any) -> None:
    """As openpi's own DROID policies take it."""
    seen = offer().observe({**ASKED, "observation/gripper": width}, 5)
    assert seen.gripper.width_m == pytest.approx(0.05)


@pytest.mark.parametrize("dtype", [np.uint8, np.int64, np.float32, np.float64])
@pytest.mark.parametrize("first", [False, True])
def test_an_image_comes_as_bytes_or_floats_and_with_its_channels_first_or_last(
    dtype: Any, first: bool
) -> None:
    """As openpi's own policies take it (`_parse_image`)."""
    image = ASKED["observation/front"].copy()
    image[:, 32:, 1] = 255
    given: Any = image.astype(dtype) if np.dtype(dtype).kind != "f" else (image / 255).astype(dtype)
    given = np.moveaxis(given, -1, 0) if first else given
    seen = offer().observe({**ASKED, "observation/front": given}, 5)
    same = offer().observe({**ASKED, "observation/front": image}, 5)
    off = seen.images["front"].astype(int) - same.images["front"]
    assert np.abs(off).max() <= 1  # floats are cut off, as there


@pytest.mark.parametrize("width", [None, True, "0.05", b"0.05", 0.05 + 1j, [[0.05]], []])
def test_a_gripper_that_is_no_number_is_named(width: Any) -> None:
    with pytest.raises(PeerError, match="gripper"):
        offer().observe({**ASKED, "observation/gripper": width}, 5)


@pytest.mark.parametrize(("value", "level"), [(1 + 1e-6, 255), (1.009, 255), (-0.009, 0)])
def test_floats_of_an_image_that_was_resized_are_cut_off(value: float, level: int) -> None:
    given = {**ASKED, "observation/front": np.full((48, 64, 3), value)}
    assert (offer().observe(given, 5).images["front"] == level).all()


@pytest.mark.parametrize(
    ("image", "why"),
    [
        (np.zeros((0, 64, 3), np.uint8), "is no image"),
        (np.full((48, 64, 3), -0.5), "numbers from -0.5 to -0.5; wanted 0 to 1"),
        (np.full((48, 64, 3), 51.0), "wanted 0 to 1, as it holds floats"),
        (np.full((48, 64, 3), np.nan), "wanted 0 to 1"),
        (np.full((48, 64, 3), 300), "numbers from 300 to 300; wanted 0 to 255"),
        (np.zeros((2, 48, 64, 3)), "is no image"),
        (np.zeros((48, 64), np.uint8), "is no image"),
        ("picture", "is no image"),
    ],
)
def test_what_is_no_image_is_named(image: Any, why: str) -> None:
    with pytest.raises(PeerError, match=f"observation/front .*{why}"):
        offer().observe({**ASKED, "observation/front": image}, 5)


def test_a_model_is_given_the_same_sign_whichever_a_client_sends() -> None:
    """That nearer to the home orientation, which points down."""
    for sign in (1.0, -1.0):
        pose = np.array([0.4, 0, 0.3, sign, 0, 0, 1e-4])
        seen = offer().observe({**ASKED, "observation/pose": pose}, 5)
        assert seen.pose is not None
        assert seen.pose.quat_xyzw[0] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("names", "why"),
    [
        ("a=camera:back", "the model has no camera back"),
        ("a=x+y+z", "the whole pose"),
        ("a=position", "the whole pose"),
        ("a=blank:4x4", "blank is for what is sent"),
    ],
)
def test_names_that_do_not_say_enough_are_refused(names: str, why: str) -> None:
    with pytest.raises(SpecError, match=why):
        offer(names)
