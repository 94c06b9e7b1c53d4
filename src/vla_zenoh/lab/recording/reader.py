"""Reads the samples of a recording in the order of reception.

A file with an index at its end is read by that: its parts may be in any order, as other tools write
them, and a damaged chunk is left out. One that was cut off has none and is read as far as it goes.
`Recording.damage` says what is missing. A folder of a saved rolling record is read as one
recording, its segments one after the other.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import count
from pathlib import Path
from typing import IO, Any, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError, RecordLengthLimitExceeded
from mcap.reader import SeekingReader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    Schema,
)
from mcap.records import Header as McapHeader
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.summary import Summary
from zstandard import ZstdError

from vla_zenoh.errors import CodecError, RecordError, RecordingError, counted
from vla_zenoh.keys import SCHEMA, Keys
from vla_zenoh.lab.recording import ros2_messages
from vla_zenoh.lab.recording.record_types import RECORDS, bytes_from_json, record_from_json
from vla_zenoh.lab.recording.sample import Sample, received_sample
from vla_zenoh.lab.recording.stamp_order import StampOrder
from vla_zenoh.lab.recording.writer import ABOUT, BYTES, CLOCK_SET, ENDED, PROFILE_FILE
from vla_zenoh.types import Header

MAX_RECORD_BYTES = 256 * 1024 * 1024
SHOWN_TOPICS = 6
SEGMENT = "segment-{:08d}.mcap"
SEGMENTS = "segment-*.mcap"
_KINDS = {kind.__name__: kind for kind in RECORDS}
_SCHEMAS = (ros2_messages.TEXT, ros2_messages.IMAGE, ros2_messages.JPEG_IMAGE)
_BROKEN = (
    OSError,  # an offset that is no place in a file
    *(McapError, CRCValidationError, ZstdError, struct.error),
    *(ValueError, EOFError, KeyError, OverflowError, UnicodeDecodeError, MemoryError),
    *(RuntimeError, IndexError),
)
"""What MCAP, zstd and lz4 raise for bytes that are none of theirs."""
OPCODE_AND_LENGTH, MAGIC_SIZE = 1 + 8, 8
FOOTER_SIZE = OPCODE_AND_LENGTH + 8 + 8 + 4

Read = TypeVar("Read", bound=McapRecord)


class Recording:
    """A recording on disk; `open_recording` opens one.

    Args:
        path: of the file, or of a folder of segments.
    """

    def __init__(self, path: Path, about: dict[str, str], profile_yaml: str) -> None:
        schema = about.get("schema")
        if schema != str(SCHEMA):
            raise RecordingError(
                f"{path} holds records of version {schema} of the wire, this program reads "
                f"{SCHEMA}: use the vla-zenoh that recorded it ({about.get('version')})"
            )
        self.path, self.about, self.profile_yaml = path, about, profile_yaml
        self.keys = Keys(about["robot"], about["root"])
        self.ended: dict[str, Any] | None = None
        """Metadata from its end, once `entries` has read it; None: the file was cut off."""
        self.damage = ""
        """What could not be read, and why; empty if everything was."""
        self.clock_steps: list[str] = []
        """Messages about clocks that were set back; later stamps are as if they had not been."""

    def entries(self, wanted: Callable[[str], bool] = lambda key: True) -> Iterator[Sample]:
        """Samples in the order of reception; see `damage` for what is missing.

        Args:
            wanted: whether to read a key; other keys are skipped undecoded.
        """
        order = StampOrder(self.keys)
        self.damage, self.ended = "", None
        self.clock_steps = self.clock_steps or order.steps
        missing = {"dropped": Counter[str](), "lost": Counter[str]()}
        set_ns = 0
        with suppress(ValueError):
            set_ns = int(self.about.get(CLOCK_SET, "0"))
        for path in segments_of(self.path) or [self.path]:
            self.ended = None
            for entry in self._entries_of(path, wanted):
                if set_ns:
                    entry = replace(entry, received_ns=entry.received_ns + set_ns)
                yield order.take(entry)
            if self.ended is None:
                self._note_damage("not finished: its recorder still runs, or was killed")
            for what, counts in missing.items():
                counts.update(self._missing(what))
        if self.ended is not None:
            self.ended |= {what: dict(found) for what, found in missing.items() if found}

    def _entries_of(self, path: Path, wanted: Callable[[str], bool]) -> Iterator[Sample]:
        schemas: dict[int, Schema] = {}
        channels: dict[int, _Source | None] = {}
        with path.open("rb") as file:
            for record in _records(file, self._note_damage):
                if isinstance(record, Message):
                    source = channels.get(record.channel_id)
                    if source is None:
                        continue
                    try:
                        entry = source.sample(record)
                    except CodecError as error:
                        self._note_damage(f"{source.key}: {error}")
                    else:
                        yield entry
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    source = _source(record, schemas)
                    channels[record.id] = source if source and wanted(source.key) else None
                elif isinstance(record, Metadata) and record.name == ENDED:
                    facts = record.metadata.items()
                    try:
                        self.ended = {name: json.loads(value) for name, value in facts}
                    except (ValueError, RecursionError) as error:
                        self._note_damage(f"its last facts are not JSON: {error}")

    def _note_damage(self, why: str) -> None:
        self.damage = self.damage or why

    @property
    def dropped(self) -> int:
        """Samples that the recorder dropped, once `entries` has read the end."""
        return sum(self._missing("dropped").values())

    def _missing(self, what: str) -> dict[str, int]:
        counts = (self.ended or {}).get(what)
        counted = counts.items() if isinstance(counts, dict) else ()
        return {key: count for key, count in counted if type(count) is int}


@dataclass(frozen=True, slots=True)
class _Source:
    """A channel of one key and writer.

    Args:
        writer: source in its headers; empty for settings.
        json_of: name of the record whose JSON a message holds, or `BYTES`; empty for the rest.
    """

    key: str
    writer: str
    encoding: str
    schema: str
    json_of: str

    def sample(self, message: Message) -> Sample:
        data = ros2_messages.deserialize(self.schema, message.data).data
        key, encoding, received_ns = self.key, self.encoding, message.log_time
        if self.json_of == BYTES:
            payload, attachment = bytes_from_json(data)
            return received_sample(key, payload, encoding, attachment, received_ns)
        header = None
        if self.writer:
            try:
                header = Header(message.publish_time, message.sequence, self.writer)
            except RecordError as error:
                raise CodecError("invalid", str(error)) from error
        kind, fields = _KINDS.get(self.json_of), None
        if kind is not None:
            payload, fields = record_from_json(kind, data)
        else:
            payload = data.encode() if self.schema == ros2_messages.TEXT else data.tobytes()
        return Sample(key, payload, encoding, header, received_ns, None, kind, fields)


def _source(channel: Channel, schemas: dict[int, Schema]) -> _Source | None:
    facts, schema = channel.metadata, schemas.get(channel.schema_id)
    if "key" not in facts or schema is None or schema.name not in _SCHEMAS:
        return None
    source, encoding, json_of = (facts.get(name, "") for name in ("source", "encoding", "json"))
    if json_of and (schema.name != ros2_messages.TEXT or json_of not in {*_KINDS, BYTES}):
        return None
    return _Source(facts["key"], source, encoding, schema.name, json_of)


def _records(file: IO[bytes], damage: Callable[[str], None]) -> Iterator[Any]:
    """MCAP records: messages in the order of reception, each after its channel and schema."""
    summary = _summary(file)
    if summary is None:
        file.seek(0)
        yield from _whole(file, damage)
        return
    yield from summary.schemas.values()
    yield from summary.channels.values()
    yield from _by_index(file, summary, damage)
    for index in summary.metadata_indexes:
        if index.name == ENDED:
            with suppress(*_BROKEN):
                yield _at(file, index.offset, Metadata)


def _facts(file: IO[bytes], damage: Callable[[str], None]) -> Iterator[Any]:
    """Metadata and attachments: by the index, then all records of the file, as far as needed."""
    summary = _summary(file)
    if summary is not None:
        with suppress(*_BROKEN):
            for index in summary.metadata_indexes:
                yield _at(file, index.offset, Metadata)
            for index in summary.attachment_indexes:
                if index.name == PROFILE_FILE:
                    found = _at(file, index.offset, Attachment)
                    yield found if _has_right_checksum(file, index) else replace(found, data=b"")
    file.seek(0)
    yield from _whole(file, damage)


def _has_right_checksum(file: IO[bytes], index: AttachmentIndex) -> bool:
    """Of an attachment; a writer may leave it out, as 0."""
    file.seek(index.offset + OPCODE_AND_LENGTH)
    data = file.read(index.length - OPCODE_AND_LENGTH)
    wanted = int.from_bytes(data[-4:], "little")
    return not wanted or zlib.crc32(data[:-4]) == wanted


def _summary(file: IO[bytes]) -> Summary | None:
    """The index at the end of a file; None if there is none, or it is incomplete."""
    file.seek(0)
    try:
        if not _is_summary_whole(file):
            return None
        file.seek(0)
        found = SeekingReader(file, record_size_limit=MAX_RECORD_BYTES).get_summary()
    except _BROKEN:
        return None
    if found is None or found.statistics is None:
        return None
    in_chunks = found.chunk_indexes or not found.statistics.message_count
    whole = len(found.chunk_indexes) == found.statistics.chunk_count
    return found if in_chunks and whole else None


def _is_summary_whole(file: IO[bytes]) -> bool:
    """Whether the checksum of the index is right; a writer may leave it out, as 0."""
    end = file.seek(-(FOOTER_SIZE + MAGIC_SIZE), os.SEEK_END)
    footer = file.read(FOOTER_SIZE)
    begin, _, wanted = struct.unpack("<QQI", footer[OPCODE_AND_LENGTH:])
    if not wanted or not begin:
        return True
    if begin > end:
        raise McapError("its index begins after its end")
    file.seek(begin)
    return zlib.crc32(file.read(end - begin) + footer[:-4]) == wanted


def _at(file: IO[bytes], offset: int, kind: type[Read]) -> Read:
    """The record of this kind at an offset; raises one of `_BROKEN`."""
    file.seek(offset + OPCODE_AND_LENGTH)
    return kind.read(ReadDataStream(file))  # pyright: ignore[reportAttributeAccessIssue]


def _by_index(file: IO[bytes], summary: Summary, damage: Callable[[str], None]) -> Iterator[Any]:
    """What the chunks hold, whatever their order in the file, without those that are damaged."""
    chunks = sorted(
        summary.chunk_indexes, key=lambda one: (one.message_start_time, one.chunk_start_offset)
    )
    broken: list[ChunkIndex] = []
    waiting: list[tuple[int, int, Message]] = []
    order = count()
    for index, following in zip(chunks, [*chunks, None][1:], strict=True):
        try:
            if max(index.chunk_length, index.uncompressed_size) > MAX_RECORD_BYTES:
                raise McapError("the chunk is too large")
            records = breakup_chunk(_at(file, index.chunk_start_offset, Chunk), validate_crc=True)
        except _BROKEN:
            broken.append(index)
            continue
        for record in records:
            if isinstance(record, Message):
                heappush(waiting, (record.log_time, next(order), record))
            else:
                yield record
        while waiting and (following is None or waiting[0][0] < following.message_start_time):
            yield heappop(waiting)[-1]
    while waiting:
        yield heappop(waiting)[-1]
    if broken:
        damage(_missing(file, summary, broken))


def _missing(file: IO[bytes], summary: Summary, broken: Sequence[ChunkIndex]) -> str:
    """What the chunks held that cannot be read, by their message indexes."""
    assert summary.statistics is not None
    topics: Counter[str] = Counter()
    for chunk in broken:
        for channel, offset in chunk.message_index_offsets.items():
            topic = summary.channels[channel].topic if channel in summary.channels else "?"
            with suppress(*_BROKEN):
                topics[topic] += len(_at(file, offset, MessageIndex).records)
    began_ns = summary.statistics.message_start_time
    first_s = (min(one.message_start_time for one in broken) - began_ns) / 1e9
    last_s = (max(one.message_end_time for one in broken) - began_ns) / 1e9
    worst = ", ".join(f"{topic} {lost}" for topic, lost in topics.most_common(SHOWN_TOPICS))
    return (
        f"damaged: {len(broken)} of {counted(len(summary.chunk_indexes), 'chunk')} cannot be read, "
        f"with {counted(topics.total(), 'message')} from {first_s:.1f} to {last_s:.1f} s after its "
        f"beginning ({worst or 'of unknown keys'}); the rest is read"
    )


def _whole(file: IO[bytes], damage: Callable[[str], None]) -> Iterator[Any]:
    """MCAP records as the file has them, up to the end or the first that cannot be read."""
    reader = StreamReader(file, record_size_limit=MAX_RECORD_BYTES, validate_crcs=True)
    records = iter(reader.records)
    while True:
        try:
            record = next(records)
        except StopIteration:
            return
        except _BROKEN as error:
            damage(
                f"cut off or damaged after {file.tell():,} bytes ({_cause(error)}); read up to "
                "there"
            )
            return
        yield record


def _cause(error: Exception) -> str:
    """What is wrong with bytes, not in the words of a library."""
    if isinstance(error, UnicodeDecodeError):
        return "a text that is no UTF-8"
    if isinstance(error, CRCValidationError):
        return "a checksum is wrong"
    if isinstance(error, (struct.error, EOFError, EndOfFile)):
        return "it ends within a record"
    if isinstance(error, RecordLengthLimitExceeded):
        return "a record is too long"
    return "a record is none"


def segments_of(path: Path) -> list[Path]:
    """Files of a rolling record in their order; none where `path` is no folder of such files."""
    return sorted(path.glob(SEGMENTS)) if path.is_dir() else []


def open_recording(path: Path) -> Recording:
    """Open a file that ``vla-zenoh record`` wrote, or a folder with a saved rolling record.

    Raises:
        RecordingError: the file cannot be read, is no MCAP file, or is of another program.
    """
    segments = segments_of(path)
    if segments:
        first = open_recording(segments[0])
        return Recording(path, first.about, first.profile_yaml)
    ros2_messages.messages()
    about: dict[str, str] | None = None
    profile_yaml: str | None = None
    problems: list[str] = []
    topics: Counter[str] = Counter()
    try:
        with path.open("rb") as file:
            if not isinstance(next(_whole(file, problems.append), None), McapHeader):
                raise RecordingError(f"{path} is not an MCAP file")
            for record in _facts(file, problems.append):
                if isinstance(record, Metadata) and record.name == ABOUT:
                    about = record.metadata
                elif isinstance(record, Attachment) and record.name == PROFILE_FILE:
                    profile_yaml = record.data.decode("utf-8", "replace")
                elif isinstance(record, Channel):
                    topics[record.topic] += 1
                if about is not None and profile_yaml is not None:
                    if not {"robot", "root"} <= about.keys():
                        raise RecordingError(f"{path} does not say of which robot it is")
                    return Recording(path, about, profile_yaml)
    except OSError as error:
        unfinished = path.with_suffix(f".part{path.suffix}")
        hint = f"; {unfinished.name} is there: its recorder still runs, or was killed"
        hint = hint if unfinished.exists() else ""
        raise RecordingError(f"{path} cannot be read: {error.strerror}{hint}") from error
    if problems and not topics:
        raise RecordingError(f"{path} is {problems[0]}, before anything of the run")
    names = ", ".join(list(topics)[:SHOWN_TOPICS]) + (" ..." if len(topics) > SHOWN_TOPICS else "")
    raise RecordingError(
        f"{path} is an MCAP file of another program (topics: {names or 'none'}); only those of "
        "`vla-zenoh record` say which key a message was on"
    )
