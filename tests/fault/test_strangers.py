"""Strangers write on every key while the arm moves: nothing dies, nothing jumps, all is counted."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import zenoh
from chain import LONG_PATIENCE_S, Chain, Recorder
from junk import OBEYED, OTHERS, SETTINGS, STRANGER, STREAMS, all_junk, all_keys, samples_of

from vla_zenoh.codec import message, records
from vla_zenoh.types import GripperState, Header

ROBOT_PATIENCE_S = LONG_PATIENCE_S
SHORT_S, LONG_S = 8.0, 30.0
PAUSE_S = 0.001
"""Between two puts: a thousand a second, were they for nothing."""
FLOOD_HZ, FLOOD_S = 5000, 3.0
FLOOD_SHARE = 0.6
"""Of those puts a busy machine must manage, or the flood is none."""
LOOP_SHARE = 0.9
"""Of the ticks of the command loop that must still take place."""
WINDOW_S = 0.5
"""The rate is the median of such windows: a stall of the computer falls into one or two of them, a
flood that slows the loop into all."""
COMMAND_TOLERANCE = 1.1
ARM_TOLERANCE = 2.7
"""As in test_dead_nodes."""
BOX_TOLERANCE_M = 0.003
"""The measured arm follows its reference with a spring."""
BRAKE_S = 0.5
OPEN_M = 0.075
"""Nobody asked the gripper to close, but strangers."""
SOME_STATES = 20
AHEAD = 30
"""Of the true worker, which goes on meanwhile: what comes after its own is not looked at."""
COUNTED = {
    "command.malformed",
    "command.invalid",
    "command.no_header",
    "command.schema",
    "command.oversize",
    "command.foreign",
    "command.replayed",
    "sim.malformed",
    "sim.invalid",
    "sim.no_header",
    "sim.schema",
    "sim.pose_foreign",
    "sim.pose_replayed",
    "sim.foreign",
    "sim.reset_refused",
    "worker-scripted.malformed",
    "worker-scripted.no_header",
    "worker-scripted.schema",
    "worker-scripted.foreign",
    "worker-scripted.replayed",
    "camera.malformed",
    "camera.no_header",
}
"""What junk on every key is refused for, by node."""


def test_every_key_of_the_table_is_tried(shared_chain: Chain) -> None:
    known = {*STREAMS, *SETTINGS, *OTHERS, *OBEYED}
    assert set(all_keys(shared_chain.profile.keys)) == known


def assert_within_limits(chain: Chain, recorder: Recorder) -> None:
    limits = chain.profile.limits
    track = recorder.track()
    assert len(track.stamp_ns) > 100
    box = limits.workspace
    for axis, (low, high) in enumerate((box.x_m, box.y_m, box.z_m)):
        assert track.position_m[:, axis].min() >= low - BOX_TOLERANCE_M
        assert track.position_m[:, axis].max() <= high + BOX_TOLERANCE_M
    speed = np.abs(track.twist[:, :3]).max()
    assert speed <= limits.translation.velocity_m_s * COMMAND_TOLERANCE
    acceleration = limits.translation.acceleration_m_s2
    assert recorder.hardest_command() <= acceleration * COMMAND_TOLERANCE
    assert track.hardest_change() <= acceleration * ARM_TOLERANCE


def keep_moving(chain: Chain, seconds: float, work: Callable[[], None]) -> float:
    """Do `work` again and again while the arm goes up and down; returns the share it was active."""
    end, turn_s = time.monotonic() + seconds, 0.0
    down, active, looks = False, 0, 0
    while time.monotonic() < end:
        if time.monotonic() > turn_s:
            turn_s, down = time.monotonic() + 2.0, not down
            chain.client.publish(chain.client.keys.prompt, f"HARD: go {'down' if down else 'up'}")
        work()
        looks += 1
        active += chain.state() == "active"
    return active / looks


def be_a_nuisance(chain: Chain, seconds: float) -> None:
    chain.activate_when_ready()
    chain.go("up", 15)
    samples = samples_of(chain)
    keys = all_keys(chain.profile.keys)
    pictures = (keys["camera_raw"], keys["camera_jpeg"])
    pids = chain.host.supervisor.pids()
    refused = chain.refused()
    chain.recorder.forget()
    junk = all_junk(chain, samples)
    kinds: set[tuple[str, str]] = set()

    def put_some() -> None:
        for piece in itertools.islice(junk, 20):
            schema = "rgb8;9999x9999" if piece.key in pictures else None
            encoding = zenoh.Encoding.ZENOH_BYTES
            chain.session.put(
                piece.key,
                piece.payload,
                attachment=piece.attachment,
                encoding=encoding.with_schema(schema) if schema else encoding,
            )
            kinds.add((piece.key, piece.kind))
            time.sleep(PAUSE_S)

    share = keep_moving(chain, seconds, put_some)

    def grown() -> set[str]:
        return {name for name, count in chain.refused().items() if count > refused.get(name, 0)}

    with suppress(AssertionError):  # what is missing is told below
        chain.until("all is counted", lambda: grown() >= COUNTED)
    print(f"active {share:.0%} of the time; {len(kinds)} kinds of junk; {chain.refused()}")
    assert chain.host.supervisor.pids() == pids, chain.story()
    assert share > 0.9, chain.story()
    assert_within_limits(chain, chain.recorder)
    gripper, _ = samples_of(chain, 0.3, keys["state_gripper"])[keys["state_gripper"]]
    assert records.decode(GripperState, gripper).width_m > OPEN_M
    assert grown() >= COUNTED, sorted(COUNTED - grown())

    # And it still does as told.
    chain.client.set_prompt("HARD: go up" if chain.height_m() < 0.4 else "HARD: go down")
    chain.until("it moves", chain.moves)
    stopped_ns = time.time_ns()
    chain.session.put(chain.profile.keys.stop, b"\xff\x00 anything")
    chain.until("stopped", lambda: chain.state() == "stopped")
    chain.wait_still()
    assert chain.recorder.track().time_to_stand_s(stopped_ns) < BRAKE_S
    chain.client.publish(chain.client.keys.reset, "")
    chain.until("reset", lambda: chain.state() == "inactive")
    chain.activate_when_ready()
    direction, sign = ("up", 1) if chain.height_m() < 0.4 else ("down", -1)  # away from the table
    assert chain.go(direction, 3) == pytest.approx(sign * 0.03, abs=0.001), chain.height_m()


@pytest.mark.long
def test_junk_on_every_key_moves_nothing_and_is_counted(chain: Chain) -> None:
    be_a_nuisance(chain, SHORT_S)


@pytest.mark.slow
def test_junk_on_every_key_for_long_moves_nothing_and_is_counted(chain: Chain) -> None:
    be_a_nuisance(chain, LONG_S)


def forged(chain: Chain, **changes: Any) -> tuple[bytes, bytes]:
    """A chunk in the name of the true worker, newer than its newest, with some fields changed."""
    key = chain.profile.keys.delta("scripted")
    payload, attachment = samples_of(chain, 0.5, key)[key]
    assert attachment is not None
    true, fields = records.decode_header(attachment), message.unpack(payload)
    now_ns = time.time_ns()
    fresh = {"observation_stamp_ns": now_ns, "valid_until_ns": now_ns + 10**9}
    header = Header(now_ns, true.seq + AHEAD, true.source)
    return message.pack(fields | fresh | changes), records.encode_header(header)


# The other reasons are those of tests/unit/control/test_chunk_validation.py.
def test_a_forged_chunk_is_refused_by_its_reason_and_moves_nothing(chain: Chain) -> None:
    chain.activate_when_ready()
    chain.wait_still()
    began = chain.counter("refused.spec_mismatch")
    chain.recorder.forget()
    steps = np.array([[0.02, 0, 0, 0, 0, 0, 0]], np.float32)
    payload, attachment = forged(chain, spec_hash="0" * 16, steps=steps)
    chain.session.put(chain.profile.keys.delta("scripted"), payload, attachment=attachment)
    chain.until(
        f"it is refused; was refused: {chain.refused()}",
        lambda: chain.counter("refused.spec_mismatch") == began + 1,
    )
    chain.until("states", lambda: len(chain.recorder.track().stamp_ns) >= SOME_STATES)
    track = chain.recorder.track()
    assert np.ptp(track.reference_m, axis=0).max() < 1e-4
    chain.until("it goes on", lambda: chain.state() == "active")


@pytest.mark.long
def test_a_flood_does_not_slow_the_command_loop(chain: Chain) -> None:
    chain.activate_when_ready()
    chain.go("up", 10)
    keys = chain.profile.keys
    payload, attachment = samples_of(chain, 0.6, keys.delta("scripted"))[keys.delta("scripted")]
    stranger = records.encode_header(Header(time.time_ns(), 1, STRANGER))
    assert attachment is not None
    pid = chain.pid("command")
    missed = chain.counter("command.missed_ticks")
    chain.recorder.forget()
    chain.client.publish(keys.prompt, "HARD: go up x8")
    began, sent = time.monotonic(), 0
    began_ns = time.time_ns()
    while time.monotonic() - began < FLOOD_S:
        due = int((time.monotonic() - began) * FLOOD_HZ)
        while sent < due:
            if sent % 2:
                chain.session.put(keys.delta("scripted"), payload, attachment=stranger)
            else:
                chain.session.put(keys.prompt, b"\xffflood")
            sent += 1
        time.sleep(0.001)
    took_s = time.monotonic() - began
    ended_ns = time.time_ns()
    assert sent / took_s > FLOOD_SHARE * FLOOD_HZ, "this machine cannot make the flood"
    time.sleep(0.7)
    commands = [
        header.stamp_wall_ns
        for header, _ in chain.recorder.commands()
        if began_ns < header.stamp_wall_ns < ended_ns
    ]
    counts, _ = np.histogram(commands, max(1, int(took_s / WINDOW_S)), range=(began_ns, ended_ns))
    rate_hz = float(np.median(counts)) * len(counts) / took_s
    missed = chain.counter("command.missed_ticks") - missed
    dropped = chain.counter("command.chunks_dropped")
    print(f"{sent / took_s:.0f} puts/s, loop {rate_hz:.1f} Hz, {missed} missed, {dropped} dropped")
    assert counts.min() > 0, f"the loop stood still: {counts}"
    assert rate_hz > LOOP_SHARE * chain.profile.timing.command_hz, chain.story()
    assert chain.pid("command") == pid
    assert_within_limits(chain, chain.recorder)
    chain.settle()
