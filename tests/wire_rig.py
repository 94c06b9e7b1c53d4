"""Clients of the wire that are not ours, run in the real chain or beside a router alone."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from camera_rig import free_endpoint, until
from chain import COMMAND_HZ, LONG_PATIENCE_S, READY_PATIENCE_S, STATE_HZ, Chain
from typed import typed

from vla_zenoh.bus.session import alive_nodes, open_session
from vla_zenoh.profile import Profile, load_profile

CLIENTS = Path(__file__).parents[1] / "examples" / "wire"
ALONE = "import sys; sys.modules['vla_zenoh'] = None"
"""Runs before each client in Python: importing our package is an error there."""
UP_STEPS, UP_M, EXACT_M = 10, 0.1, 1e-3
PROFILE = """\
extends: {extends}
session: {{listen: [{endpoint}], connect: [{endpoint}], lease_ms: 4000}}
timing:
  command_timeout_s: {command}
  state_timeout_s: {state}
  command_hz: {command_hz}
  state_hz: {state_hz}
{more}"""


def profile_of(folder: Path, extends: str, more: str = "") -> Path:
    path = folder / "wire.yaml"
    endpoint = free_endpoint()
    path.write_text(
        PROFILE.format(
            extends=extends,
            endpoint=endpoint,
            more=more,
            command_hz=COMMAND_HZ,
            state_hz=STATE_HZ,
            **LONG_PATIENCE_S,
        )
    )
    return path


def arguments_of(profile: Profile, *more: str) -> tuple[str, ...]:
    """What each client takes: router, robot, and its own."""
    (endpoint,) = profile.session.connect
    return (endpoint, f"{profile.root}/{profile.robot.name}", *more)


def in_python(profile: Profile, name: str, *arguments: str, before: str = "") -> list[str]:
    """Words that start a client in Python; `before` runs first."""
    lines = [
        ALONE,
        f"sys.path.insert(0, {str(CLIENTS)!r})",
        before,
        f"import {name.removesuffix('.py')} as client",
        f"client.main({', '.join(map(repr, arguments_of(profile, *arguments)))})",
    ]
    return [sys.executable, "-u", "-c", "\n".join(lines)]


@contextmanager
def running(words: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
    """A process, killed in the end."""
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def moves_exactly_stops_and_is_reset(chain: Chain) -> None:
    """The command node with a robot of others, whose node is "arm"."""
    chain.activate_when_ready()
    chain.client.set_prompt("hold")
    chain.wait_still()
    before_m = chain.height_m()
    prompt = f"HARD: go up x{UP_STEPS}"
    chain.client.set_prompt(prompt)
    chain.until(
        "it is up", lambda: chain.detail("policy_done") and chain.detail("prompt") == prompt
    )
    chain.wait_still()
    assert chain.height_m() - before_m == pytest.approx(UP_M, abs=EXACT_M)
    chain.client.set_prompt("HARD: go down")
    chain.until("it moves", chain.moves)
    chain.client.stop()
    chain.until("it is stopped", lambda: chain.state() == "stopped")
    chain.until("the robot says so", lambda: chain.state("arm") == "latched")
    chain.client.reset()
    chain.until(
        "it is reset", lambda: chain.state() == "inactive" and chain.state("arm") == "running"
    )
    chain.activate_when_ready()


@contextmanager
def alone(profile_file: Path, *words: str) -> Iterator[None]:
    """A router and a client, and nothing else."""
    session = load_profile(str(profile_file)).session
    with (
        open_session(session, mode="router"),
        subprocess.Popen(words, stdout=subprocess.DEVNULL) as process,
    ):
        try:
            yield
        finally:
            process.terminate()


def conform(
    capsys: pytest.CaptureFixture[str], profile_file: Path, node: str, *words: str
) -> tuple[int, dict[str, bool | None], str]:
    """Exit status, rules, and what was told by `vla-zenoh conform` of a node, once it is there."""

    def there() -> bool:
        profile = load_profile(str(profile_file))
        with open_session(profile.session) as session:
            return node in alive_nodes(session, profile.keys, node)

    until(f"{node} is there", there, READY_PATIENCE_S)
    done = typed(capsys, "conform", *words, "--json", "--profile", str(profile_file))
    assert done.stdout, done.stderr
    found = {each["rule"]: each["right"] for each in json.loads(done.stdout)}
    return done.code, found, done.stdout + done.stderr
