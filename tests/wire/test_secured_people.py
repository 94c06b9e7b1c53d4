"""People with certificates: who drives by hand, who plays a recording, and who may do neither.

Everything on one computer, over TLS with access control; the desk, the wall and the player are
folders of certificates, as `vla-zenoh secure add` makes them. Each result is looked at from the
side of whoever tries, and from that of an operator at the robot.
"""

from __future__ import annotations

import json
import subprocess
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import zenoh
from camera_rig import await_match, until
from chain import READY_PATIENCE_S, Chain, command_line, running_chain, write_profile
from recording_rig import recording
from teleop_rig import Screen, teleop
from typer.testing import CliRunner
from vla_zenoh_rolling.settings_log import entries_of

from vla_zenoh.bus.session import open_session
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.profile import load_profile
from vla_zenoh.program.main import app

pytestmark = [pytest.mark.slow, pytest.mark.timeout(180)]

RISE_M = 0.03
ROBOT, HERE = "panda", "here"
GHOST = "ghost"
"""A robot of whom there are recordings alone."""
PLACES = {"desk": "operator", "wall": "viewer", "player": "replay"}
MARK = b"not mine to say"


@dataclass
class Lab:
    """Profiles of its computers, and the robot at work."""

    chain: Chain
    folder: Path

    def profile(self, place: str) -> Path:
        return self.folder / f"{place}.yaml"

    def session(self, place: str, node: str | None = None) -> zenoh.Session:
        """What one who has the certificates of `place` can open."""
        return open_session(load_profile(str(self.profile(place))).session, identity=node)


def secure(*words: str) -> None:
    done = CliRunner().invoke(app, ["secure", *words])
    assert done.exit_code == 0, done.output


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("lab")
    plain, secured = write_profile(folder, name="plain"), folder / "lab.yaml"
    secure("init", "-p", str(plain), "-o", str(secured), "--folder", str(folder / "keys"))
    for place, role in PLACES.items():
        secure("add", place, "--role", role, "-p", str(secured))
    for place in (HERE, *PLACES):
        text = f"extends: lab\nsession: {{security: {{host: {place}}}}}\n"
        (folder / f"{place}.yaml").write_text(text)
    (folder / "ghost.yaml").write_text(f"extends: {HERE}\nrobot: {{name: {GHOST}}}\n")
    here, ghost = folder / f"{HERE}.yaml", folder / "ghost.yaml"
    also, rolling = [ghost], folder / "rolling"
    with running_chain(folder, profile_file=here, host=HERE, also=also, rolling=rolling) as chain:
        chain.activate_when_ready()
        yield Lab(chain, folder)


@pytest.fixture(scope="module")
def run_file(lab: Lab) -> Path:
    """An arm that an operator drives by hand, recorded."""
    chain, path = lab.chain, lab.folder / "by-hand.mcap"
    chain.settle()
    with (
        teleop(chain, profile=lab.profile("desk")) as screen,
        recording(chain, path),
    ):
        drive_by_hand(chain, screen)
    return path


@dataclass
class Heard:
    """What an operator hears of a robot: how much on which key, and the payloads with a mark."""

    session: zenoh.Session
    keys: Keys
    counts: Counter[str] = field(default_factory=Counter)
    marked: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._subscribers: list[Any] = []
        self.listen(*self.keys.without_raw_images)

    def listen(self, *keys: str) -> None:
        """To these as well."""
        handler = zenoh.handlers.Callback(self._take, indirect=False)
        self._subscribers += [self.session.declare_subscriber(key, handler) for key in keys]

    def _take(self, sample: zenoh.Sample) -> None:
        key = self.keys.short(str(sample.key_expr))
        self.counts[key] += 1
        if sample.payload.to_bytes() == MARK:
            self.marked.append(key)


def obeyed(chain: Chain) -> str:
    return chain.client.task.worker if chain.client.task is not None else ""


def drive_by_hand(chain: Chain, screen: Screen) -> None:
    """Takes the arm, goes up, stops it; all of it by keys."""
    screen.type(b"\t")
    chain.until("it is obeyed", lambda: obeyed(chain) == "teleop")
    until("the person sees it", lambda: b"follows you" in screen.shown)

    def active() -> bool:
        if chain.client.task is None or not chain.client.task.active:
            screen.type(b"\r")
            chain.client.wait_for(lambda: chain.state() == "active", 1.0)
        return chain.state() == "active"

    chain.until("an active arm", active, READY_PATIENCE_S)
    start_m = chain.reference_m()
    screen.hold(b"r", lambda: chain.reference_m()[2] > start_m[2] + RISE_M)
    chain.wait_still()
    screen.type(b"x")
    chain.until("stopped", lambda: chain.state() == "stopped")


def test_an_operator_takes_drives_and_stops_the_arm_by_keys(run_file: Path) -> None:
    entries = open_recording(run_file).entries()
    counts = Counter(Keys(ROBOT).short(entry.key) for entry in entries)
    assert counts["delta/teleop"] > 0
    assert counts["stop"] == 1
    assert {"state/pose", "command/pose", "camera/front/jpeg", "task"} <= counts.keys()


def test_the_worker_that_an_operator_is_says_its_own_deltas_and_nothing_else(lab: Lab) -> None:
    lab.chain.settle()
    keys = lab.chain.profile.keys
    others = (
        *(keys.prompt, keys.active, keys.worker, keys.rate, keys.stop, keys.reset, keys.task),
        *(keys.speed, keys.slower),
        *(keys.delta("scripted"), keys.spec("scripted"), keys.command_pose, keys.command_gripper),
        *(keys.state_pose, keys.camera_jpeg("front"), keys.status("command"), keys.sim_reset),
    )
    heard = Heard(lab.chain.session, keys)
    with lab.session("desk", "worker-teleop") as session:
        stolen = Heard(session, keys)
        await_match(session, keys.delta("teleop"))
        for key in (*others, keys.delta("teleop")):
            session.put(key, MARK, allowed_destination=zenoh.Locality.REMOTE)
        lab.chain.until("its own", lambda: "delta/teleop" in heard.marked)
        # Each key by its name as well: a wish for a whole group is refused as a whole.
        stolen.listen(keys.state_pose, keys.command_pose, keys.status("command"), keys.task)
        had = heard.counts.copy()
        lab.chain.until("states for it", lambda: stolen.counts["state/pose"] > 0)
        lab.chain.until(
            "news of the command node",
            lambda: heard.counts["status/command"] > had["status/command"],
        )
    assert heard.marked == ["delta/teleop"]
    # The status: a worker compares what it receives with what the senders say they sent.
    may = {"camera/front/jpeg", "state/pose", "status/command", "task"}
    assert stolen.counts.keys() <= may
    assert lab.chain.state() == "inactive"
    task = lab.chain.client.task
    assert task is not None
    assert (task.prompt, task.worker) == ("hold", "scripted")


def test_a_viewer_has_no_hands(lab: Lab) -> None:
    lab.chain.settle()
    screen = Screen(lab.profile("wall"))
    try:
        assert screen.process.wait(READY_PATIENCE_S) == 1
        until("it says why", lambda: b"worker-teleop.pem is not there" in screen.shown)
    finally:
        screen.close()
    assert "worker-teleop" not in lab.chain.client.alive
    assert lab.chain.state() == "inactive"


def replay(lab: Lab, file: Path, place: str, robot: str) -> subprocess.CompletedProcess[str]:
    words = ("replay", str(file), "--robot", robot, "--speed", "4", "--json")
    return command_line(*words, profile=lab.profile(place), timeout_s=READY_PATIENCE_S)


def test_a_player_puts_every_sample_of_a_recording_on_the_keys_of_a_robot_that_is_not_there(
    lab: Lab, run_file: Path
) -> None:
    ghost = Keys(GHOST)
    heard = Heard(lab.chain.session, ghost)
    done = replay(lab, run_file, "player", GHOST)
    assert done.returncode == 0, done.stderr
    said = {ghost.short(key): count for key, count in json.loads(done.stdout)["samples"].items()}
    assert {
        "state/pose",
        "command/pose",
        "delta/teleop",
        "camera/front/jpeg",
        "stop",
    } <= said.keys()
    until("all of it is heard", lambda: all(heard.counts[key] >= said[key] for key in said))
    own = {"status/replay", "event/replay"}
    assert {key: count for key, count in heard.counts.items() if key not in own} == said


def test_a_player_is_refused_where_the_robot_lives(lab: Lab, run_file: Path) -> None:
    lab.chain.settle()
    done = replay(lab, run_file, "player", ROBOT)
    assert done.returncode == 1
    assert f"robot '{ROBOT}' is alive" in done.stderr
    assert "replay" not in lab.chain.client.snapshot()
    assert lab.chain.state() == "inactive"


@pytest.mark.parametrize("place", ["desk", "wall"])
def test_who_has_not_the_role_is_told_and_nothing_is_heard_of_him(
    lab: Lab, run_file: Path, place: str
) -> None:
    heard = Heard(lab.chain.session, Keys(GHOST))
    done = replay(lab, run_file, place, GHOST)
    assert done.returncode == 1
    assert f"the certificate of this computer has the role {PLACES[place]}" in done.stderr
    assert heard.counts == {}


def test_a_player_reads_nothing_and_an_operator_plays_no_robot(lab: Lab) -> None:
    ghost, panda = Keys(GHOST), lab.chain.profile.keys
    heard = Heard(lab.chain.session, ghost)
    with lab.session("player") as player, lab.session("desk") as operator:
        curious, looking = Heard(player, panda), Heard(operator, panda)
        until("the operator sees the robot", lambda: looking.counts["state/pose"] > 0)
        await_match(operator, ghost.prompt)
        for key in (ghost.state_pose, ghost.command_pose, ghost.delta("scripted"), ghost.task):
            operator.put(key, MARK)
        operator.put(ghost.prompt, MARK)
        until("what an operator may say", lambda: heard.marked)
        player.put(ghost.state_pose, MARK)
        until("what a player may say", lambda: len(heard.marked) > 1)
        assert curious.counts == {}
    assert heard.marked == ["prompt", "state/pose"]


def test_a_router_at_work_is_not_told_of_more_robots(lab: Lab) -> None:
    another = lab.folder / "another.yaml"
    another.write_text(f"extends: {HERE}\nrobot: {{name: another}}\n")
    words = ("up", str(another), "--host", HERE, "--also", str(lab.profile("ghost")))
    done = command_line(*words, profile=another, timeout_s=READY_PATIENCE_S)
    assert done.returncode == 1
    assert "cannot serve other robots" in done.stderr
    assert "sim" in lab.chain.client.alive


def test_the_log_of_a_lab_names_the_certificate_of_who_put_a_setting(lab: Lab) -> None:
    rolling, prompt = lab.folder / "rolling", "HARD: hold"
    done = command_line("prompt", prompt, profile=lab.profile("desk"))
    assert done.returncode == 0, done.stderr

    def facts(what: str) -> list[dict[str, Any]]:
        return [each for each in entries_of(rolling) if each["what"] == what]

    def author() -> str:
        (put,) = [each for each in facts("put") if each["text"] == prompt]
        names = {each["client"]: each["certificate"] for each in facts("client")}
        return names.get(put["client"], "")

    until("it is logged", lambda: prompt in [each["text"] for each in facts("put")])
    until("its author is known", author)
    assert author() == "operator@desk"
    done = command_line("save", "by the desk", profile=lab.profile("desk"))
    assert done.returncode == 0, done.stderr
    done = command_line("save", "by the wall", profile=lab.profile("wall"))
    assert done.returncode == 1
    assert not list((rolling / "saved").glob("*by-the-wall"))
