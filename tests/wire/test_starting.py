"""A worker that still imports its model is in the status, and so is that it failed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import zenoh

from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.keys import CRASHED, STARTING
from vla_zenoh.profile import load_profile, override

pytestmark = pytest.mark.realtime
AT = "tcp/127.0.0.1:17472"


def test_a_worker_that_imports_its_model_is_starting_and_then_crashed(tmp_path: Path) -> None:
    model = tmp_path / "slow.py"
    model.write_text('import time\ntime.sleep(4)\nraise ValueError("no model")\n')
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
                assert client.wait_for(lambda: has(STARTING), 30.0)
                assert client.wait_for(lambda: has(CRASHED), 30.0)
            finally:
                worker.kill()
