"""The settings of a running robot: plain puts by anybody, kept by the command node."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import zenoh
from camera_rig import PATIENCE_S, until
from chain import LONG_PATIENCE_S, READY_PATIENCE_S, Chain, command_line, running_chain

from vla_zenoh.bus.buffers import LatestSample
from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.errors import SessionError
from vla_zenoh.types import ActionChunk, ObjectPoses

pytestmark = pytest.mark.long

ROBOT_PATIENCE_S = LONG_PATIENCE_S
SAME_M = 1e-3
"""Two placements of an object by one seed, once it has come to rest."""
APART_M = 0.01
SLOW_READER_S = 0.25
FRESH_S = 0.8
"""What is read of a stream is newer than this, however slow its reader: half of what a queue would
have made of it by then, many times what it takes."""

SCRIPT = """
import sys, zenoh
config = zenoh.Config.from_json5('{mode: "client", connect: {endpoints: ["%s"]}}' % sys.argv[1])
with zenoh.open(config) as session:
    for key, text in zip(sys.argv[2::2], sys.argv[3::2]):
        session.put(key, text)
assert not any(name.startswith("vla_zenoh") for name in sys.modules)
"""


def foreign_program(chain: Chain, **settings: str) -> None:
    """Put settings from a program that knows Zenoh and nothing of ours."""
    words = [word for name, text in settings.items() for word in (f"vla/panda/{name}", text)]
    (endpoint,) = chain.profile.session.connect
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, endpoint, *words],
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def value_of(chain: Chain, name: str) -> str:
    (reply,) = chain.session.get(f"vla/panda/{name}", timeout=PATIENCE_S)
    assert reply.ok is not None
    return reply.ok.payload.to_string()


def test_a_program_that_knows_only_zenoh_moves_and_brakes_the_arm(chain: Chain) -> None:
    chain.activate_when_ready()  # once, so that nothing is missing any more
    chain.settle()
    foreign_program(chain, prompt="HARD: go up", active="true")
    chain.until("it moves", chain.moves)
    assert value_of(chain, "active") == "true"
    assert value_of(chain, "prompt") == "HARD: go up"
    assert float(value_of(chain, "rate")) == chain.profile.task.rate_hz
    assert value_of(chain, "worker") == "scripted"
    assert value_of(chain, "speed") == "100"
    foreign_program(chain, active="0")
    chain.wait_still()
    assert chain.state() == "inactive"
    assert value_of(chain, "active") == "false"


def test_who_comes_late_learns_the_task(chain: Chain) -> None:
    chain.client.set_prompt("HARD: yaw left x2")
    chain.client.set_rate(7.0)
    with open_session(chain.profile.session) as session:
        late = Client(chain.profile, session).subscribe()
        task = until("the task", lambda: late.task)
    assert (task.prompt, task.rate_hz, task.active) == ("HARD: yaw left x2", 7.0, False)


def test_what_is_refused_changes_nothing_and_is_said(chain: Chain) -> None:
    before = chain.client.task
    began = chain.refused()
    keys = chain.client.keys
    for key, text in (
        (keys.active, "perhaps"),
        (keys.rate, "1e9"),
        (keys.worker, "../../etc"),
        (keys.prompt, "\x1b[2J"),
    ):
        chain.client.publish(key, text)
    chain.until(
        "four refusals",
        lambda: chain.refused().get("command.invalid", 0) == began.get("command.invalid", 0) + 4,
    )
    assert chain.client.task == before
    said = {event.why.partition(":")[0]: event.why for event in chain.events("invalid")}
    assert set(said) == {"active", "rate", "worker", "prompt"}
    assert "neither true nor false" in said["active"]


@pytest.mark.parametrize("text", ['"false"', "0.0", '{"active": false}', "null", "x" * 10_000])
def test_what_is_no_clear_activation_ends_one_and_is_said(chain: Chain, text: str) -> None:
    chain.activate_when_ready()
    chain.client.pop_events()
    chain.client.publish(chain.client.keys.active, text)
    chain.until("it ends", lambda: chain.state() == "inactive")
    chain.until("it is said", lambda: chain.events("invalid") or chain.events("oversize"))


def test_a_second_command_node_refuses_to_start(chain: Chain) -> None:
    done = command_line("node", "command", profile=chain.profile_file)
    assert done.returncode == 1
    assert "node 'command' of robot 'panda' is already running" in done.stderr
    assert "Stop it" in done.stderr
    assert "Traceback" not in done.stderr
    chain.activate_when_ready()


def test_settings_are_taken_in_the_order_they_were_put(chain: Chain) -> None:
    """In motion a worker that is not there is refused; after deactivation it may be named."""
    chain.activate_when_ready()
    for _ in range(10):
        chain.client.pop_events()
        chain.client.publish(chain.client.keys.active, "false")
        chain.client.publish(chain.client.keys.worker, "nobody")
        chain.client.publish(chain.client.keys.worker, "scripted")
        chain.client.publish(chain.client.keys.active, "true")
        chain.until("active again", lambda: chain.events("inactive->active"))
        assert not chain.events("worker_refused")


def test_an_answer_older_than_the_question_is_no_answer(chain: Chain) -> None:
    """A client that heard 'active' must not take it for the answer of a command node that hangs."""
    chain.activate_when_ready()
    pid = chain.pid("command")
    os.kill(pid, signal.SIGSTOP)
    try:
        with pytest.raises(SessionError, match="activate: "):
            chain.client.activate(0.6)
        assert not chain.client.deactivate(0.6)
    finally:
        os.kill(pid, signal.SIGCONT)


def objects_of(chain: Chain) -> np.ndarray:
    found: list[ObjectPoses] = []

    def keep(sample: zenoh.Sample) -> None:
        found.append(records.decode(ObjectPoses, sample.payload.to_bytes()))

    subscriber = chain.session.declare_subscriber(
        chain.profile.keys.sim_objects, zenoh.handlers.Callback(keep, indirect=False)
    )
    until("objects at rest", lambda: len(found) > 6, READY_PATIENCE_S)
    subscriber.undeclare()
    return found[-1].position_m


@pytest.mark.slow
def test_the_simulator_places_objects_by_seed_but_not_under_a_moving_arm(chain: Chain) -> None:
    def reset(seed: str) -> np.ndarray:
        count = chain.counter("sim.resets", "sim")
        chain.client.publish(chain.client.keys.sim_reset, seed)
        chain.until("a reset", lambda: chain.counter("sim.resets", "sim") == count + 1)
        time.sleep(0.5)
        return objects_of(chain)

    chain.until("no stream is followed", lambda: chain.detail("following", "sim") is False)
    first, second, again = reset("7"), reset("8"), reset("7")
    assert np.abs(first - again).max() < SAME_M
    assert np.abs(first - second).max() > APART_M
    chain.move()
    refused = chain.refused().get("sim.reset_refused", 0)
    chain.client.publish(chain.client.keys.sim_reset, "9")
    chain.until("a refusal", lambda: chain.refused().get("sim.reset_refused", 0) == refused + 1)
    chain.until("it moves on", chain.moves)


def test_a_slow_reader_has_the_newest_and_holds_nobody_up(chain: Chain) -> None:
    """As a worker with a slow model is: its streams are never queued, nor is a stop behind them."""
    with open_session(chain.profile.session) as session:
        keys = chain.profile.keys
        slots = {key: LatestSample() for key in (keys.camera_raw("front"), keys.state_pose)}
        stop = LatestSample()
        subscribers = [
            session.declare_subscriber(key, zenoh.handlers.Callback(slot, indirect=False))
            for key, slot in {**slots, keys.stop: stop}.items()
        ]
        until("pictures", lambda: all(slot.count for slot in slots.values()))
        ages_s: list[float] = []
        for _ in range(8):
            time.sleep(SLOW_READER_S)
            for slot in slots.values():
                assert slot.wait(PATIENCE_S)
                arrival = slot.pop()
                assert arrival is not None
                ages_s.append((time.monotonic_ns() - arrival.mono_ns) / 1e9)
        assert max(ages_s) < FRESH_S, ages_s
        put_ns = time.monotonic_ns()
        chain.session.put(keys.stop, b"")
        assert stop.wait(PATIENCE_S)
        arrival = stop.pop()
        assert arrival is not None
        assert (arrival.mono_ns - put_ns) / 1e9 < FRESH_S
        for subscriber in subscribers:
            subscriber.undeclare()


@pytest.mark.slow
def test_a_slow_model_sees_the_newest_picture(tmp_path: Path) -> None:
    options = {"scripted": ("delay_ms=400",)}
    with running_chain(tmp_path, worker_options=options) as chain:
        chunks: list[ActionChunk] = []

        def keep(sample: zenoh.Sample) -> None:
            chunks.append(records.decode(ActionChunk, sample.payload.to_bytes()))

        subscriber = chain.session.declare_subscriber(
            chain.profile.keys.delta("scripted"), zenoh.handlers.Callback(keep, indirect=False)
        )
        until("chunks", lambda: len(chunks) >= 6, READY_PATIENCE_S)
        subscriber.undeclare()
        ages_s = [(c.observed_ns - c.observation_stamp_ns) / 1e9 for c in chunks[1:]]
        took_s = [(c.inference_end_ns - c.inference_start_ns) / 1e9 for c in chunks[1:]]
        assert min(took_s) > 0.35
        assert ages_s[-1] < FRESH_S, ages_s
