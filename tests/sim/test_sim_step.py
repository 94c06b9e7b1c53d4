"""The simulator in lockstep: time stands still until somebody asks on ``sim/step``."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from camera_rig import until
from chain import READY_PATIENCE_S, write_profile

from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import message, records
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.types import Header, PoseCommand, PoseState

pytestmark = [pytest.mark.realtime, pytest.mark.long]
MS_NS = 1_000_000
STEP_NS = 10 * MS_NS
SPEED_M_S = 0.02
STEPS = 30
FOLLOW_M = 0.002
STILL_TWIST = 0.005


@contextmanager
def lockstep_sim(folder: Path) -> Iterator[tuple[zenoh.Session, Profile]]:
    path = write_profile(folder)
    profile = load_profile(str(path))
    words = [sys.executable, "-m", "vla_zenoh", "node", "sim", "--lockstep", "--profile", str(path)]
    with open_session(profile.session, mode="router"), open_session(profile.session) as session:
        process = subprocess.Popen(words)
        try:
            key = profile.keys.sim_step
            until("it answers", lambda: list(session.get(key, timeout=1.0)), READY_PATIENCE_S)
            yield session, profile
        finally:
            process.terminate()
            assert process.wait(10) == 0


def ask(session: zenoh.Session, profile: Profile, payload: bytes) -> zenoh.Reply:
    (reply,) = session.get(profile.keys.sim_step, payload=payload, timeout=20.0)
    return reply


def step(session: zenoh.Session, profile: Profile, ns: int = STEP_NS) -> dict[str, Any]:
    reply = ask(session, profile, message.pack({"ns": ns}))
    assert reply.ok is not None, reply.err
    return message.unpack(reply.ok.payload.to_bytes())


def rise(session: zenoh.Session, profile: Profile) -> list[dict[str, Any]]:
    """Up at `SPEED_M_S` from where it stands, then nothing more is said; every state on the way."""
    states = [step(session, profile, MS_NS)]
    start = records.from_map(PoseState, states[0]["pose"])
    assert start.reference_position_m is not None
    assert start.reference_quat_xyzw is not None
    for number in range(STEPS):
        up_m = SPEED_M_S * number * STEP_NS / 1e9
        position_m = start.reference_position_m + [0.0, 0.0, up_m]
        command = PoseCommand(
            position_m,
            start.reference_quat_xyzw,
            np.array([0, 0, SPEED_M_S, 0, 0, 0]),
            np.zeros(6),
            position_m,
            start.reference_quat_xyzw,
            "active",
        )
        header = Header(states[-1]["time_ns"], number, "test#1")
        # Same session, same priority: it is there before the question is.
        session.put(
            profile.keys.command_pose,
            records.encode(command),
            attachment=records.encode_header(header),
        )
        states.append(step(session, profile))
    return states


def test_the_same_commands_give_the_same_states_to_the_bit(tmp_path: Path) -> None:
    runs = []
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        with lockstep_sim(folder) as (session, profile):
            runs.append(rise(session, profile))
    assert runs[0] == runs[1]
    first, last = (records.from_map(PoseState, runs[0][index]["pose"]) for index in (0, -1))
    way_m = SPEED_M_S * STEPS * STEP_NS / 1e9
    assert last.position_m[2] - first.position_m[2] == pytest.approx(way_m, abs=FOLLOW_M)


def test_time_stands_still_between_questions_and_silence_is_measured_in_it(
    tmp_path: Path,
) -> None:
    with lockstep_sim(tmp_path) as (session, profile):
        states = rise(session, profile)
        times_ns = [state["time_ns"] for state in states]
        assert times_ns == [MS_NS + number * STEP_NS for number in range(STEPS + 1)]
        time.sleep(2 * profile.timing.command_timeout_s)  # nobody's clock but the world's counts
        state = step(session, profile)
        assert state["time_ns"] == times_ns[-1] + STEP_NS
        going_on = records.from_map(PoseState, state["pose"])
        assert going_on.twist[2] > SPEED_M_S / 2

        timeout_ns = int(profile.timing.command_timeout_s * 1e9)
        stands = records.from_map(
            PoseState, step(session, profile, timeout_ns + 50 * STEP_NS)["pose"]
        )
        assert np.abs(stands.twist).max() < STILL_TWIST


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (b"", "not valid msgpack"),
        (message.pack({"ns": 1}), "wanted a multiple of 1000000"),
        (message.pack({"ns": -MS_NS}), "wanted a multiple"),
        (message.pack({"ns": 10**18}), "at most 60 s"),
        (message.pack({"ns": "1000000"}), "wanted a map"),
        (message.pack([1]), "wanted a map"),
    ],
)
def test_a_question_that_makes_no_sense_is_answered_with_the_reason(
    lockstep: tuple[zenoh.Session, Profile], payload: bytes, why: str
) -> None:
    session, profile = lockstep
    before = step(session, profile, MS_NS)["time_ns"]
    reply = ask(session, profile, payload)
    assert reply.err is not None
    assert why in reply.err.payload.to_string()
    assert step(session, profile, MS_NS)["time_ns"] == before + MS_NS


@pytest.fixture(scope="module")
def lockstep(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[zenoh.Session, Profile]]:
    with lockstep_sim(tmp_path_factory.mktemp("lockstep")) as running:
        yield running
