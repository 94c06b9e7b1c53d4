"""Reads the samples of a recording in the order of reception.

A file that was cut off is read as far as it goes; `Recording.damage` then holds the reason. A
folder of a saved rolling record is read as one recording, its segments one after the other.
"""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.records import Header as McapHeader
from mcap.stream_reader import CRCValidationError, StreamReader
from zstandard import ZstdError

from vla_zenoh.errors import CodecError, RecordError, RecordingError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording import ros2_messages
from vla_zenoh.lab.recording.record_types import RECORDS, bytes_from_json, record_from_json
from vla_zenoh.lab.recording.sample import Sample, received_sample
from vla_zenoh.lab.recording.writer import ABOUT, BYTES, ENDED, PROFILE_FILE
from vla_zenoh.types import Header

MAX_RECORD_BYTES = 256 * 1024 * 1024
SHOWN_TOPICS = 6
SEGMENT = "segment-{:08d}.mcap"
SEGMENTS = "segment-*.mcap"
_KINDS = {kind.__name__: kind for kind in RECORDS}
_SCHEMAS = (ros2_messages.TEXT, ros2_messages.IMAGE, ros2_messages.JPEG_IMAGE)
_BROKEN = (
    *(McapError, CRCValidationError, ZstdError, struct.error),
    *(ValueError, EOFError, KeyError, OverflowError),
)


class Recording:
    """A recording on disk; `open_recording` opens one.

    Args:
        path: of the file, or of a folder of segments.
    """

    def __init__(self, path: Path, about: dict[str, str], profile_yaml: str) -> None:
        self.path, self.about, self.profile_yaml = path, about, profile_yaml
        self.keys = Keys(about["robot"], about["root"])
        self.ended: dict[str, Any] | None = None
        """Metadata from its end, once `entries` has read it; None: the file was cut off."""
        self.damage = ""
        """Why reading ended early; empty if it did not."""

    def entries(self, wanted: Callable[[str], bool] = lambda key: True) -> Iterator[Sample]:
        """Samples in the order of reception, up to the first damage (see `damage`).

        Args:
            wanted: whether to read a key; other keys are skipped undecoded.
        """
        self.damage, self.ended = "", None
        dropped: Counter[str] = Counter()
        for path in segments_of(self.path) or [self.path]:
            self.ended = None
            yield from self._entries_of(path, wanted)
            dropped.update(self._dropped())
        if self.ended is not None:
            self.ended["dropped"] = dict(dropped)

    def _entries_of(self, path: Path, wanted: Callable[[str], bool]) -> Iterator[Sample]:
        schemas: dict[int, Schema] = {}
        channels: dict[int, _Source | None] = {}
        with path.open("rb") as file:
            for record in _whole(file, partial(setattr, self, "damage")):
                if isinstance(record, Message):
                    source = channels.get(record.channel_id)
                    if source is None:
                        continue
                    try:
                        entry = source.sample(record)
                    except CodecError as error:
                        self.damage = self.damage or f"{source.key}: {error}"
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
                        self.damage = self.damage or f"its last facts are not JSON: {error}"

    @property
    def dropped(self) -> int:
        """Samples that the recorder dropped, once `entries` has read the end."""
        return sum(self._dropped().values())

    def _dropped(self) -> dict[str, int]:
        counts = (self.ended or {}).get("dropped")
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


def _whole(file: IO[bytes], damage: Callable[[str], None]) -> Iterator[Any]:
    """MCAP records up to the end, or to the first that cannot be read."""
    reader = StreamReader(file, record_size_limit=MAX_RECORD_BYTES, validate_crcs=True)
    records = iter(reader.records)
    while True:
        try:
            record = next(records)
        except StopIteration:
            return
        except (*_BROKEN, UnicodeDecodeError, MemoryError) as error:
            damage(
                f"cut off or damaged after {file.tell():,} bytes "
                f"({type(error).__name__}{f': {error}' if str(error) else ''})"
            )
            return
        yield record


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
    problems: list[str] = []
    topics: Counter[str] = Counter()
    try:
        with path.open("rb") as file:
            records = _whole(file, problems.append)
            if not isinstance(next(records, None), McapHeader):
                raise RecordingError(f"{path} is not an MCAP file")
            for record in records:
                if isinstance(record, Metadata) and record.name == ABOUT:
                    about = record.metadata
                elif isinstance(record, Attachment) and about and record.name == PROFILE_FILE:
                    if not {"robot", "root"} <= about.keys():
                        raise RecordingError(f"{path} does not say of which robot it is")
                    return Recording(path, about, record.data.decode("utf-8", "replace"))
                elif isinstance(record, Channel):
                    topics[record.topic] += 1
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    if problems and not topics:
        raise RecordingError(f"{path} is {problems[0]}, before anything of the run")
    names = ", ".join(list(topics)[:SHOWN_TOPICS]) + (" ..." if len(topics) > SHOWN_TOPICS else "")
    raise RecordingError(
        f"{path} is an MCAP file of another program (topics: {names or 'none'}); only those of "
        "`vla-zenoh record` say which key a message was on"
    )
