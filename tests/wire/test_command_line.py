"""``vla-zenoh`` as a person types it, against a running robot."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

from camera_rig import free_endpoint
from chain import LONG_PATIENCE_S, Chain, command_line

from vla_zenoh.bus.session import open_session
from vla_zenoh.profile import load_profile, override

ROBOT_PATIENCE_S = LONG_PATIENCE_S
REFUSED = 1
AGAIN = 2
RATE_TOLERANCE = 0.25
CONTROL_HZ = 500
"""How often the simulated robot computes control, where the computer keeps up."""


def run(chain: Chain, *words: str) -> subprocess.CompletedProcess[str]:
    done = command_line(*words, profile=chain.profile_file)
    assert "Traceback" not in done.stderr
    return done


def ok(chain: Chain, *words: str) -> str:
    """What it prints; asked again where a busy computer took longer than the program waits."""
    for _ in range(1 + AGAIN):
        done = run(chain, *words)
        if "did not accept this within" not in done.stderr:
            break
    assert done.returncode == 0, done.stderr
    return done.stdout


def json_of(chain: Chain, *words: str) -> Any:
    return json.loads(ok(chain, *words))


def test_a_session_from_prompt_to_reset(chain: Chain) -> None:
    chain.activate_when_ready()  # once, so that nothing is missing any more
    chain.settle()
    assert "prompt: 'HARD: go up' (worker scripted, 10 Hz)" in ok(chain, "prompt", "HARD: go up")
    assert "rate: 5 Hz" in ok(chain, "rate", "5")
    assert "speed: 100 % of the planned speed" in ok(chain, "speed")
    assert "speed: 30 % of the planned speed" in ok(chain, "speed", "30 %")
    assert "speed 30 %" in ok(chain, "status", "--once")
    assert "speed: 80 % of the planned speed" in ok(chain, "speed", "80")
    assert "'fast' is not a percentage" in run(chain, "speed", "fast").stderr
    ok(chain, "speed", "100")

    refused = run(chain, "use", "scripter")
    assert refused.returncode == REFUSED
    assert "worker 'scripter' is not alive; did you mean 'scripted'?" in refused.stderr
    assert "Alive are: scripted" in refused.stderr
    chain.client.set_worker("nobody")
    refused = run(chain, "activate")
    assert refused.returncode == REFUSED
    assert "activate rejected:" in refused.stderr
    assert "- worker 'nobody' is not alive; alive are: scripted" in refused.stderr
    ok(chain, "use", "scripted")

    assert "SIM | active: worker scripted, prompt 'HARD: go up', 5 Hz" in ok(chain, "activate")
    chain.until("it moves", chain.moves)
    assert "inactive, the arm stands: robot panda" in ok(chain, "deactivate")
    assert not chain.moves()

    named = f"robot panda (profile {chain.profile_file})"
    how = f"`vla-zenoh reset --profile {chain.profile_file}` clears it"
    said = ok(chain, "stop")
    assert f"CONFIRMED: {named} is stopped and stands, by " in said
    assert how in said
    refused = run(chain, "activate")
    assert refused.returncode == REFUSED
    assert (
        "the state is stopped (emergency stop); clear it with `vla-zenoh reset`" in refused.stderr
    )
    assert "reset; inactive" in ok(chain, "reset")


def test_status_as_json_tells_of_every_node(chain: Chain) -> None:
    told = json_of(chain, "status", "--json")
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


def test_status_for_people_names_every_node(chain: Chain) -> None:
    out = ok(chain, "status", "--once")
    for word in ("router", "sim", "camera", "command", "worker-scripted", "inactive", "inferring"):
        assert word in out


def test_keys_as_json_say_type_writer_and_rate(chain: Chain) -> None:
    found = {entry["key"]: entry for entry in json_of(chain, "keys", "--json")}
    pose = found["vla/panda/state/pose"]
    assert pose["type"] == "application/msgpack"
    assert pose["writer"].startswith("sim#")
    assert abs(pose["rate_hz"] / chain.profile.timing.state_hz - 1) < RATE_TOLERANCE
    assert found["vla/panda/delta/scripted"]["writer"].startswith("worker-scripted#")
    assert "now 'hold'" in found["vla/panda/prompt"]["type"]
    assert "vla/panda/camera/front/raw" in found
    assert found["vla/panda/camera/front/jpeg"]["type"].startswith("image/jpeg")


def test_echo_decodes_what_is_written(chain: Chain) -> None:
    lines = ok(chain, "echo", "state/pose", "-n", "3", "--json").splitlines()
    assert len(lines) == 3
    first, *_, last = (json.loads(line) for line in lines)
    assert first["key"] == "vla/panda/state/pose"
    assert first["header"]["source"].startswith("sim#")
    assert last["header"]["seq"] > first["header"]["seq"]
    assert len(first["value"]["position_m"]) == 3
    assert "'worker': 'scripted'" in ok(chain, "echo", "task", "-n", "1")


def test_echo_of_a_silent_key_fails(chain: Chain) -> None:
    done = run(chain, "echo", "no/such/key", "--seconds", "0.3")
    assert done.returncode == REFUSED
    assert "nothing was published on vla/panda/no/such/key" in done.stderr


def test_echo_names_the_key_that_was_meant_and_ends_with_the_router() -> None:
    endpoint = free_endpoint()
    profile = override(load_profile("panda_sim"), {"session": {"listen": [endpoint]}})
    words = ("echo", "state/joints", "--count", "1", "--connect", endpoint)
    with open_session(profile.session, mode="router"):
        echo = subprocess.Popen(
            [sys.executable, "-m", "vla_zenoh", *words], stderr=subprocess.PIPE, text=True
        )
        assert echo.stderr is not None
        hint = echo.stderr.readline()
    _, said = echo.communicate(timeout=30.0)
    assert hint == "nothing on vla/panda/state/joints yet; did you mean 'state/joint'?\n"
    assert f"error: no Zenoh router answers at {endpoint}" in said
    assert echo.returncode == REFUSED


def test_without_a_router_a_command_says_where_it_looked_and_what_to_do(chain: Chain) -> None:
    done = run(chain, "status", "--once", "--connect", "tcp/127.0.0.1:9")
    assert done.returncode == REFUSED
    assert "no Zenoh router answers at tcp/127.0.0.1:9" in done.stderr
    assert "vla-zenoh up" in done.stderr
