"""Strangers write on every key while the arm moves: nothing dies, nothing jumps, all is counted."""

from __future__ import annotations

import itertools
import random
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
import zenoh
from chain import Chain, Recorder

from vla_zenoh.codec import header as header_codec
from vla_zenoh.codec import message, records
from vla_zenoh.keys import SCHEMA, Keys
from vla_zenoh.security.roles import key_members
from vla_zenoh.types import Event, GripperCommand, GripperState, Header, JointCommand, Task

SHORT_S, LONG_S = 8.0, 30.0
PAUSE_S = 0.001
"""Between two puts: a thousand a second, were they for nothing."""
HUGE = bytes(2_000_000)
FLOOD_HZ, FLOOD_S = 5000, 3.0
FLOOD_SHARE = 0.6
"""Of those puts a busy machine must manage, or the flood is none."""
LOOP_SHARE = 0.9
"""Of the ticks of the command loop that must still take place."""
COMMAND_TOLERANCE = 1.1
ARM_TOLERANCE = 2.7
"""As in test_dead_nodes."""
BOX_TOLERANCE_M = 0.003
"""The measured arm follows its reference with a spring."""
BRAKE_S = 0.5
OPEN_M = 0.075
"""Nobody asked the gripper to close, but strangers."""
STRANGER = "stranger#00000000"
STREAMS = (
    "state_joint",
    "state_pose",
    "state_gripper",
    "task",
    "delta",
    "spec",
    "command_pose",
    "command_joint",
    "command_gripper",
    "status",
    "event",
    "sim_scene",
    "sim_objects",
)
SETTINGS = ("prompt", "active", "worker", "rate", "speed", "slower", "reset", "sim_reset")
OTHERS = (
    "camera_raw",
    "camera_jpeg",
    "camera_fitted",
    "seen",
    "seen_record",
    "alive",
    "holding",
    "clock",
    "sim_step",
)
OBEYED = ("stop",)
"""Whatever is put there stops the arm; it is tried at the end."""
SELDOM = {
    "command_gripper": GripperCommand(0.0, 0.1, 10.0),
    "command_joint": JointCommand(("a", "b"), np.ones(2), np.zeros(2), np.zeros(2), "active"),
    "event": Event("info", "notice", "nothing", "happened"),
    "task": Task(1 << 60, True, "HARD: yaw left", "scripted", 100.0),
}
"""Not written all the time: true but for their writer."""
NAMES = {
    "camera": "front",
    "form": "224x224-pad",
    "worker": "scripted",
    "node": "command",
    "holder": "anna",
}


class Junk(NamedTuple):
    """A put: on which key, what."""

    kind: str
    key: str
    payload: bytes
    attachment: bytes | None


def all_keys(keys: Keys) -> dict[str, str]:
    """Every key of the table by its name there, with names of parts that exist."""
    out: dict[str, str] = {}
    for name, parameters in key_members().items():
        member = getattr(keys, name)
        out[name] = member(*(NAMES[part] for part in parameters)) if parameters else member
    return out


def test_every_key_of_the_table_is_tried(shared_chain: Chain) -> None:
    known = {*STREAMS, *SETTINGS, *OTHERS, *OBEYED}
    assert set(all_keys(shared_chain.profile.keys)) == known


def samples_of(chain: Chain, seconds: float = 1.2) -> dict[str, tuple[bytes, bytes | None]]:
    """The newest true sample on each stream, to make false ones of."""
    found: dict[str, tuple[bytes, bytes | None]] = {}

    def keep(sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        found[str(sample.key_expr)] = (
            sample.payload.to_bytes(),
            attachment.to_bytes() if attachment is not None else None,
        )

    subscriber = chain.session.declare_subscriber(
        chain.profile.keys.all_keys, zenoh.handlers.Callback(keep, indirect=False)
    )
    time.sleep(seconds)
    subscriber.undeclare()
    keys = all_keys(chain.profile.keys)
    for name, record in SELDOM.items():
        header = header_codec.encode(Header(time.time_ns(), 0, STRANGER))
        found.setdefault(keys[name], (records.encode(record), header))
    return found


def spoil(value: Any, make: Callable[[Any], Any]) -> Any:
    """`value` with every number in it replaced by what `make` gives."""
    if isinstance(value, dict):
        return {key: spoil(item, make) for key, item in value.items()}
    if isinstance(value, list):
        return [spoil(item, make) for item in value]
    if isinstance(value, bool) or value is None or isinstance(value, (str, bytes)):
        return value
    return make(value)


def filled(with_: float) -> Callable[[Any], Any]:
    def make(value: Any) -> Any:
        return np.full_like(value, with_) if isinstance(value, np.ndarray) else with_

    return make


def wrong_shape(value: Any) -> Any:
    return np.zeros((3, 1, 5)) if isinstance(value, np.ndarray) else [value]


def junk_for_stream(key: str, payload: bytes, attachment: bytes, seq: int) -> Iterator[Junk]:
    true = header_codec.decode(attachment)
    stranger = header_codec.encode(Header(time.time_ns(), seq, STRANGER))
    old = header_codec.encode(Header(time.time_ns() - 3_600_000_000_000, seq, STRANGER))
    forged = header_codec.encode(true)
    fields = message.unpack(payload)
    yield Junk("noise", key, random.randbytes(200), forged)
    yield Junk("truncated", key, payload[: len(payload) // 2], forged)
    yield Junk("foreign", key, payload, stranger)
    yield Junk("old stamp", key, payload, old)
    yield Junk("replayed", key, payload, attachment)
    yield Junk("no header", key, payload, None)
    yield Junk("noise for a header", key, payload, random.randbytes(40))
    schema = message.unpack(attachment) | {"schema": SCHEMA + 1}
    yield Junk("schema", key, payload, message.pack(schema))
    for what, make in (
        ("nan", filled(np.nan)),
        ("1e9", filled(1e9)),
        ("wrong shape", wrong_shape),
    ):
        yield Junk(what, key, message.pack(spoil(fields, make)), forged)
        yield Junk(f"foreign {what}", key, message.pack(spoil(fields, make)), stranger)
    if "spec_hash" in fields:
        yield Junk("spec hash", key, message.pack(fields | {"spec_hash": "0" * 16}), stranger)
    yield Junk("huge", key, HUGE, forged)
    yield Junk("empty", key, b"", forged)


def junk_for_setting(name: str, key: str) -> Iterator[Junk]:
    # What can be read is obeyed, by whomever it was put: these cannot.
    yield Junk("noise", key, b"\xff\xfe" + random.randbytes(50), None)
    yield Junk("control characters", key, b"\x00\x9b\x1b[2J", None)
    yield Junk("huge", key, HUGE, None)
    if name != "prompt":
        yield Junk("nan", key, b"nan/nan", None)
        yield Junk("1e9", key, b"-1e9 x", None)
        yield Junk("empty", key, b"", None)


def junk_for_other(key: str, sample: tuple[bytes, bytes | None] | None) -> Iterator[Junk]:
    header = header_codec.encode(Header(time.time_ns(), 1, STRANGER))
    yield Junk("noise", key, random.randbytes(200), header)
    yield Junk("huge", key, HUGE, header)
    yield Junk("empty", key, b"", header)
    yield Junk("no header", key, random.randbytes(57_600), None)
    if sample is not None:
        yield Junk("replayed", key, *sample)
        yield Junk("foreign", key, sample[0], header)


def all_junk(chain: Chain, samples: dict[str, tuple[bytes, bytes | None]]) -> Iterator[Junk]:
    """Without end, over all keys again and again."""
    keys = all_keys(chain.profile.keys)
    for seq in itertools.count():
        for name in STREAMS:
            payload, attachment = samples[keys[name]]
            assert attachment is not None
            yield from junk_for_stream(keys[name], payload, attachment, seq)
        for name in SETTINGS:
            yield from junk_for_setting(name, keys[name])
        for name in OTHERS:
            yield from junk_for_other(keys[name], samples.get(keys[name]))


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
    time.sleep(1.2)  # two reports
    print(f"active {share:.0%} of the time; {len(kinds)} kinds of junk; {chain.refused()}")
    assert chain.host.supervisor.pids() == pids, chain.story()
    assert share > 0.9, chain.story()
    assert_within_limits(chain, chain.recorder)
    gripper, _ = samples_of(chain, 0.3)[keys["state_gripper"]]
    assert records.decode(GripperState, gripper).width_m > OPEN_M
    grown = {name for name, count in chain.refused().items() if count > refused.get(name, 0)}
    assert grown >= {
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
    }, sorted(grown)

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


def test_junk_on_every_key_moves_nothing_and_is_counted(chain: Chain) -> None:
    be_a_nuisance(chain, SHORT_S)


@pytest.mark.slow
def test_junk_on_every_key_for_long_moves_nothing_and_is_counted(chain: Chain) -> None:
    be_a_nuisance(chain, LONG_S)


def forged(chain: Chain, **changes: Any) -> tuple[bytes, bytes]:
    """A chunk in the name of the true worker, newer than its newest, with some fields changed."""
    payload, attachment = samples_of(chain, 0.5)[chain.profile.keys.delta("scripted")]
    assert attachment is not None
    true, fields = header_codec.decode(attachment), message.unpack(payload)
    now_ns = time.time_ns()
    fresh = {"observation_stamp_ns": now_ns, "valid_until_ns": now_ns + 10**9}
    header = Header(now_ns, true.seq + 3, true.source)
    return message.pack(fields | fresh | changes), header_codec.encode(header)


@pytest.mark.parametrize(
    ("reason", "changes"),
    [
        ("spec_mismatch", {"spec_hash": "0" * 16}),
        ("stale", {"observation_stamp_ns": 1}),
        ("future", {"observation_stamp_ns": 1 << 62}),
        ("expired", {"valid_until_ns": 1}),
        ("superseded", {"episode": 1 << 60}),
        ("step_m", {"steps": np.array([[1e9, 0, 0, 0, 0, 0, 0]], np.float32)}),
        ("shape", {"steps": np.zeros((1, 9), np.float32)}),
    ],
)
def test_a_forged_chunk_is_refused_by_its_reason_and_moves_nothing(
    chain: Chain, reason: str, changes: dict[str, Any]
) -> None:
    chain.activate_when_ready()
    chain.wait_still()
    if reason == "stale":
        # Old enough to be refused, young enough to be of this activation.
        time.sleep(1.5)
        changes = {"observation_stamp_ns": time.time_ns() - 1_200_000_000}
    began = chain.counter(f"refused.{reason}")
    chain.recorder.forget()
    payload, attachment = forged(chain, **changes)
    chain.session.put(chain.profile.keys.delta("scripted"), payload, attachment=attachment)
    chain.until(
        f"refused as {reason}; was refused: {chain.refused()}",
        lambda: chain.counter(f"refused.{reason}") == began + 1,
    )
    time.sleep(0.3)
    track = chain.recorder.track()
    assert np.ptp(track.reference_m, axis=0).max() < 1e-4
    chain.until("it goes on", lambda: chain.state() == "active")


def test_a_flood_does_not_slow_the_command_loop(chain: Chain) -> None:
    chain.activate_when_ready()
    chain.go("up", 10)
    keys = chain.profile.keys
    payload, attachment = samples_of(chain, 0.6)[keys.delta("scripted")]
    stranger = header_codec.encode(Header(time.time_ns(), 1, STRANGER))
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
    rate_hz = len(commands) / took_s
    missed = chain.counter("command.missed_ticks") - missed
    dropped = chain.counter("command.chunks_dropped")
    print(f"{sent / took_s:.0f} puts/s, loop {rate_hz:.1f} Hz, {missed} missed, {dropped} dropped")
    assert rate_hz > LOOP_SHARE * chain.profile.timing.command_hz, chain.story()
    assert chain.pid("command") == pid
    assert_within_limits(chain, chain.recorder)
    chain.settle()
