"""Who is heard on a key, mailboxes, and a wall clock that is set."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from tempfile import NamedTemporaryFile

import pytest
import zenoh
from camera_rig import await_match, free_endpoint, until

from vla_zenoh.bus.buffers import CallbackRing, LatestSample, ReceivedSample, ZenohRing
from vla_zenoh.bus.clock import ADOPT_S, Clock
from vla_zenoh.bus.name_check import AWAY_S, NEW_S, NameCheck
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import MAX_MESSAGE_BYTES, alive_nodes, open_session
from vla_zenoh.codec import message, records
from vla_zenoh.errors import CodecError, NodeError
from vla_zenoh.keys import Keys
from vla_zenoh.profile import Profile, SessionProfile, load_profile, override
from vla_zenoh.runtime.process import is_running
from vla_zenoh.types import Event, GripperState, Header, SingleWriterFilter

SILENCE_NS = 500_000_000
STEP_TOLERANCE_S = 0.002
SOON_S = 0.3
"""For so long a node of these tests is new."""

pytestmark = pytest.mark.realtime


def refused(speaker: SingleWriterFilter, header: Header, mono_ns: int) -> str | None:
    try:
        speaker.check(header, mono_ns)
    except CodecError as error:
        return error.reason
    return None


@contextmanager
def two_sessions() -> Iterator[tuple[Profile, zenoh.Session, zenoh.Session]]:
    """A profile with a router of its own, and two clients of that."""
    endpoint = free_endpoint()
    profile = override(
        load_profile("panda_sim"), {"session": {"listen": [endpoint], "connect": [endpoint]}}
    )
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as one,
        open_session(profile.session) as other,
    ):
        yield profile, one, other


@pytest.fixture
def spoken() -> SingleWriterFilter:
    """Number 7 of ``robot#1`` was heard at time 0."""
    speaker = SingleWriterFilter(SILENCE_NS / 1e9)
    speaker.check(Header(0, 7, "robot#1"), 0)
    speaker.accept(Header(0, 7, "robot#1"), 0)
    return speaker


@pytest.mark.parametrize(
    ("source", "seq", "at_ns", "reason"),
    [
        ("robot#1", 8, 1, None),
        ("robot#1", 7, 1, "replayed"),
        ("robot#1", 6, 1, "replayed"),
        ("robot#2", 8, 1, "foreign"),
        ("robot#2", 0, SILENCE_NS - 1, "foreign"),
        ("robot#2", 0, SILENCE_NS, None),
    ],
)
def test_one_source_is_heard_until_it_falls_silent(
    spoken: SingleWriterFilter, source: str, seq: int, at_ns: int, reason: str | None
) -> None:
    assert refused(spoken, Header(0, seq, source), at_ns) == reason


def test_what_was_refused_does_not_keep_the_speaker_alive(spoken: SingleWriterFilter) -> None:
    stranger = Header(0, 0, "robot#2")
    assert refused(spoken, stranger, SILENCE_NS - 1) == "foreign"
    assert refused(spoken, stranger, SILENCE_NS) is None


def test_a_record_that_was_not_taken_does_not_use_up_its_number(spoken: SingleWriterFilter) -> None:
    nonsense = Header(0, 8, "robot#1")
    assert refused(spoken, nonsense, 1) is None  # its payload turns out to be none
    assert refused(spoken, nonsense, 2) is None


def test_a_mailbox_keeps_the_newest_in_order_and_no_more_than_it_holds() -> None:
    endpoint = free_endpoint()
    profile = SessionProfile(listen=(endpoint,), connect=(endpoint,))
    with (
        open_session(profile, mode="router"),
        open_session(profile) as reader,
        open_session(profile) as writer,
    ):
        box = ZenohRing(3)
        _subscriber = box.subscribe(reader, "test/box")
        await_match(writer, "test/box")
        last = reader.declare_subscriber("test/end", zenoh.handlers.RingChannel(1))
        await_match(writer, "test/end")
        for number in range(10):
            writer.put("test/box", str(number))
        writer.put("test/end", "")
        until("the end", last.try_recv)
        taken = [arrival.sample.payload.to_string() for arrival in box.drain()]
        assert taken == ["7", "8", "9"]
        assert box.drain() == []


def test_no_node_counts_as_dead_while_the_router_is_away() -> None:
    endpoint = free_endpoint()
    profile = SessionProfile(listen=(endpoint,), connect=(endpoint,))
    keys = Keys("panda")
    router = open_session(profile, mode="router")
    with open_session(profile) as asking, open_session(profile) as answering:
        _token = answering.liveliness().declare_token(keys.alive("command"))
        until("the node is found", lambda: alive_nodes(asking, keys) == {"command"})
        router.close()
        until("the link is lost", lambda: not asking.info.routers_zid())
        with pytest.raises(NodeError, match="the router does not report within 1 s which nodes"):
            alive_nodes(asking, keys)
        with open_session(profile, mode="router"):
            until("the node is found again", lambda: alive_nodes(asking, keys) == {"command"})


def test_a_second_node_of_a_name_that_a_new_router_did_not_know_of_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with two_sessions() as (profile, one, other):
        monkeypatch.setattr("vla_zenoh.bus.name_check.NEW_S", SOON_S)
        first = Node("command", profile, one)
        time.sleep(SOON_S)
        monkeypatch.setattr("vla_zenoh.bus.node.alive_nodes", lambda *_, **__: set())
        second = Node("command", profile, other)

        def told() -> str:
            first.publish_status("inactive")
            second.publish_status("stopped", now=True)
            try:
                second.publish_status("inactive")
            except NodeError as error:
                return str(error)
            return ""

        assert "node 'command' of robot 'panda' is already running" in until("it ends", told)
        second.close()
        first.publish_status("inactive")
        first.close()


STOPPED_NODE = """
import sys, time
from vla_zenoh.bus import name_check
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.profile import load_profile, override

name_check.AWAY_S = 1.5
where = {"listen": [sys.argv[1]], "connect": [sys.argv[1]]}
profile = override(load_profile("panda_sim"), {"session": where})
with open_session(profile.session) as session:
    node = Node("command", profile, session)
    print("ready", flush=True)
    while True:
        node.publish_status("inactive")
        time.sleep(0.02)
"""


def test_a_stopped_node_that_was_replaced_ends_when_it_goes_on_and_not_the_new_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("vla_zenoh.bus.name_check.NEW_S", SOON_S)
    with two_sessions() as (profile, one, other):
        words = [sys.executable, "-c", STOPPED_NODE, *profile.session.connect]
        with subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            try:
                assert process.stdout is not None
                assert process.stderr is not None
                assert process.stdout.readline() == "ready\n"
                until("its token is there", lambda: alive_nodes(one, profile.keys))
                process.send_signal(signal.SIGSTOP)
                time.sleep(2.0)
                until("its token is gone", lambda: not alive_nodes(one, profile.keys), 30.0)
                replacement = Node("command", profile, other)
                time.sleep(SOON_S)
                process.send_signal(signal.SIGCONT)

                def ends() -> bool:
                    replacement.publish_status("inactive")
                    return process.poll() is not None

                until("it ends", ends, 30.0)
                assert "is already running" in process.stderr.read()
                replacement.publish_status("inactive")
                replacement.close()
            finally:
                process.kill()


@pytest.mark.parametrize(
    ("away_s", "ends"), [(AWAY_S - 1.0, False), (AWAY_S + 1.0, True)], ids=["short", "long"]
)
def test_a_node_that_was_away_for_long_asks_whether_it_was_replaced(
    monkeypatch: pytest.MonkeyPatch, away_s: float, ends: bool
) -> None:
    now_s = [0.0]
    monkeypatch.setattr(NameCheck, "_now_s", staticmethod(lambda: now_s[0]))
    with two_sessions() as (profile, one, other):
        key = profile.keys.clock("command")
        check = NameCheck(one, key)
        replacement = Node("command", profile, other)
        until("the other one answers", lambda: list(one.get(key)))
        for passed_s in (NEW_S + 1.0, away_s):
            now_s[0] += passed_s
            check.poll()
        if ends:
            until("it is told", lambda: check.taken)
        else:
            assert list(one.get(key))
            assert not check.taken
        replacement.close()


@pytest.mark.parametrize("make", [LatestSample, partial(CallbackRing, 4), partial(ZenohRing, 4)])
def test_a_sample_larger_than_its_slot_takes_is_dropped_counted_and_told(
    make: Callable[[int], LatestSample | CallbackRing | ZenohRing],
) -> None:
    limit = 1000
    with two_sessions() as (profile, reader, writer):
        node = Node("reader", profile, reader)
        key = node.keys.prompt
        slot = node.subscribe(key, make(limit))
        events = CallbackRing(8)
        writer.declare_subscriber(
            node.keys.event("reader"), zenoh.handlers.Callback(events, indirect=False)
        )
        await_match(writer, key)
        await_match(reader, node.keys.event("reader"))
        writer.put(key, bytes(limit + 1))
        writer.put(key, b"", attachment=bytes(limit + 1))
        writer.put(key, bytes(limit))

        def take() -> list[ReceivedSample]:
            if isinstance(slot, LatestSample):
                arrival = slot.pop()
                return [] if arrival is None else [arrival]
            return slot.drain()

        taken = until("the one that fits", take)
        assert [len(arrival.sample.payload) for arrival in taken] == [limit]
        node.publish_status("running", now=True)
        assert node.counters["refused.oversize"] == 2
        told = until("the event", events.drain)
        words = b"prompt: %d bytes, at most %d are accepted" % (limit + 1, limit)
        assert words in told[-1].sample.payload.to_bytes()
        node.close()


@pytest.fixture
def opened() -> Iterator[list[str]]:
    """Files that Python opens from now on."""
    paths: list[str] = []
    ended = threading.Event()

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if event == "open" and not ended.is_set():
            paths.append(str(arguments[0]))

    sys.addaudithook(hook)
    yield paths
    ended.set()  # a hook cannot be removed


@pytest.mark.skipif(sys.platform != "linux", reason="files of Linux")
def test_a_status_reads_no_file_for_which_a_control_loop_would_wait(opened: list[str]) -> None:
    """/proc/locks lets its reader wait for the grace period of RCU, 5 to 15 ms."""
    with (
        two_sessions() as (profile, _, session),
        NamedTemporaryFile(dir="/dev/shm", suffix=".zenoh"),
    ):
        node = Node("command", profile, session)
        opened.clear()
        node.publish_status("inactive")
        assert set(opened) <= {"/proc/self/status"}
        node.close()


@pytest.mark.parametrize("make", [LatestSample, partial(CallbackRing, 4), partial(ZenohRing, 4)])
def test_what_deletes_is_not_taken_for_what_is_put(
    make: Callable[[], LatestSample | CallbackRing | ZenohRing],
) -> None:
    with two_sessions() as (profile, reader, writer):
        node = Node("reader", profile, reader)
        key = node.keys.reset
        slot = node.subscribe(key, make())  # pyright: ignore[reportArgumentType]
        await_match(writer, key)
        for _ in range(3):
            writer.delete(key)
        writer.put(key, b"")

        def take() -> list[ReceivedSample]:
            if isinstance(slot, LatestSample):
                arrival = slot.pop()
                return [] if arrival is None else [arrival]
            return slot.drain()

        (taken,) = until("the one that was put", take)
        assert taken.sample.kind == zenoh.SampleKind.PUT
        node.publish_status("running", now=True)
        assert node.counters["refused.deleted"] == 3
        node.close()


def test_zenoh_itself_passes_over_what_nobody_could_read() -> None:
    endpoint = free_endpoint()
    profile = SessionProfile(listen=(endpoint,), connect=(endpoint,), shared_memory=False)
    with (
        open_session(profile, mode="router"),
        open_session(profile) as reader,
        open_session(profile) as writer,
    ):
        box = ZenohRing(4, MAX_MESSAGE_BYTES)
        _subscriber = box.subscribe(reader, "test/box")
        await_match(writer, "test/box")
        # Else a busy computer drops the second one behind the first.
        waits = zenoh.CongestionControl.BLOCK
        writer.put("test/box", bytes(MAX_MESSAGE_BYTES + 1), congestion_control=waits)
        writer.put("test/box", b"after", congestion_control=waits)
        taken = until("the small one", box.drain)
        assert [arrival.sample.payload.to_bytes() for arrival in taken] == [b"after"]


@pytest.mark.parametrize("step_s", [-1.0, -0.1, 0.1, 3600.0])
def test_a_wall_clock_that_is_set_is_noticed_once_and_followed(
    monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    clock = Clock()
    true: Callable[[], int] = time.time_ns
    before_ns = clock.wall_ns()
    monkeypatch.setattr(time, "time_ns", lambda: true() + int(step_s * 1e9))
    assert clock.wall_ns() - before_ns < 1e9, "it does not jump by itself"
    assert clock.adopt_system_time() == pytest.approx(step_s, abs=STEP_TOLERANCE_S)
    assert clock.adopt_system_time() == 0.0
    assert (clock.wall_ns() - true()) / 1e9 == pytest.approx(step_s, abs=STEP_TOLERANCE_S)


def test_a_slewing_clock_is_followed_silently(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    true: Callable[[], int] = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: true() + int(0.5 * ADOPT_S * 1e9))
    assert clock.adopt_system_time() == 0.0
    assert clock.wall_ns() - true() > 0.4 * ADOPT_S * 1e9


def test_a_thread_that_is_preempted_between_two_clocks_notices_no_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    true: Callable[[], int] = time.monotonic_ns
    late_ns = iter([200_000_000, 0, 0] * 2)  # the first reading of either call comes too late
    monkeypatch.setattr(time, "monotonic_ns", lambda: true() + next(late_ns))
    clock = Clock()
    assert clock.adopt_system_time() == 0.0
    monkeypatch.undo()
    assert abs(clock.wall_ns() - time.time_ns()) / 1e9 < STEP_TOLERANCE_S


def test_a_dead_process_is_not_running_even_before_it_is_buried() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    pid = process.pid
    try:
        until("it has died", lambda: not is_running(pid))
    finally:
        process.wait()
    assert not is_running(pid)
    assert is_running(os.getpid())


def test_unknown_fields_of_headers_and_records_are_counted_and_named_for_each_sender() -> None:
    state = records.encode(GripperState(0.04, False, False))
    later = message.pack({**message.unpack(state), "temperature": 30.0})
    with two_sessions() as (profile, one, other):
        node = Node("command", profile, one)
        key = profile.keys.state_gripper
        ring = node.subscribe(key, CallbackRing(8, 1000))
        events: list[str] = []
        other.declare_subscriber(
            profile.keys.event("command"),
            lambda sample: events.append(records.decode(Event, sample.payload.to_bytes()).why),
        )
        publisher = other.declare_publisher(key)
        await_match(other, key)
        for source, payload, more in (
            ("old#1", state, {}),
            ("new#1", state, {"hop": 1}),
            ("new#1", state, {"hop": 2}),
            ("newer#1", later, {"hop": 1, "lane": 2}),
        ):
            header = message.unpack(records.encode_header(Header(time.time_ns(), 1, source)))
            publisher.put(payload, attachment=message.pack({**header, **more}))
        arrivals: list[ReceivedSample] = []

        def all_there() -> bool:
            arrivals.extend(ring.drain())
            return len(arrivals) == 4

        until("all arrived", all_there)
        read = [node.decode(GripperState, arrival) for arrival in arrivals]
        assert None not in read
        assert node.counters["unknown_fields"] == 5
        until("both were named", lambda: len(events) == 2)
        node.close()
    assert events[0].startswith("new#1 sends ")
    assert events[1].startswith("newer#1 sends ")
