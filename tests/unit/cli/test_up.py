"""vla-zenoh up: which profile it takes."""

from __future__ import annotations

import os
import subprocess
import sys

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
