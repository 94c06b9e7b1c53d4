"""Commands beside a router without a robot."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import zenoh
from camera_rig import free_endpoint, until
from chain import READY_PATIENCE_S, write_profile
from teleop_rig import Screen
from web_rig import first_line

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
        hint = first_line(echo)
    _, said = echo.communicate(timeout=30.0)
    assert hint == "nothing on vla/panda/state/joints yet; did you mean 'state/joint'?\n"
    assert f"error: no Zenoh router answers at {endpoint}" in said
    assert echo.returncode == 1


def test_enter_never_activates_an_arm_whose_state_is_unknown(tmp_path: Path) -> None:
    file = write_profile(tmp_path)
    profile = load_profile(str(file))
    heard: list[str] = []
    router = open_session(profile.session, mode="router")
    with open_session(profile.session) as session:
        handler = zenoh.handlers.Callback(
            lambda sample: heard.append(sample.payload.to_string()), indirect=False
        )
        listening = session.declare_subscriber(profile.keys.active, handler)
        screen = Screen(file)
        try:
            until("it is there", lambda: b"follows ?" in screen.shown, READY_PATIENCE_S)
            screen.type(b"\r")
            until("it is told", lambda: b"state unknown: Enter deactivates" in screen.shown)
            until("the brake", lambda: heard)
            router.close()
            lost = b"the link to the router is lost: nobody heard that"

            def told() -> bool:
                screen.type(b"x")
                return lost in screen.shown

            until("the lost link is told", told)
        finally:
            screen.close()
            router.close()
        listening.undeclare()
    assert heard == ["false"]
