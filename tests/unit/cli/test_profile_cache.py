"""Outlines of profiles: what a client reads of them is exactly what the profile says."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from vla_zenoh.bus.session import session_config
from vla_zenoh.cli.target import RobotTarget, _Outline
from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import Profile
from vla_zenoh.resources import names
from vla_zenoh.security.roles import identities, operator_role
from vla_zenoh.security.store import operator_hosts

SECURED = """\
extends: panda_sim
session:
  connect: [tls/10.0.0.2:7447]
  listen: [tls/10.0.0.2:7447]
  separate_links: true
  lease_ms: 700
  security: {folder: KEYS, people: {desk: operator, wall: viewer}}
hosts:
  robot: {nodes: [router, sim, camera, command]}
  gpu: {nodes: [worker]}
"""


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("VLA_ZENOH_PROFILE", "VLA_ZENOH_CONNECT", "VLA_ZENOH_HOST"):
        monkeypatch.delenv(name, raising=False)


def outline(target: RobotTarget) -> Profile:
    """From the cache, which has it by now."""
    target.outline()
    found = target.outline()
    assert isinstance(found, _Outline)
    return found


def is_cached(target: RobotTarget) -> bool:
    return isinstance(target.outline(), _Outline)


@pytest.fixture
def secured(tmp_path: Path) -> Path:
    for host, node in (("desk", "operator"), ("wall", "viewer"), ("robot", "operator")):
        folder = tmp_path / "keys" / host
        folder.mkdir(parents=True)
        (folder / "ca.pem").touch()
        for end in ("pem", "key"):
            (folder / f"{node}.{end}").touch(mode=0o600)
    file = tmp_path / "secured.yaml"
    file.write_text(SECURED.replace("KEYS", str(tmp_path / "keys")))
    return file


def assert_same(ours: Profile, full: Profile) -> None:
    assert (ours.name, ours.keys, ours.robot.name) == (full.name, full.keys, full.robot.name)
    assert identities(ours) == identities(full)
    for stop in (False, True):
        assert operator_hosts(ours, stop=stop) == operator_hosts(full, stop=stop)
    people = full.session.security.people if full.session.security else {}
    for host in (*full.hosts, *people, "nobody"):
        assert operator_role(ours, host) is operator_role(full, host)


@pytest.mark.parametrize("name", names("profiles"))
def test_the_outline_of_a_shipped_profile_says_what_the_profile_says(name: str) -> None:
    full = RobotTarget(name)._load()
    ours = outline(RobotTarget(name))
    assert_same(ours, full)
    assert session_config(ours.session) == session_config(full.session)


@pytest.mark.parametrize(
    "target",
    [
        lambda file: RobotTarget(file),
        lambda file: RobotTarget(file, ["tls/10.0.0.9:7000"], robot="ur"),
        lambda file: RobotTarget(file, host="wall"),
    ],
)
def test_security_is_exactly_that_of_the_full_profile(
    target: Callable[[str], RobotTarget], secured: Path
) -> None:
    """Endpoints, certificates, and in which order those of several people are tried."""
    robot = target(str(secured))
    full, ours = robot._load(), outline(robot)
    assert_same(ours, full)
    for host in ("desk", "wall", "robot"):
        configs = []
        for profile in (full, ours):
            assert profile.session.security is not None
            security = profile.session.security.model_copy(update={"host": host})
            session = profile.session.model_copy(update={"security": security})
            configs.append(session_config(session))
        assert configs[0] == configs[1]
        assert configs[0]["transport"]["link"]["tls"]["enable_mtls"] is True


def test_what_an_outline_lacks_comes_from_the_profile() -> None:
    ours, full = outline(RobotTarget("panda_sim")), RobotTarget("panda_sim")._load()
    assert ours.timing == full.timing
    assert ours.limits == full.limits


def test_a_profile_that_changed_is_read_again(tmp_path: Path) -> None:
    base, top = tmp_path / "base.yaml", tmp_path / "top.yaml"
    base.write_text("extends: panda_sim\nrobot: {name: one}\n")
    top.write_text("extends: base\n")
    target = RobotTarget(str(top))
    assert outline(target).keys.robot == "one"
    before = base.stat()
    base.write_text("extends: panda_sim\nrobot: {name: two}\n")
    os.utime(base, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert not is_cached(target)
    assert outline(target).keys.robot == "two"


def test_a_file_that_now_comes_first_on_the_search_path_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [tmp_path / name / "profiles" for name in ("first", "second")]
    for folder in folders:
        folder.mkdir(parents=True)
    monkeypatch.setenv("VLA_ZENOH_PATH", os.pathsep.join(str(one.parent) for one in folders))
    (folders[1] / "base.yaml").write_text("extends: panda_sim\nrobot: {name: second}\n")
    top = tmp_path / "top.yaml"
    top.write_text("extends: base\n")
    assert outline(RobotTarget(str(top))).keys.robot == "second"
    (folders[0] / "base.yaml").write_text("extends: panda_sim\nrobot: {name: first}\n")
    assert not is_cached(RobotTarget(str(top)))
    assert outline(RobotTarget(str(top))).keys.robot == "first"


def test_other_options_have_an_outline_of_their_own() -> None:
    assert outline(RobotTarget("panda_sim")).session.connect == ["tcp/127.0.0.1:7447"]
    elsewhere = RobotTarget("panda_sim", ["tcp/127.0.0.1:9"])
    assert not is_cached(elsewhere)
    assert outline(elsewhere).session.connect == ["tcp/127.0.0.1:9"]


def test_an_invalid_profile_says_what_is_wrong_each_time(tmp_path: Path) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text("extends: panda_sim\nrobot: {name: one}\n")
    assert is_cached(RobotTarget(str(file))) is False
    file.write_text("extends: panda_sim\nnosuch: 1\n")
    for _ in range(2):
        with pytest.raises(ProfileError, match="nosuch: unknown key"):
            RobotTarget(str(file)).outline()
    with pytest.raises(ProfileError, match="no profile called 'nowhere'"):
        RobotTarget("nowhere").outline()


@pytest.mark.parametrize("spoil", ["open to others", "no JSON", "cut"])
def test_an_outline_that_cannot_be_trusted_is_not_used(spoil: str, tmp_path: Path) -> None:
    outline(RobotTarget("panda_sim"))
    (cached,) = (tmp_path / "cache").rglob("*.json")
    if spoil == "open to others":
        cached.chmod(0o666)
    else:
        cached.write_text("[" if spoil == "no JSON" else "{}")
    assert isinstance(RobotTarget("panda_sim").outline(), Profile)


def test_a_cache_that_cannot_be_written_is_no_hindrance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert isinstance(RobotTarget("panda_sim").outline(), Profile)


def test_the_cache_does_not_grow(tmp_path: Path) -> None:
    for port in range(1, 70):
        RobotTarget("panda_sim", [f"tcp/127.0.0.1:{port}"]).outline()
    assert len(list((tmp_path / "cache").rglob("*.json"))) <= 64
    assert sys.version in next((tmp_path / "cache").rglob("*.json")).read_text()
