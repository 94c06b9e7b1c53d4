"""``vla-zenoh`` as a person types it, against a running robot."""

from __future__ import annotations

import json
from typing import Any

import pytest
from chain import COMMAND_HZ, LONG_PATIENCE_S, STATE_HZ, Chain, command_line
from typed import Typed, typed

from vla_zenoh.simulation.pace import control_steps

ROBOT_PATIENCE_S = LONG_PATIENCE_S
REFUSED = 1
AGAIN = 2
RATE_TOLERANCE = 0.25
CONTROL_HZ = 1000 / control_steps(max(COMMAND_HZ, STATE_HZ))
"""How often the simulated robot computes control, where the computer keeps up."""


class Person:
    """Whoever types commands: in this process, as each of its own would load everything anew."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def run(self, *words: str) -> Typed:
        return typed(self._capsys, *words)

    def ok(self, *words: str) -> str:
        """What it prints; asked again where a busy computer took longer than the program waits."""
        done = self.run(*words)
        for _ in range(AGAIN):
            if "did not accept this within" not in done.stderr:
                break
            done = self.run(*words)
        assert done.code == 0, done.stderr
        return done.stdout

    def json(self, *words: str) -> Any:
        return json.loads(self.ok(*words))


@pytest.fixture
def person(
    chain: Chain, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Person:
    monkeypatch.setenv("VLA_ZENOH_PROFILE", str(chain.profile_file))
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("TERM", "dumb")
    return Person(capsys)


def test_a_session_from_prompt_to_reset(chain: Chain, person: Person) -> None:
    chain.activate_when_ready()  # once, so that nothing is missing any more
    chain.settle()
    assert "prompt: 'HARD: go up' (worker scripted, 10 Hz)" in person.ok("prompt", "HARD: go up")
    refused = person.run("prompt", "dance")
    assert refused.code == REFUSED
    assert "prompt: 'dance' (worker scripted, 10 Hz), and the worker cannot" in refused.stderr
    assert "the scripted model does not know the prompt 'dance'" in refused.stderr
    person.ok("prompt", "HARD: go up")  # what was said of the prompt before is forgotten
    assert "rate: 5 Hz" in person.ok("rate", "5")
    assert "speed: 100 % of the planned speed" in person.ok("speed")
    assert "speed: 30 % of the planned speed" in person.ok("speed", "30 %")
    assert "speed 30 %" in person.ok("status", "--once")
    assert "speed: 80 % of the planned speed" in person.ok("speed", "80")
    assert "'fast' is not a percentage" in person.run("speed", "fast").stderr
    person.ok("speed", "100")

    refused = person.run("use", "scripter")
    assert refused.code == REFUSED
    assert "worker 'scripter' is not alive; did you mean 'scripted'?" in refused.stderr
    assert "Alive are: scripted" in refused.stderr
    chain.client.set_worker("nobody")
    refused = person.run("activate")
    assert refused.code == REFUSED
    assert "activate rejected:" in refused.stderr
    assert "- worker 'nobody' is not alive; alive are: scripted" in refused.stderr
    person.ok("use", "scripted")

    assert "SIM | active: worker scripted, prompt 'HARD: go up', 5 Hz" in person.ok("activate")
    assert "SIM | was active already: worker scripted" in person.ok("activate")
    chain.until("it moves", chain.moves)
    assert "inactive, the arm stands: robot panda" in person.ok("deactivate")
    assert not chain.moves()

    named = f"robot panda (profile {chain.profile_file})"
    how = f"`vla-zenoh reset --profile {chain.profile_file}` clears it"
    stop = command_line("stop", profile=chain.profile_file)  # sets the priority of its process
    assert stop.returncode == 0, stop.stderr
    said = stop.stdout
    assert f"CONFIRMED: {named} is stopped and stands, by " in said
    assert how in said
    refused = person.run("activate")
    assert refused.code == REFUSED
    assert (
        "the state is stopped (emergency stop); clear it with `vla-zenoh reset`" in refused.stderr
    )
    assert "reset; inactive" in person.ok("reset")


def test_status_as_json_tells_of_every_node(chain: Chain, person: Person) -> None:
    told = person.json("status", "--json")
    assert (told["robot"], told["mode"]) == ("panda", "sim")
    assert (told["limits"], told["hosts_down"]) == ([], {})
    found = told["nodes"]
    assert set(found) == {"router", "sim", "camera", "command", "worker-scripted"}
    pids = chain.host.supervisor.pids()
    for name, status in found.items():
        assert status["node"] == name
        assert status["alive"] is True
        assert status["why"] == ""
        assert status["pid"] == pids[name]
        assert 0 <= status["age_s"] < 1.5
    assert found["command"]["state"] == "inactive"
    assert found["command"]["detail"]["at_rest"] is True
    assert abs(found["sim"]["rates_hz"]["control"] / CONTROL_HZ - 1) < RATE_TOLERANCE
    assert found["sim"]["detail"]["lockstep"] is False


def test_status_for_people_names_every_node(person: Person) -> None:
    out = person.ok("status", "--once")
    for word in ("router", "sim", "camera", "command", "worker-scripted", "inactive", "inferring"):
        assert word in out


def test_keys_as_json_say_type_writer_and_rate(chain: Chain, person: Person) -> None:
    found = {entry["key"]: entry for entry in person.json("keys", "--json")}
    pose = found["vla/panda/state/pose"]
    assert pose["type"] == "application/msgpack"
    assert pose["writer"].startswith("sim#")
    assert abs(pose["rate_hz"] / chain.profile.timing.state_hz - 1) < RATE_TOLERANCE
    assert found["vla/panda/delta/scripted"]["writer"].startswith("worker-scripted#")
    assert "now 'hold'" in found["vla/panda/prompt"]["type"]
    assert "vla/panda/camera/front/raw" in found
    assert found["vla/panda/camera/front/jpeg"]["type"].startswith("image/jpeg")


def test_echo_decodes_what_is_written(person: Person) -> None:
    lines = person.ok("echo", "state/pose", "-n", "3", "--json").splitlines()
    assert len(lines) == 3
    first, *_, last = (json.loads(line) for line in lines)
    assert first["key"] == "vla/panda/state/pose"
    assert first["header"]["source"].startswith("sim#")
    assert last["header"]["seq"] > first["header"]["seq"]
    assert len(first["value"]["position_m"]) == 3
    assert "'worker': 'scripted'" in person.ok("echo", "task", "-n", "1")


def test_echo_of_a_silent_key_fails(person: Person) -> None:
    done = person.run("echo", "no/such/key", "--seconds", "0.3")
    assert done.code == REFUSED
    assert "nothing was published on vla/panda/no/such/key" in done.stderr


def test_without_a_router_a_command_says_where_it_looked_and_what_to_do(person: Person) -> None:
    done = person.run("status", "--once", "--connect", "tcp/127.0.0.1:9")
    assert done.code == REFUSED
    assert "no Zenoh router answers at tcp/127.0.0.1:9" in done.stderr
    assert "vla-zenoh up" in done.stderr
