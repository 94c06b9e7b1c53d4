"""``vla-zenoh router``: ours, or the program zenohd with the same configuration."""

from __future__ import annotations

import datetime as dt
import json
import os
import subprocess
import sys
from pathlib import Path

import zenoh
from camera_rig import free_endpoint

from vla_zenoh.profile import load_profile
from vla_zenoh.security.identity import identities
from vla_zenoh.security.rules import access_control
from vla_zenoh.security.store import Store
from vla_zenoh.security.written import profile_text, serving_addresses

LIMIT_S = 20.0
STAND_IN = """\
#!/bin/sh
test "$1" = --config && cat "$2"
"""
"""In the place of zenohd: shows the configuration it was given."""


def secured(folder: Path, more: str = "") -> Path:
    """A lab with certificates, at a free port of this computer."""
    plain = folder / "plain.yaml"
    endpoint = free_endpoint()
    plain.write_text(
        f"extends: panda_sim\nsession: {{listen: [{endpoint}], connect: [{endpoint}]}}\n"
    )
    profile, store, now = load_profile(str(plain)), Store(folder / "keys"), dt.datetime.now(dt.UTC)
    store.make_authority("test lab", now)
    store.add(identities(profile), now, addresses=serving_addresses(profile))
    file = folder / "lab.yaml"
    text = profile_text(profile, "plain", store.folder)
    file.write_text(text.replace("session:\n", f"session:\n{more}"))
    return file


def router(file: Path, *options: str, path: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "vla_zenoh", "router", "--profile", str(file), *options],
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
        env={**os.environ, "PATH": path or os.environ["PATH"]},
    )


def test_the_printed_configuration_is_one_that_zenoh_takes(tmp_path: Path) -> None:
    file = secured(tmp_path)
    shown = router(file, "--config")
    assert shown.returncode == 0, shown.stderr
    settings = json.loads(shown.stdout)
    zenoh.Config.from_json5(shown.stdout)
    assert settings["access_control"] == access_control([load_profile(str(file))])
    tls = settings["transport"]["link"]["tls"]
    assert tls["enable_mtls"]
    assert tls["listen_certificate"].endswith("here/router.pem")


def test_zenohd_gets_the_configuration_that_our_own_router_has(tmp_path: Path) -> None:
    file = secured(tmp_path, "  router: zenohd\n")
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "zenohd").write_text(STAND_IN)
    (programs / "zenohd").chmod(0o755)
    ours = json.loads(router(file, "--config").stdout)
    given = router(file, path=f"{programs}{os.pathsep}{os.environ['PATH']}")
    assert given.returncode == 0, given.stderr
    assert json.loads(given.stdout) == ours


def test_a_zenohd_that_is_not_there_is_told(tmp_path: Path) -> None:
    file = secured(tmp_path, "  router: zenohd\n")
    done = router(file, path=str(tmp_path))
    assert done.returncode == 1
    assert "there is no zenohd on PATH" in done.stderr


def test_a_router_without_its_certificate_says_how_to_get_one(tmp_path: Path) -> None:
    file = secured(tmp_path)
    (tmp_path / "keys" / "here" / "router.key").unlink()
    done = router(file)
    assert done.returncode == 1
    assert "secure add here" in done.stderr.replace("\n", " ")
