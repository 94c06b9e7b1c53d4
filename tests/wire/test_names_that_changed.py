"""Certificates that are revoked, people who leave and robots that are renamed, while a router runs.

``vla-zenoh node router`` is a process, and so is each command; whoever has a certificate is a real
session with it, over TLS.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import zenoh
from camera_rig import free_endpoint, until
from chain import READY_PATIENCE_S, command_line

from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import SessionError
from vla_zenoh.keys import Keys
from vla_zenoh.profile import load_profile
from vla_zenoh.security.names import NAMES, read_names

pytestmark = [pytest.mark.slow, pytest.mark.timeout(180)]

MINUTE_S = 60.0
PERIOD_S, SOON_S = 0.02, 1.0
HERE, ROBOT, OTHER = "here", "panda", "ghost"


@dataclass
class Person:
    """A session that says one key and counts what it hears on all of them."""

    session: zenoh.Session
    heard: Counter[str] = field(default_factory=Counter)
    _subscribers: list[object] = field(default_factory=list)

    def listen(self, *keys: str) -> None:
        handler = zenoh.handlers.Callback(self._take, indirect=False)
        self._subscribers += [self.session.declare_subscriber(key, handler) for key in keys]

    def _take(self, sample: zenoh.Sample) -> None:
        self.heard[str(sample.key_expr)] += 1

    def hears(self, key: str, said_by: Callable[[], object]) -> bool:
        """Whether `key` is heard within a moment, while `said_by` says it."""
        before, end_s = self.heard[key], time.monotonic() + SOON_S
        while time.monotonic() < end_s:
            said_by()
            time.sleep(PERIOD_S)
            if self.heard[key] > before:
                return True
        return False


@dataclass
class Lab:
    """A secured profile, made of `plain`; what runs of it, and the folder of its authority."""

    folder: Path
    plain: str
    held: ExitStack

    def __post_init__(self) -> None:
        plain = self.folder / "plain.yaml"
        plain.write_text(self.plain)
        words = ("-o", str(self.file), "--folder", str(self.keys), "-p", str(plain))
        done = command_line("secure", "init", *words)
        assert done.returncode == 0, done.stderr

    @property
    def file(self) -> Path:
        return self.folder / "lab.yaml"

    @property
    def keys(self) -> Path:
        return self.folder / "keys"

    def secure(self, *words: str) -> dict[str, Any]:
        done = command_line("secure", *words, "--json", profile=self.file)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    def person(self, host: str, node: str | None = None, folder: Path | None = None) -> Person:
        """Whoever has the certificates of `host`, or of the same in another `folder`."""
        text = f"{{host: {host}, folder: {folder or self.keys}}}"
        own = self.folder / f"{host}-{node}.yaml"
        own.write_text(f"extends: {self.file.stem}\nsession: {{security: {text}}}\n")
        session = open_session(load_profile(str(own)).session, identity=node, wait_s=SOON_S)
        return Person(self.held.enter_context(session))

    def router(self, host: str, *more: str) -> None:
        """Start the router of a host, and wait until it serves an operator."""
        words = (sys.executable, "-m", "vla_zenoh", "node", "router", "--profile", str(self.file))
        process = subprocess.Popen(
            [*words, "--host", host, *more], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self.held.callback(process.wait, READY_PATIENCE_S)
        self.held.callback(process.terminate)

        def answers() -> bool:
            try:
                self.person(host)
            except SessionError:
                return False
            return True

        until("the router", answers, READY_PATIENCE_S)

    def steal(self, host: str) -> Path:
        """A copy of the certificates of `host`, in the hands of a thief."""
        folder = self.folder / "stolen"
        shutil.copytree(self.keys / host, folder / host)
        return folder


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    """A router that serves two robots, and two operators' computers."""
    with ExitStack() as held:
        made = Lab(tmp_path, one_router(), held)
        made.secure("add", "desk", "--role", "operator")
        made.secure("add", "guest", "--role", "operator")
        other = tmp_path / "other.yaml"
        other.write_text(f"extends: lab\nrobot: {{name: {OTHER}}}\n")
        made.router(HERE, "--also", str(other))
        yield made


def one_router() -> str:
    endpoint = free_endpoint()
    return f"extends: panda_sim\nsession: {{listen: [{endpoint}], connect: [{endpoint}]}}\n"


def two_routers() -> str:
    first, second = free_endpoint(), free_endpoint()
    return (
        "extends: panda_sim\n"
        f"session: {{listen: [{first}], connect: [{first}, {second}]}}\n"
        "hosts:\n"
        f"  here: {{nodes: [router, sim, camera, command, worker], connect: [{first}]}}\n"
        f"  spare: {{nodes: [router], listen: [{second}], link: [{first}], connect: [{second}]}}\n"
    )


def prompt(person: Person, robot: str = ROBOT) -> Callable[[], object]:
    return lambda: person.session.put(Keys(robot).prompt, "HARD: go up")


def test_a_stolen_certificate_is_out_within_a_minute_and_everybody_else_keeps_working(
    lab: Lab,
) -> None:
    key = Keys(ROBOT).prompt
    stolen = lab.steal("desk")
    command, desk = lab.person(HERE, "command"), lab.person("desk")
    thief = lab.person("desk", folder=stolen)
    for each in (command, thief, desk):
        each.listen(key)
    assert command.hears(key, prompt(thief))
    assert thief.hears(key, prompt(lab.person("guest")))

    began_s = time.monotonic()
    answer = lab.secure("revoke", "desk")
    took_s = time.monotonic() - began_s
    in_force = answer["in_force_after_s"]
    print(f"revoked in {took_s:.2f} s, {in_force}")
    assert answer["denied"] == ["operator@desk", "worker-teleop@desk"]
    assert list(in_force) == ["router"]
    assert took_s < MINUTE_S

    assert not command.hears(key, prompt(thief))
    again = lab.person("desk", folder=stolen)
    again.listen(key)
    assert not command.hears(key, prompt(again))
    # The host that stays has its new certificates, and others never lost theirs.
    renewed, guest = lab.person("desk"), lab.person("guest")
    assert command.hears(key, prompt(renewed))
    assert command.hears(key, prompt(guest))
    # A program that ran there found the new files when it connected again.
    assert desk.hears(key, prompt(guest))
    heard = thief.heard[key], again.heard[key]
    assert command.hears(key, prompt(guest))
    assert (thief.heard[key], again.heard[key]) == heard


def test_a_person_who_leaves_is_out_within_a_minute(lab: Lab) -> None:
    key = Keys(ROBOT).prompt
    stolen = lab.steal("guest")
    command, guest = lab.person(HERE, "command"), lab.person("guest")
    command.listen(key)
    assert command.hears(key, prompt(guest))
    began_s = time.monotonic()
    answer = lab.secure("retire", "guest")
    assert time.monotonic() - began_s < MINUTE_S
    assert "router" in answer["in_force_after_s"]
    assert not command.hears(key, prompt(guest))
    assert not command.hears(key, prompt(lab.person("guest", folder=stolen)))
    assert command.hears(key, prompt(lab.person("desk")))
    security = load_profile(str(lab.file)).session.security
    assert security is not None
    assert security.people == {"desk": "operator"}
    assert not (lab.keys / "guest").exists()
    # Who comes back gets a name that the old key does not have.
    lab.secure("add", "guest", "--role", "operator")
    assert command.hears(key, prompt(lab.person("guest")))
    assert not command.hears(key, prompt(lab.person("guest", folder=stolen)))


def test_a_robot_that_is_renamed_has_its_rights_on_the_new_keys_alone(lab: Lab) -> None:
    old, new = Keys(ROBOT), Keys("left")
    desk, sim = lab.person("desk"), lab.person(HERE, "sim")
    desk.listen(old.state_pose, new.state_pose, Keys(OTHER).state_pose)
    assert desk.hears(old.state_pose, lambda: sim.session.put(old.state_pose, b""))
    assert not desk.hears(new.state_pose, lambda: sim.session.put(new.state_pose, b""))
    answer = lab.secure("rename", ROBOT, "left")
    assert answer["in_force_after_s"]["router"] < MINUTE_S
    assert load_profile(str(lab.file)).robot.name == "left"
    assert desk.hears(new.state_pose, lambda: sim.session.put(new.state_pose, b""))
    assert not desk.hears(old.state_pose, lambda: sim.session.put(old.state_pose, b""))
    other = Keys(OTHER).state_pose
    assert desk.hears(other, lambda: sim.session.put(other, b""))


def test_a_robot_that_is_retired_has_no_key_left_and_the_other_keeps_its_own(lab: Lab) -> None:
    gone, other = Keys(ROBOT), Keys(OTHER)
    desk, sim = lab.person("desk"), lab.person(HERE, "sim")
    desk.listen(gone.state_pose, other.state_pose)
    assert desk.hears(gone.state_pose, lambda: sim.session.put(gone.state_pose, b""))
    lab.secure("retire", "--robot", ROBOT)
    until(
        "nothing of it is heard",
        lambda: not desk.hears(gone.state_pose, lambda: sim.session.put(gone.state_pose, b"")),
        MINUTE_S,
    )
    assert desk.hears(other.state_pose, lambda: sim.session.put(other.state_pose, b""))


def test_a_file_of_names_that_is_half_copied_changes_nothing(lab: Lab) -> None:
    key = Keys(ROBOT).prompt
    command, desk = lab.person(HERE, "command"), lab.person("desk")
    command.listen(key)
    (lab.keys / HERE / NAMES).write_text('{"revision": 1, "gener')
    assert command.hears(key, prompt(desk))
    assert lab.secure("revoke", "desk")["in_force_after_s"]["router"] < MINUTE_S
    assert read_names(lab.keys / HERE).generations == {"desk": 2}


def test_two_routers_that_are_linked_both_say_that_a_name_is_denied(tmp_path: Path) -> None:
    with ExitStack() as held:
        lab = Lab(tmp_path, two_routers(), held)
        lab.secure("add", "desk", "--role", "operator")
        lab.router(HERE)
        lab.router("spare")
        for _ in range(5):  # where both opened anew at once one in four was never confirmed
            took_s = lab.secure("revoke", "desk")["in_force_after_s"]
            assert took_s.keys() == {"router-here", "router-spare"}
            assert max(took_s.values()) < MINUTE_S
            print(took_s)


def test_a_router_that_does_not_run_is_told_of_and_reads_the_names_when_it_starts(
    tmp_path: Path,
) -> None:
    with ExitStack() as held:
        lab = Lab(tmp_path, one_router(), held)
        done = command_line("secure", "revoke", HERE, "--wait", "0.5", profile=lab.file)
        assert done.returncode == 4
        assert "NOT CONFIRMED in 0.5 s by router: no Zenoh router answers" in done.stderr
        assert "can still pose as it" in done.stderr
        shown = command_line("node", "router", "--config", profile=lab.file)
        subjects = json.loads(shown.stdout)["access_control"]["subjects"]
        names = [each["cert_common_names"] for each in subjects]
        assert ["sim@here+2"] in names
        assert ["sim@here"] not in names
