"""vla-zenoh up: which profile it takes, and a port that is taken."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from chain import write_profile

PATIENCE_S = 60.0


def test_up_takes_the_profile_that_the_environment_names_as_every_command_does() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "vla_zenoh", "up"],
        env={**os.environ, "VLA_ZENOH_PROFILE": "no_such_profile"},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 1
    assert "'no_such_profile'" in done.stderr


@pytest.mark.long
def test_up_on_a_port_of_another_program_names_port_and_way_out_and_starts_nothing(
    tmp_path: Path,
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        profile = write_profile(tmp_path, endpoint=f"tcp/127.0.0.1:{port}")
        done = subprocess.run(
            [sys.executable, "-m", "vla_zenoh", "up", str(profile)],
            env={**os.environ, "XDG_STATE_HOME": str(tmp_path)},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
    assert done.returncode == 1
    (error,) = done.stderr.splitlines()
    assert f"the router cannot listen on tcp/127.0.0.1:{port}: another program has port" in error
    assert f"`ss -ltnp 'sport = :{port}'` names it" in error
    assert "choose another port with session.listen and session.connect" in error
    assert done.stdout == ""
