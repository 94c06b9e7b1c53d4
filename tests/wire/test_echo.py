"""``vla-zenoh echo`` beside a router without a robot."""

from __future__ import annotations

import subprocess
import sys

from camera_rig import free_endpoint

from vla_zenoh.bus.session import open_session
from vla_zenoh.profile import load_profile, override


def test_echo_names_the_key_that_was_meant_and_ends_with_the_router() -> None:
    endpoint = free_endpoint()
    profile = override(load_profile("panda_sim"), {"session": {"listen": [endpoint]}})
    words = ("echo", "state/joints", "--count", "1", "--connect", endpoint)
    with open_session(profile.session, mode="router"):
        echo = subprocess.Popen(
            [sys.executable, "-m", "vla_zenoh", *words], stderr=subprocess.PIPE, text=True
        )
        assert echo.stderr is not None
        hint = echo.stderr.readline()
    _, said = echo.communicate(timeout=30.0)
    assert hint == "nothing on vla/panda/state/joints yet; did you mean 'state/joint'?\n"
    assert f"error: no Zenoh router answers at {endpoint}" in said
    assert echo.returncode == 1
