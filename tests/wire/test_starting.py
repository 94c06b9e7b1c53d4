"""What is starting is in the status, and commands wait for it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from subprocess import DEVNULL, PIPE

import pytest
import zenoh
from chain import LONG_PATIENCE_S, write_profile

import vla_zenoh
from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.errors import SessionError
from vla_zenoh.keys import CRASHED, STARTING
from vla_zenoh.profile import load_profile, override

pytestmark = pytest.mark.realtime
AT = "tcp/127.0.0.1:17472"


MODEL = """
import time
from vla_zenoh.errors import WorkerError
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, ObservationSpec

WHY = "action is scaled by MEAN_STD, and there are no statistics of it"


class Model:
    spec = ModelSpec(
        name="slow",
        observation=ObservationSpec(cameras=(CameraSpec(camera="front"),)),
        action=ActionSpec(horizon=1, dt_s=0.1, gripper="none"),
    )

    def load(self):
        raise WorkerError(WHY)

    def infer(self, observation):
        raise WorkerError(WHY)
"""
ON_ITS_WAY = """
import time
from pathlib import Path
while not Path(__file__).with_name("go").exists():
    time.sleep(0.05)
raise ValueError('no model')
"""
BROKEN = {"import": ON_ITS_WAY, "load": MODEL}
WHY = {"import": "no model", "load": "action is scaled by MEAN_STD, and there are no statistics"}


@pytest.mark.parametrize("how", BROKEN)
def test_a_worker_that_is_started_by_hand_is_starting_and_then_crashed(
    tmp_path: Path, how: str
) -> None:
    model = tmp_path / "slow.py"
    model.write_text(BROKEN[how])
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["{AT}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    profile = override(load_profile("panda_sim"), {"session": {"connect": [AT]}})
    words = [sys.executable, "-m", "vla_zenoh", "worker", str(model), "--connect", AT]

    with zenoh.open(config), open_session(profile.session, wait_s=5.0) as session:
        client = Client(profile, session).subscribe()

        def has(state: str) -> bool:
            status = client.status("worker-slow")
            return status is not None and status.state == state

        with subprocess.Popen(words, stderr=subprocess.DEVNULL) as worker:
            try:
                if how == "import":
                    assert client.wait_for(lambda: has(STARTING), 30.0)
                    (tmp_path / "go").touch()
                assert client.wait_for(lambda: has(CRASHED), 30.0)
            finally:
                worker.kill()
        status = client.status("worker-slow")
        assert status is not None
        assert WHY[how] in status.detail["complaint"]


@pytest.mark.long
def test_commands_that_are_typed_before_up_wait_for_it(tmp_path: Path) -> None:
    path = write_profile(tmp_path, patience_s=LONG_PATIENCE_S)
    words = [sys.executable, "-m", "vla_zenoh"]
    script = f"""
import vla_zenoh
with vla_zenoh.connect({str(path)!r}) as robot:
    print(robot.set_speed(50).speed_percent)
"""
    with (
        subprocess.Popen([sys.executable, "-c", script], stdout=PIPE, stderr=PIPE, text=True) as py,
        subprocess.Popen(
            [*words, "activate", "--json", "--profile", str(path)], stdout=PIPE, text=True
        ) as activation,
        subprocess.Popen([*words, "up", str(path)], stdout=DEVNULL, stderr=DEVNULL) as up,
    ):
        try:
            answer = json.loads(activation.communicate(timeout=60)[0])
            said, logged = py.communicate(timeout=60)
        finally:
            up.send_signal(signal.SIGINT)
            up.wait(30)
    assert answer["ok"], answer
    assert "waiting, at most 20 s: no Zenoh router answers" in answer["warnings"][0]
    assert said == "50.0\n", logged
    assert "waiting, at most 20 s: no Zenoh router answers" in logged


@pytest.mark.long
def test_an_activation_names_why_the_model_of_a_worker_started_by_hand_failed(
    tmp_path: Path,
) -> None:
    path, model = write_profile(tmp_path, patience_s=LONG_PATIENCE_S), tmp_path / "slow.py"
    model.write_text(MODEL)
    words = [sys.executable, "-m", "vla_zenoh"]
    with subprocess.Popen([*words, "up", str(path)], stdout=DEVNULL, stderr=DEVNULL) as up:
        try:
            with vla_zenoh.connect(str(path)) as robot:
                robot.set_prompt("hold")
                failed = subprocess.run(
                    [*words, "worker", str(model), "--profile", str(path)],
                    capture_output=True,
                    check=False,
                    timeout=60,
                )
                assert failed.returncode == 1
                robot.set_worker("slow")
                with pytest.raises(SessionError, match=rf"'slow' is not alive: {WHY['load']}"):
                    robot.activate()
        finally:
            up.send_signal(signal.SIGINT)
            up.wait(30)
