"""lerobot's own policy server is asked: the steps are those of the worker that runs the policy."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="needs LeRobot's environment: make test-models")
import grpc
import tiny_act
from test_lerobot import ACTION_OPTIONS, looking

from vla_zenoh.errors import PeerError
from vla_zenoh.policy.loader import find_model, make_policy

pytestmark = pytest.mark.models

ATOL = 1e-6
START_S, LOAD_S = 60.0, 60.0
MEANS = {name: value for name, value in ACTION_OPTIONS.items() if name != "state"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("lerobot") / "act"
    tiny_act.write(found)
    # The server would fetch weights that those of the folder then replace.
    config = json.loads((found / "config.json").read_text())
    (found / "config.json").write_text(json.dumps({**config, "pretrained_backbone_weights": None}))
    return found


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        found, place = free.getsockname()[1], tmp_path_factory.mktemp("server")
    command = [sys.executable, "-m", "lerobot.async_inference.policy_server"]
    told = ["--host=127.0.0.1", f"--port={found}", "--inference_latency=0"]
    with subprocess.Popen([*command, *told], cwd=place) as server:  # it writes a folder of logs
        try:
            with grpc.insecure_channel(f"127.0.0.1:{found}") as channel:
                grpc.channel_ready_future(channel).result(START_S)
            yield found
        finally:
            server.send_signal(signal.SIGKILL)


def asking(port: int, checkpoint: Path, **options: str) -> Any:
    given = {
        "url": f"grpc://127.0.0.1:{port}",
        "policy": "act",
        "checkpoint": str(checkpoint),
        "preset": "none",
        "map": "observation.images.front=camera:front, observation.state=position+rotvec+gripper_m",
        "size": "",
        "resize": "none",
        "timeout_s": str(LOAD_S),
        **MEANS,
        "horizon": str(tiny_act.STEPS),
        **options,
    }
    return make_policy(find_model("lerobot_server"), given)


def test_its_steps_are_those_of_the_policy(port: int, folder: Path) -> None:
    here = make_policy(
        find_model("lerobot"), {"checkpoint": str(folder), "device": "cpu", **ACTION_OPTIONS}
    )
    here.load()  # pyright: ignore[reportAttributeAccessIssue]
    there = asking(port, folder)
    try:
        for seed in range(3):
            seen = looking(here, seed)
            steps = np.asarray(there.infer(seen).steps)
            assert steps.shape == (tiny_act.STEPS, tiny_act.ACTION_SIZE)
            np.testing.assert_allclose(steps, np.asarray(here.infer(seen).steps), atol=ATOL)
    finally:
        there.close()


def test_a_picture_of_another_name_is_told_to_look_into_its_log(port: int, folder: Path) -> None:
    policy = asking(
        port,
        folder,
        map="observation.images.top=camera:front, observation.state=position+rotvec+gripper_m",
    )
    try:
        with pytest.raises(PeerError, match="its log says why"):
            policy.infer(looking(policy, 0))
    finally:
        policy.close()


def test_a_policy_that_is_not_there_is_told_in_the_servers_words(port: int, tmp_path: Path) -> None:
    policy = asking(port, tmp_path / "nothing")
    try:
        with pytest.raises(PeerError, match="Exception calling application") as raised:
            policy.infer(looking(policy, 0))
    finally:
        policy.close()
    assert raised.value.reason == "peer_error"
