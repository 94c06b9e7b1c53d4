"""Our models for vla-eval's benchmarks: the command as a process, asked over real WebSockets.

The messages are written here as its package writes them; that package itself asks in the slow test.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import msgpack
import numpy as np
import pytest
from peer_rig import python_with
from test_serve_openpi import health, serving
from websockets.sync.client import ClientConnection, connect

from vla_zenoh.errors import CodecError, PeerError
from vla_zenoh.lab.serve import vla_eval
from vla_zenoh.policy import ActionSpec

WAIT_S = 10.0
STEP_M, ATOL_M = 0.01, 1e-6
VLA_EVAL = ("vla-eval==0.8.0",)
WITH_VLA_EVAL = """\
import json, sys
import anyio
import numpy as np
from vla_eval.connection import Connection

async def main():
    async with Connection(f"ws://127.0.0.1:{sys.argv[1]}") as connection:
        seen = {
            "images": {"front": np.zeros((256, 256, 3), np.uint8)},
            "states": {"pose": np.array([0.4, 0, 0.3, 1, 0, 0, 0]), "gripper": np.array([0.05])},
            "task_description": "HARD: go up x2",
        }
        actions = []
        for _ in range(2):
            await connection.start_episode({"task": {"name": "up"}})
            actions += [(await connection.act(seen))["actions"].tolist() for _ in range(3)]
            await connection.end_episode({"success": True})
        try:
            await connection.act({"task_description": "HARD: go up"})
            said = ""
        except RuntimeError as error:
            said = str(error)
        after = (await connection.act(seen))["actions"].tolist()
        print(json.dumps([connection.server_info, actions, said, after]))

anyio.run(main)
"""
UP, STILL = [0, 0, STEP_M, 0, 0, 0, 0], [0] * 7


def array(value: Any) -> dict[str, Any]:
    given = np.asarray(value)
    shape = list(given.shape)
    return {"__ndarray__": True, "data": given.tobytes(), "dtype": given.dtype.str, "shape": shape}


def image(form: str) -> dict[str, Any]:
    rgb = np.zeros((48, 64, 3), np.uint8)
    data = rgb.tobytes() if form == "raw" else cv2.imencode(f".{form}", rgb)[1].tobytes()
    found = {"__image__": True, "format": form, "data": data, "shape": [48, 64, 3]}
    return found | ({"dtype": "|u1"} if form == "raw" else {})


def seen(prompt: str = "HARD: go up", form: str = "png", **changes: Any) -> dict[str, Any]:
    return {
        "images": {"front": image(form)},
        "states": {"pose": array([0.4, 0, 0.3, 1.0, 0, 0, 0]), "gripper": array([0.05])},
        "task_description": prompt,
        **changes,
    }


def said(kind: str, payload: Any, seq: int = 1) -> bytes:
    found = msgpack.packb({"type": kind, "payload": payload, "seq": seq, "timestamp": 0.0})
    assert found is not None
    return found


@contextmanager
def harness(*more: str) -> Iterator[ClientConnection]:
    with (
        serving("--worker", "scripted", "--wire", "vla-eval", *more) as port,
        connect(f"ws://127.0.0.1:{port}", compression=None, proxy=None) as connection,
    ):
        assert health(port, vla_eval.HEALTH_PATH)[0] == 200
        yield connection


def asked(connection: ClientConnection, frame: bytes) -> tuple[str, dict[str, Any], int]:
    connection.send(frame)
    answer = connection.recv(WAIT_S)
    return vla_eval.read_message(answer)


def test_an_observation_is_answered_with_one_action_that_carries_its_number() -> None:
    with harness() as connection:
        kind, payload, seq = asked(connection, said("hello", {"protocol_version": 1}, 7))
        assert (kind, payload["model_server"], seq) == ("hello", "scripted", 7)
        assert payload["action_spec"]["position"]["format"] == "delta_xyz"
        connection.send(said("episode_start", {}))
        for number, form in enumerate(("png", "jpg", "raw"), 10):
            form = {"jpg": "jpeg"}.get(form, form)
            kind, payload, seq = asked(connection, said("observation", seen(form=form), number))
            assert (kind, seq) == ("action", number)
            np.testing.assert_allclose(payload["actions"], UP, atol=ATOL_M)
        connection.send(said("episode_end", {"success": True}))


def test_the_steps_of_a_chunk_are_given_out_one_by_one_and_an_episode_begins_anew() -> None:
    with harness("--set", "horizon=3", "--execute", "2") as connection:
        up_m: list[float] = []
        for _ in range(2):
            connection.send(said("episode_start", {}))
            for _ in range(4):
                _, payload, _ = asked(connection, said("observation", seen("HARD: go up x3")))
                up_m.append(float(payload["actions"][2]))
        # A chunk of three steps of which two are carried out, then one that stands on them.
        assert up_m[:4] == up_m[4:]
        np.testing.assert_allclose(up_m[:2], [STEP_M, STEP_M], atol=ATOL_M)


def test_what_is_wrong_is_told_and_the_connection_goes_on() -> None:
    with harness() as connection:
        for wrong, named in (
            (said("observation", {"task_description": "HARD: go up"}), "lacks images/front"),
            (said("observation", seen("dance")), "does not know the prompt 'dance'"),
            (said("observation", seen(states={"pose": 1, "gripper": array([0.0])})), "states/pose"),
            (said("observation", seen(images={"front": {"__image__": True}})), "an image of"),
            (msgpack.packb([1, 2]), "a message is a map"),
            (msgpack.packb({"type": "observation"}), "no type, payload and seq"),
            (b"\xc1", "cannot be read"),
        ):
            assert wrong is not None
            kind, payload, _ = asked(connection, wrong)
            assert kind == "error"
            assert named in payload["error"], payload
        kind, _, _ = asked(connection, said("observation", seen()))
        assert kind == "action"


@pytest.mark.parametrize(
    "value",
    [
        {"__image__": True, "format": "png", "data": b"\x89PNG\r\n\x1a\n" + bytes(8) + b"\xff" * 8},
        {"__image__": True, "format": "png", "data": b"\x89PNG"},
        {"__image__": True, "format": "jpeg", "data": b"\xff\xd8\xff"},
        {"__image__": True, "format": "gif", "data": b""},
        {"__ndarray__": True, "data": b"12", "dtype": "|O", "shape": [1]},
        {"__ndarray__": True, "data": b"12", "dtype": "<f4", "shape": [1 << 40]},
        {"__ndarray__": True},
    ],
)
def test_no_forged_array_or_image_is_read(value: dict[str, Any]) -> None:
    with pytest.raises((PeerError, CodecError)):
        vla_eval.read_message(said("observation", {"images": {"front": value}}))


def test_an_action_spec_says_nothing_that_vla_eval_has_no_name_for() -> None:
    joints = ActionSpec(space="joint", joints=("a", "b"), horizon=1, dt_s=0.1, gripper="none")
    assert vla_eval.action_spec(joints) == {}
    velocity = ActionSpec(kind="velocity", rotation="rotvec", horizon=1, dt_s=0.1, gripper="none")
    assert set(vla_eval.action_spec(velocity)) == {"rotation"}


@pytest.mark.slow
def test_vla_evals_own_client_is_served(tmp_path: Path) -> None:
    python = python_with(*VLA_EVAL)
    with serving("--worker", "scripted", "--wire", "vla-eval", "--set", "horizon=3") as port:
        done = subprocess.run(
            [python, "-c", WITH_VLA_EVAL, str(port)],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            check=False,
            timeout=60,
        )
    assert done.returncode == 0, done.stderr
    info, actions, error, after = json.loads(done.stdout)
    assert info["model_server"] == "scripted"
    np.testing.assert_allclose(actions, [UP, UP, STILL] * 2, atol=ATOL_M)
    assert "the observation lacks images/front" in error
    assert len(after) == len(UP)
