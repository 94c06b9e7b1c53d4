"""In a secured lab with two robots: who is stopped, by whose certificate, and what is said of it.

A router with the rules of both robots, their command nodes, and the commands of people; every
certificate lies in one folder, as on the computer of `vla-zenoh secure init`.
"""

from __future__ import annotations

import re
import shlex
import shutil
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from camera_rig import free_endpoint, until
from typer.testing import CliRunner, Result
from vla_zenoh_secure.lab_certificates import LabCertificates

from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.node import Publisher
from vla_zenoh.bus.session import Kind, open_session
from vla_zenoh.client.client import Client
from vla_zenoh.nodes.command.node import CommandNode
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.program.main import app
from vla_zenoh.runtime.router import run_router
from vla_zenoh.types import JointState

pytestmark = [pytest.mark.slow, pytest.mark.timeout(120)]

PATIENCE_S = 10.0
NOT_CONFIRMED = 4
STATES_S = 0.05
"""Between two states of arms that stand."""
PLAIN = """\
extends: panda_sim
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
hosts:
  robot: {{nodes: [router, command]}}
  gpu: {{nodes: [sim, camera, worker]}}
"""


@dataclass(frozen=True)
class Lab:
    """Two robots at work; `desk` may drive the first one alone.

    Args:
        folder: of the certificates, and of the profiles beside it.
        clients: one that hears each robot.
    """

    folder: Path
    clients: dict[str, Client]

    @property
    def profile(self) -> Path:
        return self.folder.parent / "lab.yaml"

    def type(self, *words: str) -> Result:
        return CliRunner().invoke(app, list(words), env={"COLUMNS": "300", "NO_COLOR": "1"})

    def at(self, command: str, *words: str) -> Result:
        return self.type(command, "--profile", str(self.profile), *words)

    def stopped(self) -> list[str]:
        """The robots that say so."""
        found = {name: client.status("command") for name, client in self.clients.items()}
        return [name for name, status in found.items() if status and status.state == "stopped"]

    def go_on(self) -> None:
        for client in self.clients.values():
            client.publish(client.keys.reset, "")
        until("nobody is stopped", lambda: not self.stopped(), PATIENCE_S)

    @contextmanager
    def only(self, *hosts: str) -> Iterator[LabCertificates]:
        """The certificates of these alone are here; the router and the nodes have theirs open."""
        store, away = LabCertificates(self.folder), self.folder.with_name("away")
        away.mkdir()
        gone = [host for host in store.hosts() if host not in hosts]
        for host in gone:
            (self.folder / host).rename(away / host)
        try:
            yield store
        finally:
            for host in gone:
                (away / host).rename(self.folder / host)
            away.rmdir()


def secure(*words: str) -> None:
    done = CliRunner().invoke(app, ["secure", *words])
    assert done.exit_code == 0, done.output


def at(profile: Profile, host: str) -> Profile:
    return override(profile, {"session": {"security": {"host": host}}})


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("lab")
    plain, one, two = (folder / f"{name}.yaml" for name in ("plain", "lab", "ur"))
    plain.write_text(PLAIN.format(endpoint=free_endpoint()))
    keys = folder / "keys"
    secure("init", "-p", str(plain), "-o", str(one), "--folder", str(keys))
    shutil.copy(one, two)
    two.write_text(f"{two.read_text()}robot: {{name: ur}}\n")
    secure("add", "desk", "--role", "operator", "-p", str(one))
    profiles = [at(load_profile(str(path)), "robot") for path in (one, two)]
    stop, threads = threading.Event(), []

    def begin(run, *arguments) -> None:  # pyright: ignore
        threads.append(threading.Thread(target=run, args=arguments))
        threads[-1].start()

    def command(profile: Profile) -> None:
        with open_session(profile.session, identity="command", wait_s=PATIENCE_S) as session:
            CommandNode(profile, session).run(stop)

    def standing_arm(profile: Profile) -> None:
        zeros = np.zeros(len(profile.robot.arm_joints))
        state = JointState(profile.robot.arm_joints, zeros, zeros, None)
        with open_session(profile.session, identity="sim", wait_s=PATIENCE_S) as session:
            stream = Publisher(session, profile.keys.state_joint, Kind.STATE, "sim#1", Clock())
            while not stop.wait(STATES_S):
                stream.publish(state)

    def router() -> None:
        run_router(profiles[0], stop, host="robot", also=profiles[1:])

    begin(router)
    for profile in profiles:
        begin(command, profile)
        begin(standing_arm, at(profile, "gpu"))
    try:
        with ExitStack() as stack:
            clients = {}
            for profile in profiles:
                session = stack.enter_context(open_session(profile.session, wait_s=PATIENCE_S))
                clients[profile.robot.name] = Client(profile, session).subscribe()
            for name, client in clients.items():
                until(f"{name} lives", lambda client=client: client.status("command"), PATIENCE_S)
            yield Lab(keys, clients)
    finally:
        stop.set()
        for thread in threads:
            thread.join(PATIENCE_S)
    assert not any(thread.is_alive() for thread in threads)


@pytest.fixture(autouse=True)
def at_work(lab: Lab) -> None:
    """Nobody is stopped, and nobody said which host this computer is."""
    lab.go_on()
    (lab.folder / ".this_host").unlink(missing_ok=True)


def test_a_stop_where_the_certificates_of_all_hosts_lie_stops_the_robot(lab: Lab) -> None:
    done = lab.at("stop")
    assert done.exit_code == 0, done.stderr
    assert lab.stopped() == ["panda"]
    how = f"vla-zenoh reset --profile {lab.profile}"
    assert f"CONFIRMED: robot panda (profile {lab.profile}) is stopped" in done.stdout
    assert f"`{how}` clears it" in done.stdout
    done = lab.type(*shlex.split(how)[1:])
    assert done.exit_code == 0, done.stderr
    assert "reset; inactive: robot panda" in done.stdout
    assert lab.stopped() == []


def test_a_computer_of_viewers_stops_with_the_certificate_of_an_operator_that_lies_there(
    lab: Lab,
) -> None:
    LabCertificates(lab.folder).remember_host("gpu")
    done = lab.at("stop")
    assert done.exit_code == 0, done.stderr
    assert lab.stopped() == ["panda"]
    # What is no stop is done by who people here are, and what would help is what is said.
    done = lab.at("reset")
    assert done.exit_code == 1
    assert lab.stopped() == ["panda"]
    found = re.search(
        r"certificate of this computer is viewer@gpu, .* `(vla-zenoh reset [^`]*)`",
        str(done.exception),
    )
    assert found is not None, str(done.exception)
    assert lab.type(*shlex.split(found[1])[1:]).exit_code == 0
    assert lab.stopped() == []


def test_a_stop_goes_on_to_the_next_certificate_where_one_is_of_no_use(lab: Lab) -> None:
    LabCertificates(lab.folder).remember_host("desk")
    key = lab.folder / "desk/operator.key"
    key.chmod(0o644)
    try:
        done = lab.at("stop")
    finally:
        key.chmod(0o600)
    assert done.exit_code == 0, done.stderr
    assert lab.stopped() == ["panda"]
    assert "chmod 600" in done.stderr
    assert "not with the certificate of desk" in done.stderr


def test_who_may_only_look_is_told_that_nothing_was_stopped(lab: Lab) -> None:
    with lab.only("gpu"):
        done = lab.at("stop")
    assert done.exit_code == NOT_CONFIRMED
    assert lab.stopped() == []
    assert "the certificate of this computer is viewer@gpu" in done.stdout
    assert (
        "`vla-zenoh secure add HOST --role operator` makes an operator certificate" in done.stdout
    )


def test_where_nobody_obeys_the_robots_that_are_there_are_told_with_what_to_type(lab: Lab) -> None:
    done = lab.at("stop", "--robot", "ghost")
    assert done.exit_code == NOT_CONFIRMED
    assert lab.stopped() == []
    why = f"NOT CONFIRMED: no answer of robot ghost (profile {lab.profile}): no node of it answers"
    assert why in done.stdout
    told = dict(re.findall(r"(\w+) \(`(vla-zenoh stop [^`]*)`\)", done.stdout))
    assert set(told) == {"panda", "ur"}
    every = re.search(r"`(vla-zenoh stop [^`]*--all[^`]*)` stops all", done.stdout)
    assert every is not None
    lab.type(*shlex.split(told["ur"])[1:])
    assert lab.stopped() == ["ur"]
    lab.type(*shlex.split(every[1])[1:])
    assert lab.stopped() == ["panda", "ur"]


@pytest.mark.parametrize("words", [("status", "--once"), ("activate",), ("use", "scripted")])
def test_other_commands_tell_it_as_well(lab: Lab, words: tuple[str, ...]) -> None:
    done = lab.at(words[0], *words[1:], "--robot", "ghost")
    assert done.exit_code == 1
    said = done.stderr + str(done.exception or "")
    assert "robot ghost" in said
    assert "Alive on this router: panda (`vla-zenoh" in said


def test_a_stop_names_the_robots_that_go_on_and_stop_all_stops_them(lab: Lab) -> None:
    done = lab.at("stop")
    found = re.search(r"not stopped: ur; `(vla-zenoh stop [^`]*--all[^`]*)`", done.stderr)
    assert found is not None, done.stderr
    done = lab.type(*shlex.split(found[1])[1:])
    assert done.exit_code == 0, done.stderr
    assert lab.stopped() == ["panda", "ur"]
    assert f"`vla-zenoh reset --profile {lab.profile} --robot ur` clears it" in done.stdout


def test_stop_all_stops_the_robots_one_may_stop_and_tells_of_no_others(lab: Lab) -> None:
    with lab.only("desk"):
        done = lab.at("stop", "--all")
    assert done.exit_code == 0, done.stderr
    assert lab.stopped() == ["panda"]
    assert "ur" not in re.findall(r"robot (\w+)", done.stdout)
