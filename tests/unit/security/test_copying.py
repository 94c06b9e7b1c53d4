"""What `vla-zenoh secure` says has to be typed, typed: the lab on another computer's disk.

Programs in place of ssh and scp copy between folders, each the home of one computer.
"""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner
from vla_zenoh_secure.cli import is_own

from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.program.main import app
from vla_zenoh.security.store import THIS_HOST, Store, operator_hosts

PATIENCE_S = 30.0
TYPED = "  "
"""Stands before what is to be typed."""
SSH = """\
#!/bin/sh
host="$1"; shift
cd "$HOMES/$host" && HOME="$HOMES/$host" exec sh -c "$*"
"""
SCP = """\
#!/bin/sh
while [ "${1#-}" != "$1" ]; do shift; done
for last; do :; done
host="${last%%:*}"; path="${last#*:}"
while [ $# -gt 1 ]; do cp -rp "$1" "$HOMES/$host/$path" || exit 1; shift; done
"""
ARM_FILE = "class Arm: ...\n"
LAB = """\
extends: panda_sim_two_hosts
arm: {file: my_arm.py}
"""
URDF = '<robot name="arm"/>'
WHOLE = """\
extends: panda_sim_two_hosts
robot: {description: arm/arm.urdf}
models: {nod: ../../nod.py}
workers: [scripted, nod]
hosts:
  robot: {nodes: [router, command]}
  gpu: {nodes: [worker]}
"""


@dataclass(frozen=True)
class World:
    """Homes of computers, and the folder where people type."""

    homes: Path
    here: Path

    def home(self, host: str) -> Path:
        return self.homes / host

    def secure(self, *words: str) -> str:
        done = CliRunner().invoke(app, ["secure", *words])
        assert done.exit_code == 0, done.output + repr(done.exception)
        return done.output

    def type(self, said: str) -> None:
        """Types what is to be typed, in the folder where it was said."""
        lines = [line for line in said.splitlines() if line.startswith(TYPED)]
        assert lines
        subprocess.run(
            ["sh", "-ec", "\n".join(lines)],
            cwd=self.here,
            env={**os.environ, "HOMES": str(self.homes)},
            check=True,
            timeout=PATIENCE_S,
        )

    def at(self, host: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """Go to another computer, where nothing of this one is."""
        self.here.rename(self.here.with_name("gone"))
        monkeypatch.setenv("HOME", str(self.home(host)))
        monkeypatch.chdir(self.home(host))


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> World:
    made = World(tmp_path / "homes", tmp_path / "here")
    tools = tmp_path / "tools"
    for folder in (tools, *(made.home(host) for host in ("me", "robot", "gpu", "desk"))):
        folder.mkdir(parents=True)
    for name, text in (("ssh", SSH), ("scp", SCP)):
        (tools / name).write_text(text)
        (tools / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    monkeypatch.setenv("HOME", str(made.home("me")))
    made.here.mkdir()
    monkeypatch.chdir(made.here)
    return made


def write(path: Path, text: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def same_but_for_places(one: Profile, other: Profile) -> bool:
    """Whether two profiles say the same, wherever their files are."""
    places = {"arm": True, "robot": {"description"}}
    return one.model_dump(exclude=places) == other.model_dump(exclude=places)


def test_a_chain_of_profiles_with_an_arm_of_ones_own_loads_on_the_other_computer(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(world.here / "my_arm.py", ARM_FILE)
    write(world.here / "base.yaml", LAB)
    write(world.here / "mine.yaml", "extends: base\nabout: mine\n")
    write(world.here / "two.yaml", "extends: mine.yaml\nabout: two\n")
    said = world.secure("init", "-p", "two.yaml", "--at", "robot=192.0.2.1", "--host", "robot")
    world.type(said)
    assert "There: vla-zenoh up ./two_secure.yaml --host NAME" in said
    assert not (world.home("robot") / "two_secure.yaml").exists()  # is this computer
    before = load_profile("two_secure.yaml")
    world.at("gpu", monkeypatch)
    after = load_profile("./two_secure.yaml")
    assert same_but_for_places(before, after)
    assert after.arm is not None
    assert Path(after.arm.file) == world.home("gpu") / "my_arm.py"
    assert Path(after.arm.file).read_text() == ARM_FILE
    assert after.session.security is not None
    store = Store(after.session.security.folder)
    assert store.hosts() == ["gpu"]
    assert store.this_host(None) == "gpu"
    assert store.identity_files(None, "worker-scripted").certificate.is_file()
    assert not list(world.home("gpu").rglob(THIS_HOST))
    assert not list(world.home("gpu").rglob("ca.key"))


def test_files_that_are_not_beside_the_profile_are_named(world: World, tmp_path: Path) -> None:
    lab = world.here / "lab"
    write(lab / "arm/arm.urdf", URDF)
    write(lab / "base.yaml", WHOLE)
    write(tmp_path / "nod.py", "class Nod: ...\n")
    said = world.secure("init", "--profile", "lab/base.yaml")
    assert "  scp base_secure.yaml gpu:" in said
    for file in (lab / "base.yaml", lab / "arm/arm.urdf", tmp_path / "nod.py"):
        assert f"Copy this file as well, to the same place: {file}" in said


def test_a_computer_that_is_added_gets_the_whole_profile_and_so_does_the_router(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(world.here / "mine.yaml", "extends: panda_sim_two_hosts\nabout: mine\n")
    world.type(world.secure("init", "-p", "mine.yaml", "--at", "robot=192.0.2.1"))
    said = world.secure("add", "desk", "--role", "operator", "-p", "mine_secure.yaml")
    world.type(said)
    assert "Is desk this computer? Then instead: vla-zenoh secure here desk" in said
    text = (world.here / "mine_secure.yaml").read_text()
    assert (world.home("robot") / "mine_secure.yaml").read_text() == text
    assert (world.home("gpu") / "mine_secure.yaml").read_text() != text
    world.at("desk", monkeypatch)
    after = load_profile("./mine_secure.yaml")
    assert after.about == "mine, with certificates"
    assert operator_hosts(after) == ["desk"]


def test_the_computer_of_init_notes_which_host_it_is_where_that_can_be_known(
    world: World,
) -> None:
    secured = "panda_sim_two_hosts_secure.yaml"
    said = world.secure("init", "-p", "panda_sim_two_hosts", "--at", "robot=127.0.0.1")
    assert f"This computer is robot: vla-zenoh up ./{secured} --host robot" in said
    assert "ssh robot" not in said
    assert f"To watch, here: vla-zenoh status --profile ./{secured}" in said
    store = Store("~/.config/vla-zenoh/lab")
    assert store.known_host() == "robot"
    said = world.secure("add", "desk", "--role", "operator", "-p", secured)
    assert store.known_host() == "robot"
    assert "secure here" not in said


def test_where_it_is_not_known_people_drive_all_the_same_until_it_is_said(world: World) -> None:
    said = world.secure("init", "-p", "panda_sim", "--at", "here=192.0.2.1", "-o", "one.yaml")
    assert "ssh here" in said  # the only host, and at another address
    (world.home("me") / ".config").rename(world.home("me") / "first")
    said = world.secure("init", "-p", "panda_sim_two_hosts", "--at", "robot=192.0.2.1")
    assert "ssh robot" in said
    assert "`vla-zenoh secure here HOST` notes which" in said
    profile = load_profile("panda_sim_two_hosts_secure.yaml")
    assert operator_hosts(profile) == ["robot", "gpu"]
    world.secure("here", "gpu", "-p", "panda_sim_two_hosts_secure.yaml")
    assert operator_hosts(profile) == ["gpu", "robot"]
    assert "this computer is gpu" in world.secure("show", "-p", "panda_sim_two_hosts_secure.yaml")


def test_only_a_host_whose_certificates_are_here_can_be_this_computer(world: World) -> None:
    runner = CliRunner()
    done = runner.invoke(app, ["secure", "init", "-p", "panda_sim_two_hosts", "--host", "desk"])
    assert done.exit_code == 2
    assert not list(world.here.iterdir())
    world.secure("init", "-p", "panda_sim_two_hosts")
    done = runner.invoke(app, ["secure", "here", "desk", "-p", "panda_sim_two_hosts_secure.yaml"])
    assert done.exit_code == 1


def test_an_address_is_this_computers_or_it_is_not() -> None:
    assert is_own("127.0.0.1")
    assert is_own("localhost")
    assert not is_own("192.0.2.1")  # RFC 5737: nobody's
    assert not is_own("0.0.0.0")
    assert not is_own("no such name")
