"""What is written into a recording comes out again, here and in other people's readers."""

from __future__ import annotations

import errno
import io
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from random_records import RECORDS
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from vla_zenoh.codec import records
from vla_zenoh.codec.image import encode_jpeg, encode_raw, raw_schema
from vla_zenoh.errors import RecordingError
from vla_zenoh.keys import SCHEMA, Keys
from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.lab.recording.sample import JPEG, MSGPACK, TEXT, Sample, received_sample
from vla_zenoh.lab.recording.writer import RecordingWriter, topic_of
from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import (
    ActionChunk,
    Event,
    GripperCommand,
    GripperState,
    Header,
    Image,
    InferenceDebug,
    JointCommand,
    JointState,
    NodeStatus,
    ObjectPoses,
    PoseCommand,
    PoseState,
    PrivilegedState,
    SceneState,
    Task,
)

KEYS = Keys("panda")
START_NS = 1_700_000_000_000_000_000
FILE_LIMIT_BYTES = 3_000_000
KEY_OF: dict[type, str] = {
    JointState: KEYS.state_joint,
    PoseState: KEYS.state_pose,
    GripperState: KEYS.state_gripper,
    PrivilegedState: KEYS.state_privileged,
    PoseCommand: KEYS.command_pose,
    JointCommand: KEYS.command_joint,
    GripperCommand: KEYS.command_gripper,
    Task: KEYS.task,
    ActionChunk: KEYS.delta("scripted"),
    ModelSpec: KEYS.spec("scripted"),
    NodeStatus: KEYS.status("worker-scripted"),
    Event: KEYS.event("command"),
    SceneState: KEYS.sim_scene,
    ObjectPoses: KEYS.sim_objects,
    InferenceDebug: KEYS.seen_record("scripted"),
}
EXAMPLES = settings(
    max_examples=15,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def writer(path: Path) -> RecordingWriter:
    return RecordingWriter(
        path, KEYS, profile_yaml="about: test\n", base_frame="base", began_ns=START_NS
    )


def sample(key: str, payload: bytes, encoding: str, index: int = 0) -> Sample:
    stamp = Header(START_NS + index * 10_000_000, index, "node#1")
    return Sample(key, payload, encoding, stamp, START_NS + index * 10_000_000 + 1_000_000)


def pose(index: int = 0) -> Sample:
    state = PoseState(np.array([0.4, 0.0, 0.1 + 0.001 * index]), np.eye(4)[3], np.zeros(6))
    return sample(KEYS.state_pose, records.encode(state), MSGPACK, index)


def picture(index: int = 0) -> Sample:
    rng = np.random.default_rng(index)
    jpeg = encode_jpeg(Image(rng.integers(0, 255, (120, 160, 3), np.uint8)))
    return sample(KEYS.camera_jpeg("front"), jpeg, JPEG, index)


def prompt(text: str) -> Sample:
    return Sample(KEYS.prompt, text.encode(), TEXT, None, START_NS)


def chunk(index: int = 0) -> Sample:
    steps = np.full((2, 7), 0.01, np.float32)
    stamps = (START_NS, 3, START_NS + 5, steps, START_NS + 1, START_NS + 2, START_NS + 3)
    record = ActionChunk("scripted", "0123", 1, *stamps)
    return sample(KEYS.delta("scripted"), records.encode(record), MSGPACK, index)


def written(path: Path, *samples: Sample) -> Path:
    path.unlink(missing_ok=True)
    out = writer(path)
    for each in samples:
        out.write(each)
    out.finish({"dropped": {}})
    return path


@pytest.mark.parametrize("kind", list(RECORDS), ids=lambda kind: kind.__name__)
@EXAMPLES
@given(data=st.data())
def test_every_record_comes_back_byte_for_byte(kind: type, tmp_path: Path, data: Any) -> None:
    payload = records.encode(data.draw(RECORDS[kind]))
    put = sample(KEY_OF[kind], payload, MSGPACK)
    (entry,) = open_recording(written(tmp_path / "run.mcap", put)).entries()
    assert entry.kind is kind
    assert entry == put


def test_pictures_and_settings_come_back_byte_for_byte(tmp_path: Path) -> None:
    raw = Image(np.arange(60, dtype=np.uint8).reshape(4, 5, 3))
    pixels = sample(KEYS.camera_raw("front"), encode_raw(raw), f"zenoh/bytes;{raw_schema(raw)}")
    put = [prompt("öffne den Greifer"), prompt(""), picture(), pixels]  # as they were received
    assert list(open_recording(written(tmp_path / "a.mcap", *put)).entries()) == put


@EXAMPLES
@given(
    payload=st.binary(max_size=200),
    attachment=st.none() | st.binary(max_size=60),
    encoding=st.sampled_from([MSGPACK, JPEG, TEXT, "zenoh/bytes", "zenoh/bytes;rgb8;2x2", "x"]),
    key=st.sampled_from([*KEY_OF.values(), KEYS.camera_raw("a"), KEYS.prompt, "other/x", "vla/a"]),
)
def test_what_a_stranger_puts_is_kept_as_it_was(
    tmp_path: Path, payload: bytes, attachment: bytes | None, encoding: str, key: str
) -> None:
    put = received_sample(key, payload, encoding, attachment, START_NS)
    (entry,) = open_recording(written(tmp_path / "a.mcap", put)).entries()
    assert entry == put


def test_a_header_that_fits_into_no_message_is_kept(tmp_path: Path) -> None:
    far = Header(2**62, 2**40, "camera#1")
    put = Sample(KEYS.camera_jpeg("front"), picture().payload, JPEG, far, START_NS)
    nameless = Sample(KEYS.state_pose, pose().payload, MSGPACK, Header(5, 5, ""), START_NS)
    found = open_recording(written(tmp_path / "a.mcap", put, nameless)).entries()
    assert [(entry.header, entry.payload) for entry in found] == [
        (far, put.payload),
        (nameless.header, nameless.payload),
    ]


def test_no_key_of_another_program_ends_the_writing_or_the_reading(tmp_path: Path) -> None:
    ours = (KEYS.camera_jpeg("front"), KEYS.state_pose, KEYS.delta("scripted"), KEYS.seen("a", "b"))
    parts = [each.split("/") for each in ours]
    cut = {"/".join(words[:end]) for words in parts for end in range(1, len(words))}
    cut |= {"/".join(words[at:]) for words in parts for at in range(1, len(words))}
    cut |= {"/".join([*words[:3], "front left", *words[4:]]) for words in parts}
    like = (picture(), pose(), chunk(), prompt("hold"))
    put = [replace(sample, key=key) for key in sorted(cut) for sample in like]
    path = written(tmp_path / "a.mcap", *put, pose())
    found = [(each.key, each.payload) for each in open_recording(path).entries()]
    assert sorted(found) == sorted((each.key, each.payload) for each in (*put, pose()))
    assert len(load_run(path).poses) == 1


def test_a_recording_of_another_version_of_the_wire_is_rejected_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    about = {"schema": "1", "version": "0.9"}
    RecordingWriter(
        path, KEYS, profile_yaml="about: test\n", base_frame="base", began_ns=START_NS, about=about
    ).finish({"dropped": {}})
    with pytest.raises(RecordingError, match=r"version 1 of the wire, .* reads 2: use .*0\.9"):
        open_recording(path)


def test_facts_profile_and_order_are_kept(tmp_path: Path) -> None:
    put = [prompt("hold"), *[each(i) for i in range(40) for each in (pose, picture, chunk)]]
    run = open_recording(written(tmp_path / "a.mcap", *put))
    assert run.profile_yaml == "about: test\n"
    assert (run.keys, run.about["schema"]) == (KEYS, str(SCHEMA))
    assert list(run.entries()) == put
    assert (run.damage, run.ended) == ("", {"dropped": {}})


def test_a_file_without_samples_is_whole(tmp_path: Path) -> None:
    run = open_recording(written(tmp_path / "a.mcap"))
    assert list(run.entries()) == []
    assert (run.damage, run.ended) == ("", {"dropped": {}})


def test_only_the_keys_that_are_wanted_are_read(tmp_path: Path) -> None:
    run = open_recording(written(tmp_path / "a.mcap", pose(), picture(), chunk()))
    assert [e.key for e in run.entries(lambda key: "state" in key)] == [KEYS.state_pose]


# -- other people's readers -----------------------------------------------------------------------
def test_the_mcap_reader_sees_topics_types_attachment_and_index(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", pose(), picture(), prompt("hold"), chunk())
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 5
        types = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
        assert types == {
            "/vla/panda/state/pose": "geometry_msgs/msg/PoseStamped",
            "/vla/panda/state/pose/full": "std_msgs/msg/String",
            "/vla/panda/camera/front/jpeg": "sensor_msgs/msg/CompressedImage",
            "/vla/panda/prompt": "std_msgs/msg/String",
            "/vla/panda/delta/scripted": "std_msgs/msg/String",
        }
        assert reader.get_header().profile == "ros2"
        (attachment,) = reader.iter_attachments()
        assert (attachment.name, attachment.data) == ("profile.yaml", b"about: test\n")
        times = [message.log_time for _, _, message in reader.iter_messages()]
        assert times == sorted(times)


def test_rosbags_reads_every_message_by_the_definitions_in_the_file(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", pose(3), picture(3), prompt("hold"), chunk(3))
    store = get_typestore(Stores.EMPTY)
    found: dict[str, Any] = {}
    with Reader(path) as bag:
        for connection in bag.connections:
            store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, _, data in bag.messages():
            found[connection.topic] = store.deserialize_cdr(data, connection.msgtype)
    shown = found["/vla/panda/state/pose"]
    assert (shown.pose.position.z, shown.header.frame_id) == (0.1 + 0.001 * 3, "base")
    assert shown.header.stamp.nanosec == 30_000_000
    image = found["/vla/panda/camera/front/jpeg"]
    assert (image.format, image.header.frame_id) == ("jpeg", "front")
    assert image.data.tobytes() == picture(3).payload
    assert found["/vla/panda/prompt"].data == "hold"
    full = json.loads(found["/vla/panda/delta/scripted"].data)
    assert full["worker"] == "scripted"
    assert np.shape(full["steps"]) == (2, 7)


def test_standard_messages_are_those_of_ros_2(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", pose(), picture(), prompt("hold"))
    humble = get_typestore(Stores.ROS2_HUMBLE)
    with Reader(path) as bag:
        for connection in bag.connections:
            wanted, _ = humble.generate_msgdef(connection.msgtype, ros_version=2)
            assert connection.msgdef.data == wanted


@pytest.mark.parametrize(
    ("key", "topic"),
    [
        ("vla/panda/status/worker-my.model", "/vla/panda/status/worker_my_model"),
        ("vla/panda/camera/2nd/jpeg", "/vla/panda/camera/_2nd/jpeg"),
    ],
)
def test_topics_have_names_that_ros_2_allows(key: str, topic: str) -> None:
    assert topic_of(key) == topic


# -- files that are not whole ---------------------------------------------------------------------
def readable_anywhere(path: Path) -> int:
    """Messages that the mcap package and rosbags find in the file; both must find the same."""
    with path.open("rb") as file:
        count = sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
    with Reader(path) as bag:
        assert sum(1 for _ in bag.messages()) == count
    return count


def test_a_file_nobody_finished_is_whole_up_to_the_last_commit(tmp_path: Path) -> None:
    out = writer(tmp_path / "a.mcap")
    for index in range(10):
        out.write(chunk(index))
    out.commit()
    out.write(chunk(10))
    run = open_recording(tmp_path / "a.mcap")
    assert len(list(run.entries())) == 10
    assert run.ended is None
    assert run.damage == "not finished: its recorder still runs, or was killed"
    assert readable_anywhere(tmp_path / "a.mcap") == 10
    out.abandon()


@pytest.mark.parametrize("missing", [1, 30, 400, 3000])
def test_a_file_that_was_cut_off_gives_what_it_has_and_says_so(
    tmp_path: Path, missing: int
) -> None:
    out = writer(tmp_path / "a.mcap")
    for index in range(30):
        out.write(picture(index))
        out.commit()
    out.finish()
    whole = (tmp_path / "a.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[:-missing])
    run = open_recording(cut)
    assert 28 <= len(list(run.entries())) <= 30
    assert "cut off or damaged after" in run.damage


def rewritten(path: Path, order: Callable[[Message], Any], compression: CompressionType) -> Path:
    """The file as another tool writes it: attachment first, metadata last, messages by `order`."""
    with path.open("rb") as file:
        records = list(StreamReader(file).records)
    other = path.with_name("rewritten.mcap")
    out = Writer(str(other), chunk_size=2000, compression=compression)
    out.start()
    (attachment,) = (one for one in records if isinstance(one, Attachment))
    stamps = (attachment.create_time, attachment.log_time)
    out.add_attachment(*stamps, attachment.name, attachment.media_type, attachment.data)
    schemas = {one.id: one for one in records if isinstance(one, Schema)}
    channels = {one.id: one for one in records if isinstance(one, Channel)}
    known: dict[int, int] = {}
    for message in sorted((one for one in records if isinstance(one, Message)), key=order):
        channel = channels[message.channel_id]
        if channel.id not in known:
            schema = schemas[channel.schema_id]
            number = out.register_schema(schema.name, schema.encoding, schema.data)
            encoding, facts = channel.message_encoding, channel.metadata
            known[channel.id] = out.register_channel(channel.topic, encoding, number, facts)
        times = (message.log_time, message.data, message.publish_time, message.sequence)
        out.add_message(known[channel.id], *times)
    for one in {one.name: one for one in records if isinstance(one, Metadata)}.values():
        out.add_metadata(one.name, one.metadata)
    out.finish()
    return other


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize(
    "order",
    [
        pytest.param(lambda message: message.log_time, id="time"),
        pytest.param(lambda message: -message.log_time, id="backwards"),
        pytest.param(lambda message: (message.channel_id, message.log_time), id="channel"),
    ],
)
def test_a_file_that_another_tool_wrote_anew_is_read_in_the_order_of_reception(
    tmp_path: Path, order: Callable[[Message], Any], compression: CompressionType
) -> None:
    put = [prompt("hold"), *[each(i) for i in range(40) for each in (pose, picture, chunk)]]
    run = open_recording(rewritten(written(tmp_path / "a.mcap", *put), order, compression))
    assert (run.profile_yaml, run.keys) == ("about: test\n", KEYS)

    def moment(entry: Sample) -> tuple[int, str]:
        return entry.received_ns, entry.key

    found = list(run.entries())
    assert [entry.received_ns for entry in found] == [entry.received_ns for entry in put]
    assert sorted(found, key=moment) == sorted(put, key=moment)
    assert (run.damage, run.ended) == ("", {"dropped": {}})


def test_one_damaged_chunk_of_a_whole_file_is_left_out_counted_and_named(tmp_path: Path) -> None:
    put = [each(i) for i in range(40) for each in (pose, picture)]
    path = rewritten(
        written(tmp_path / "a.mcap", *put), lambda one: one.log_time, CompressionType.ZSTD
    )
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    broken = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
    data = bytearray(path.read_bytes())
    data[broken.chunk_start_offset + broken.chunk_length // 2] ^= 0xFF
    path.write_bytes(data)
    run = open_recording(path)
    found = list(run.entries())
    lost = len(put) - len(found)
    assert 1 <= lost <= 4
    assert [entry.received_ns for entry in found[-3:]] == [entry.received_ns for entry in put[-3:]]
    assert f"damaged: 1 of {len(summary.chunk_indexes)} chunks cannot be read" in run.damage
    assert "messages from 0.2 to 0.2 s" in run.damage
    assert "/vla/panda/camera/front/jpeg" in run.damage
    assert run.ended == {"dropped": {}}


def test_damage_in_the_middle_is_noticed(tmp_path: Path) -> None:
    out = writer(tmp_path / "a.mcap")
    for index in range(30):
        out.write(picture(index))
        out.commit()
    out.finish()
    whole = bytearray((tmp_path / "a.mcap").read_bytes())
    whole[len(whole) // 2] ^= 0xFF
    (tmp_path / "a.mcap").write_bytes(whole)
    run = open_recording(tmp_path / "a.mcap")
    assert 0 < len(list(run.entries())) < 30
    assert run.damage


WRITE_FOR_EVER = """
import itertools, sys
sys.path[:0] = [{tests!r}, {rigs!r}]
from pathlib import Path
from test_recording_file import picture, writer
out = writer(Path({path!r}))
for index in itertools.count():
    out.write(picture(index))
    if index % 20 == 19:
        out.commit()
        print(out.size, flush=True)
"""


def test_kill_9_leaves_a_file_that_any_tool_opens(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    here = Path(__file__).parent
    code = WRITE_FOR_EVER.format(tests=str(here), rigs=str(here.parents[1]), path=str(path))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for _ in range(10):
        size = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    process.wait(10)
    process.stdout.close()
    assert path.stat().st_size >= size
    assert readable_anywhere(path) >= 200
    assert open_recording(path).damage == ""


def write_many(out: RecordingWriter) -> None:
    for index in range(1000):
        out.write(picture(index))


def test_a_full_disk_leaves_a_file_that_any_tool_opens(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    out = writer(path)
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_LIMIT_BYTES, before[1]))
    try:
        with pytest.raises(RecordingError, match="too large; what was recorded until then is w"):
            write_many(out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    out.abandon()
    assert path.stat().st_size <= FILE_LIMIT_BYTES
    assert path.stat().st_size > 0.5 * FILE_LIMIT_BYTES
    assert readable_anywhere(path) > 20
    assert open_recording(path).damage == ""


def test_a_disk_that_is_gone_is_named_as_a_full_one_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(*_: Any) -> int:
        raise OSError(errno.EIO, "Input/output error")

    out = writer(tmp_path / "a.mcap")
    out.write(pose())
    monkeypatch.setattr(os, "pwrite", gone)
    with pytest.raises(RecordingError, match="Input/output error; what was recorded until then"):
        out.commit()


def test_a_disk_that_is_full_at_the_end_costs_the_index_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    out = writer(path)
    for index in range(5):
        out.write(picture(index))
    out.commit()
    resource.setrlimit(resource.RLIMIT_FSIZE, (out.size, before[1]))
    try:
        with pytest.raises(RecordingError, match="too large"):
            out.finish()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    out.abandon()
    assert readable_anywhere(path) == 5


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a file system: needs root")
def test_a_full_file_system_leaves_a_file_that_any_tool_opens(tmp_path: Path) -> None:
    small = tmp_path / "small"
    small.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(small)],
        capture_output=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.decode()}")
    try:
        out = writer(small / "a.mcap")
        with pytest.raises(RecordingError, match="No space left"):
            write_many(out)
        out.abandon()
        assert readable_anywhere(small / "a.mcap") > 20
    finally:
        subprocess.run(["umount", str(small)], check=True)


def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written"):
        writer(tmp_path / "file" / "a.mcap")


# -- other files ----------------------------------------------------------------------------------
def test_a_file_that_is_no_mcap_is_said(tmp_path: Path) -> None:
    for content in (b"", b"hello", b"x" * 1000):
        (tmp_path / "a.mcap").write_bytes(content)
        with pytest.raises(RecordingError, match="is not an MCAP file"):
            open_recording(tmp_path / "a.mcap")
    with pytest.raises(RecordingError, match="cannot be read: No such file"):
        open_recording(tmp_path / "b.mcap")


def test_a_foreign_mcap_is_said_with_its_topics(tmp_path: Path) -> None:
    from mcap.writer import Writer

    buffer = io.BytesIO()
    out = Writer(buffer)
    out.start("ros1")
    channel = out.register_channel("/scan", "ros1", 0)
    out.add_message(channel, 1, b"", 1)
    out.finish()
    (tmp_path / "a.mcap").write_bytes(buffer.getvalue())
    with pytest.raises(RecordingError, match=r"of another program \(topics: /scan\)"):
        open_recording(tmp_path / "a.mcap")


def test_a_header_is_told_from_other_attachments() -> None:
    header = Header(5, 6, "camera#1")
    assert received_sample("k", b"", "x", records.encode_header(header), 7).header == header
    assert received_sample("k", b"", "x", b"\xff", 7).attached == b"\xff"
    assert received_sample("k", b"", "x", None, 7).attached is None
