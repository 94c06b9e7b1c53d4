"""Writes samples into an MCAP file.

Each key is a topic of the same name: ``/vla/panda/camera/front/jpeg`` with ROS 2's
``CompressedImage``; depth pictures are such images of ``16UC1``, with the metres of a count in the
channel's metadata. A record is JSON in a ``std_msgs/String`` (see `record_json`), under the key's
name; a record that a standard message shows, such as a pose, has that message under the key's name
and its JSON under ``<name>/full``. Bytes that are no record are JSON under ``<name>/bytes``.

A channel belongs to one writer: its metadata name the key, the source, and what the JSON holds. The
message's sequence number is the header's, the publish time its stamp, the log time that of
reception. Nothing of a sample is lost.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from vla_zenoh import __version__, keys
from vla_zenoh.codec import image as image_codec
from vla_zenoh.errors import CodecError, RecordingError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording import ros2_messages
from vla_zenoh.lab.recording.record_types import bytes_to_json, record_of, record_to_json
from vla_zenoh.lab.recording.ros2_messages import serialize, standard_message
from vla_zenoh.lab.recording.sample import DEPTH, JPEG, MSGPACK, RAW, Sample


def _end() -> bytes:
    builder = RecordBuilder()
    DataEnd(0).write(builder)
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
    return builder.end() + MCAP0_MAGIC


END = _end()
"""What ends an MCAP file without a summary."""


class CrashSafeFile:
    """Output stream of the MCAP writer: kept in memory until `commit`.

    Args:
        path: of the file, which must not exist or be empty.

    Raises:
        RecordingError: the file exists or cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._waiting, self._done = path, BytesIO(), 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
        except OSError as error:
            raise RecordingError(f"{path} cannot be written: {error.strerror}") from error
        if os.fstat(self._file).st_size:
            self.close()
            raise RecordingError(f"{path} exists and is not overwritten")

    # -- for the MCAP writer ------------------------------------------------------------------
    def write(self, data: bytes) -> int:
        return self._waiting.write(data)

    def tell(self) -> int:
        """Position in the file after `commit`."""
        return self._done + self._waiting.tell()

    def flush(self) -> None:
        """Do nothing; `commit` writes."""

    # -- for us -------------------------------------------------------------------------------
    @property
    def size(self) -> int:
        """Size of the file on disk, in bytes."""
        return self._done + len(END)

    @property
    def waiting(self) -> int:
        """Number of bytes that `commit` would write."""
        return self._waiting.tell()

    def commit(self, *, last: bool = False) -> None:
        """Write the bytes so far. If they do not fit, the file stays as it was.

        Args:
            last: the MCAP writer has already written the end of the file.

        Raises:
            RecordingError: the disk is full, or broken.
        """
        data = self._waiting.getvalue()
        self._waiting = BytesIO()
        try:
            self._put(data if last else data + END)
        except OSError as error:
            until_then = "is whole" if self._put_end_again() else "may lack its end"
            raise RecordingError(
                f"{self._path}: {error.strerror}; what was recorded until then {until_then} "
                f"({self.size / 1e6:.1f} MB)"
            ) from error
        self._done += len(data) - (len(END) if last else 0)

    def _put(self, data: bytes) -> None:
        written = 0
        while written < len(data):
            written += os.pwrite(self._file, data[written:], self._done + written)

    def _put_end_again(self) -> bool:
        """Whether the file ends as after the last `commit`: a disk that is gone takes nothing, nor
        does a full one that writes no byte in place."""
        try:
            if self._done:  # the bytes were there before: mostly no room is needed
                os.pwrite(self._file, END, self._done)
                os.ftruncate(self._file, self._done + len(END))
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Close the file; bytes since the last `commit` are lost. Closing twice does nothing."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


ABOUT, ENDED = "vla_zenoh", "vla_zenoh.ended"
"""Names of the MCAP metadata records at the start and end of a file."""
CLOCK_SET = "clock_set_ns"
"""Metadata of a file: what its times of reception lack to the wall clock at its start."""
PROFILE_FILE = "profile.yaml"
FULL, BYTES = "full", "bytes"
CHUNK_BYTES = 1024 * 1024
MAX_SEQ = 2**32
_NOT_ROS = re.compile(r"[^A-Za-z0-9_/]")
_DIGIT_FIRST = re.compile(r"(?<=/)(?=[0-9])")


def topic_of(key: str, *below: str) -> str:
    """Topic name for a key: characters that ROS 2 does not allow become ``_``."""
    return _DIGIT_FIRST.sub("_", _NOT_ROS.sub("_", "/" + "/".join((key, *below))))


class RecordingWriter:
    """Writes the samples of a run into an MCAP file that any tool can open at any time.

    Args:
        path: of the file, which must not exist or be empty.
        robot: its keys; other robots below the same root are written as well.
        base_frame: ``frame_id`` of poses.
        began_ns: start of the recording, wall clock.

    Raises:
        RecordingError: the file exists or cannot be created.
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
        ros2_messages.messages()
        self._robot, self._frame = robot, base_frame
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[Any, ...], int] = {}
        self.counts: Counter[str] = Counter()
        """Samples by key."""
        self._file = CrashSafeFile(path)
        # The MCAP writer calls no more of a stream than `CrashSafeFile` has.
        self._out = Writer(self._file, CHUNK_BYTES, CompressionType.ZSTD)  # pyright: ignore
        self._out.start("ros2", f"vla-zenoh {__version__}")
        facts = {"version": __version__, "schema": str(keys.SCHEMA), "root": robot.root}
        facts |= {"robot": robot.robot, "began_ns": str(began_ns), **(about or {})}
        self._out.add_metadata(ABOUT, facts)
        self._out.add_attachment(
            began_ns, began_ns, PROFILE_FILE, "application/yaml", profile_yaml.encode()
        )
        try:
            self._file.commit()
        except RecordingError:
            self._file.close()
            raise

    @property
    def size(self) -> int:
        """Size of the file on disk, in bytes."""
        return self._file.size

    def write(self, sample: Sample) -> None:
        """Add a sample; it is on disk after the next `commit`, or once a chunk is full.

        Raises:
            RecordingError: the disk is full. The file is complete and takes no more.
        """
        self.counts[sample.key] += 1
        try:
            self._write_message(sample)
        except CodecError:
            self._put_json(sample, bytes_to_json(sample.payload, sample.attached), BYTES, BYTES)
        if self._file.waiting > CHUNK_BYTES:
            self._file.commit()

    def commit(self) -> None:
        """Write all samples so far to disk.

        Raises:
            RecordingError: the disk is full. The file is complete and takes no more.
        """
        self._out.flush()
        if self._file.waiting:
            self._file.commit()

    def finish(self, ended: Mapping[str, Any] | None = None) -> None:
        """Write the index and close the file.

        Args:
            ended: metadata known at the end, such as the number of dropped samples.

        Raises:
            RecordingError: the disk is full. The file is complete but has no index.
        """
        try:
            facts = {name: json.dumps(value) for name, value in (ended or {}).items()}
            self._out.add_metadata(ENDED, facts)
            self._out.finish()
            self._file.commit(last=True)
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file as it is on disk; samples since the last commit are lost."""
        self._file.close()

    # -- one sample ---------------------------------------------------------------------------
    def _write_message(self, sample: Sample) -> None:
        header, encoding = sample.header, sample.encoding
        if header is None:
            self._write_setting(sample)
        elif header.seq >= MAX_SEQ or not header.source:
            raise CodecError("invalid", "the header does not fit into the fields of a message")
        elif encoding == JPEG:
            self._write_compressed(sample, "jpeg")
        elif encoding.startswith(DEPTH):
            self._write_compressed(sample, "16UC1; png compressed")
        elif encoding.startswith(RAW):
            self._write_raw(sample)
        else:
            self._write_record(sample)

    def _write_setting(self, sample: Sample) -> None:
        # Any client may publish a setting, most without the encoding of text.
        if sample.attachment is not None or self._record_type(sample.key) is not None:
            raise CodecError("malformed", "not a setting")
        try:
            text = sample.payload.decode()
        except UnicodeError as error:
            raise CodecError("malformed", "a setting is UTF-8 text") from error
        self._put(sample, ros2_messages.TEXT, serialize(ros2_messages.TEXT, text))

    def _write_compressed(self, sample: Sample, form: str) -> None:
        header = ros2_messages.header(sample.stamp_ns, _camera(sample.key))
        data = np.frombuffer(sample.payload, np.uint8)
        name = ros2_messages.JPEG_IMAGE
        self._put(sample, name, serialize(name, header, form, data))

    def _write_raw(self, sample: Sample) -> None:
        image = image_codec.decode_raw(sample.payload, sample.encoding.partition(";")[2])
        height, width, _ = image.rgb.shape
        header = ros2_messages.header(sample.stamp_ns, _camera(sample.key))
        pixels = np.frombuffer(sample.payload, np.uint8)
        name = ros2_messages.IMAGE
        data = serialize(name, header, height, width, "rgb8", 0, 3 * width, pixels)
        self._put(sample, name, data)

    def _write_record(self, sample: Sample) -> None:
        kind = self._record_type(sample.key)
        if kind is None or sample.encoding != MSGPACK:
            raise CodecError("malformed", "not a record")
        text, fields = record_to_json(kind, sample.payload)
        shown = standard_message(kind, fields, sample.stamp_ns, self._frame)
        self._put_json(sample, text, kind.__name__, *([FULL] if shown else []))
        if shown is not None:
            self._put(sample, *shown, shows=True)

    def _record_type(self, key: str) -> type | None:
        robot = Keys.of(key, self._robot.root)
        return None if robot is None else record_of(robot.short(key))

    # -- MCAP ---------------------------------------------------------------------------------
    def _put_json(self, sample: Sample, text: str, json_of: str, *below: str) -> None:
        self._put(
            sample, ros2_messages.TEXT, serialize(ros2_messages.TEXT, text), *below, json_of=json_of
        )

    def _put(
        self,
        sample: Sample,
        schema: str,
        data: bytes,
        *below: str,
        json_of: str = "",
        shows: bool = False,
    ) -> None:
        header = sample.header
        # As MCAP keeps it: an encoding is whatever bytes its writer chose.
        encoding = sample.encoding.encode("utf-8", "replace").decode()
        facts = {
            "shows" if shows else "key": sample.key,
            "source": "" if header is None else header.source,
            "encoding": encoding,
            "json": json_of,
        }
        channel = (schema, *facts.items(), *below)
        if channel not in self._channels:
            if schema not in self._schemas:
                text = ros2_messages.schema_text(schema)
                self._schemas[schema] = self._out.register_schema(schema, "ros2msg", text)
            topic = topic_of(sample.key, *below)
            self._channels[channel] = self._out.register_channel(
                topic, "cdr", self._schemas[schema], facts
            )
        seq = 0 if header is None else header.seq
        self._out.add_message(
            self._channels[channel], sample.received_ns, data, sample.stamp_ns, seq % MAX_SEQ
        )


def _camera(key: str) -> str:
    return "/".join(key.split("/")[-2:-1])
