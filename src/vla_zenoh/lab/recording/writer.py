"""Samples into an MCAP file.

Each key is a channel, named after it: ``/vla/panda/camera/front/jpeg`` with ROS 2's
``CompressedImage``. A record that a standard message shows, such as a pose, has two: the standard
message under the key's name, and all that was said under ``<name>/full``, see `definitions`. Other
records have the latter alone, under the key's name. A channel is that of one writer: its metadata
say the key and the source, the message's sequence number is the header's, and the publish time is
the header's stamp. So nothing of a sample is lost; what fits into no message (a stranger's bytes)
is kept as ``vla_zenoh_msgs/msg/Sample``.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from vla_zenoh import __version__, keys
from vla_zenoh.codec import image as image_codec
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording import cdr
from vla_zenoh.lab.recording.crash_safe_file import CrashSafeFile
from vla_zenoh.lab.recording.definitions import SAMPLE_NAME, Unfit, type_name
from vla_zenoh.lab.recording.record_types import RecordTypes
from vla_zenoh.lab.recording.sample import JPEG, MSGPACK, RAW, Sample
from vla_zenoh.lab.recording.views import VIEWS

ABOUT, ENDED = "vla_zenoh", "vla_zenoh.ended"
"""Names of the metadata at the beginning and at the end."""
PROFILE_FILE = "profile.yaml"
FULL = "full"
CHUNK_BYTES = 1024 * 1024
MAX_SEQ = 2**32
_NOT_ROS = re.compile(r"[^A-Za-z0-9_/]")
_DIGIT_FIRST = re.compile(r"(?<=/)(?=[0-9])")


def topic_of(key: str, *below: str) -> str:
    """A key as a topic's name that ROS 2 allows: other characters than letters, digits become _."""
    return _DIGIT_FIRST.sub("_", _NOT_ROS.sub("_", "/" + "/".join((key, *below))))


class RecordingWriter:
    """See the module.

    Args:
        path: of the file; one that is there is overwritten.
        robot: its keys; other robots below the same root are written as well.
        profile_yaml: the profile in force, kept as an attachment.
        base_frame: ``frame_id`` of poses.
        began_ns: wall clock.
        about: what else is to be known of the run.

    Raises:
        RecordingError: the file cannot be made.
        MissingExtraError: rosbags is not installed.
    """

    def __init__(
        self,
        path: Path,
        robot: Keys,
        *,
        profile_yaml: str,
        base_frame: str,
        began_ns: int,
        about: Mapping[str, str] | None = None,
    ) -> None:
        cdr.messages()
        self._robot, self._frame = robot, base_frame
        self._kinds: dict[str, RecordTypes] = {}
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, ...], int] = {}
        self.counts: Counter[str] = Counter()
        """Samples by key."""
        self._spool = CrashSafeFile(path)
        # The MCAP writer asks for no more of a stream than Spool can.
        self._out = Writer(self._spool, CHUNK_BYTES, CompressionType.ZSTD)  # pyright: ignore
        self._out.start("ros2", f"vla-zenoh {__version__}")
        facts = {"version": __version__, "schema": str(keys.SCHEMA), "root": robot.root}
        facts |= {"robot": robot.robot, "began_ns": str(began_ns), **(about or {})}
        self._out.add_metadata(ABOUT, facts)
        self._out.add_attachment(
            began_ns, began_ns, PROFILE_FILE, "application/yaml", profile_yaml.encode()
        )
        self._spool.commit()

    @property
    def size(self) -> int:
        """Bytes of the file as it is on the disk."""
        return self._spool.size

    def write(self, sample: Sample) -> None:
        """Take a sample; it is on the disk after the next `commit`, or when a chunk is full.

        Raises:
            RecordingError: the disk is full. The file is whole, and takes no more.
        """
        self.counts[sample.key] += 1
        try:
            self._write_message(sample)
        except Unfit:
            self._write_bytes(sample)
        if self._spool.waiting > CHUNK_BYTES:
            self._spool.commit()

    def commit(self) -> None:
        """Everything taken so far onto the disk.

        Raises:
            RecordingError: the disk is full. The file is whole, and takes no more.
        """
        self._out.flush()
        if self._spool.waiting:
            self._spool.commit()

    def finish(self, ended: Mapping[str, Any] | None = None) -> None:
        """Write the index and close the file.

        Args:
            ended: what is known in the end, such as how much was dropped.

        Raises:
            RecordingError: the disk is full. The file is whole, without an index.
        """
        try:
            facts = {name: json.dumps(value) for name, value in (ended or {}).items()}
            self._out.add_metadata(ENDED, facts)
            self._out.finish()
            self._spool.commit(last=True)
        finally:
            self._spool.close()

    def abandon(self) -> None:
        """Close the file as it is on the disk: what `write` took since the last commit is lost."""
        self._spool.close()

    # -- one sample ---------------------------------------------------------------------------
    def _write_message(self, sample: Sample) -> None:
        header, encoding = sample.header, sample.encoding
        if header is None:
            self._write_text(sample)
        elif header.seq >= MAX_SEQ or not header.source:
            raise Unfit
        elif encoding == JPEG:
            self._write_jpeg(sample)
        elif encoding.startswith(RAW):
            self._write_pixels(sample)
        elif encoding == MSGPACK:
            self._write_record(sample)
        else:
            raise Unfit

    def _write_text(self, sample: Sample) -> None:
        # Any client may put a setting, and few say that it is text.
        if sample.attachment is not None or self._kind(sample.key) is not None:
            raise Unfit
        try:
            text = sample.payload.decode()
            data = cdr.serialize(cdr.TEXT, text)
        except (UnicodeError, CodecError) as error:
            raise Unfit from error
        self._put(sample, cdr.TEXT, data)

    def _write_jpeg(self, sample: Sample) -> None:
        header = cdr.header(sample.stamp_ns, self._camera(sample.key))
        pixels = np.frombuffer(sample.payload, np.uint8)
        self._put(sample, cdr.JPEG_IMAGE, cdr.serialize(cdr.JPEG_IMAGE, header, "jpeg", pixels))

    def _write_pixels(self, sample: Sample) -> None:
        try:
            image = image_codec.decode_raw(sample.payload, sample.encoding.partition(";")[2])
        except CodecError as error:
            raise Unfit from error
        height, width, _ = image.rgb.shape
        header = cdr.header(sample.stamp_ns, self._camera(sample.key))
        pixels = np.frombuffer(sample.payload, np.uint8)
        values = (header, height, width, "rgb8", 0, 3 * width, pixels)
        self._put(sample, cdr.IMAGE, cdr.serialize(cdr.IMAGE, *values))

    def _camera(self, key: str) -> str:
        return key.split("/")[-2]

    def _write_record(self, sample: Sample) -> None:
        kind = self._kind(sample.key)
        if kind is None:
            raise Unfit
        fields = cdr.fields_in(kind, sample.payload)
        data = cdr.write_record(kind, fields, sample.stamp_ns, self._frame)
        if kind not in VIEWS:
            self._put(sample, type_name(kind), data)
            return
        shown, make = VIEWS[kind]
        try:
            view = make(fields, cdr.header(sample.stamp_ns, self._frame))
        except (TypeError, ValueError) as error:  # a stranger's array of another length
            raise Unfit from error
        self._put(sample, type_name(kind), data, FULL)
        self._put(sample, shown, view, shows=True)

    def _kind(self, key: str) -> type | None:
        robot = Keys.of(key, self._robot.root)
        if robot is None:
            return None
        if robot.robot not in self._kinds:
            self._kinds[robot.robot] = RecordTypes(robot)
        return self._kinds[robot.robot].of(key)

    def _write_bytes(self, sample: Sample) -> None:
        try:
            header = cdr.header(sample.received_ns, "")
        except Unfit:
            header = cdr.header(0, "")
        attachment = sample.attached
        attached = np.frombuffer(attachment or b"", np.uint8)
        payload = np.frombuffer(sample.payload, np.uint8)
        encoding = sample.encoding.encode("utf-8", "replace").decode()
        values = (header, encoding, attachment is not None, attached, payload)
        self._put(sample, SAMPLE_NAME, cdr.serialize(SAMPLE_NAME, *values), "bytes")

    # -- MCAP ---------------------------------------------------------------------------------
    def _put(
        self, sample: Sample, schema: str, data: bytes, *below: str, shows: bool = False
    ) -> None:
        header = sample.header
        source = "" if header is None else header.source
        channel = (sample.key, source, sample.encoding, schema, *below)
        if channel not in self._channels:
            self._channels[channel] = self._new_channel(
                channel, topic_of(sample.key, *below), shows
            )
        seq = 0 if header is None else header.seq
        self._out.add_message(
            self._channels[channel], sample.received_ns, data, sample.stamp_ns, seq % MAX_SEQ
        )

    def _new_channel(self, channel: tuple[str, ...], topic: str, shows: bool) -> int:
        key, source, encoding, schema, *_ = channel
        if schema not in self._schemas:
            self._schemas[schema] = self._out.register_schema(
                schema, "ros2msg", cdr.schema_text(schema)
            )
        facts = {"shows" if shows else "key": key, "source": source, "encoding": encoding}
        return self._out.register_channel(topic, "cdr", self._schemas[schema], facts)
