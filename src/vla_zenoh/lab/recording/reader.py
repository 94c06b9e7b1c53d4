"""Samples out of an MCAP file of ours, in the order in which they were heard.

A file whose writer was killed, or that was cut off, gives what it has; `RunFile.damage` then says
so.
"""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.records import Header as McapHeader
from mcap.stream_reader import CRCValidationError, StreamReader
from zstandard import ZstdError

from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, RecordError, RecordingError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording import cdr
from vla_zenoh.lab.recording.definitions import SAMPLE_NAME, type_name
from vla_zenoh.lab.recording.record_types import RECORDS
from vla_zenoh.lab.recording.sample import Sample
from vla_zenoh.lab.recording.writer import ABOUT, ENDED, PROFILE_FILE
from vla_zenoh.types import Header

MAX_RECORD_BYTES = 256 * 1024 * 1024
SHOWN_TOPICS = 6
_KINDS = {type_name(kind): kind for kind in RECORDS}
_BROKEN = (McapError, CRCValidationError, ZstdError, struct.error, ValueError, EOFError, KeyError)


@dataclass(frozen=True, slots=True)
class RecordedEntry:
    """One sample of a file, decoded as far as it was asked for.

    Args:
        key: the whole key.
        header: what the writer said of it, None for settings.
        heard_ns: when it was heard, wall clock of the recorder.
        encoding: as Zenoh writes it.
        kind: its record, None where it is none.
        fields: of the record, as in its payload; not judged yet.
        data: the payload where it is no record; for `text` decoded.
        attachment: bytes in a header's place that are none.
    """

    key: str
    header: Header | None
    received_ns: int
    encoding: str
    kind: type | None = None
    fields: dict[str, Any] = field(default_factory=dict)
    data: bytes = b""
    attachment: bytes | None = None

    @property
    def text(self) -> str:
        """A setting's words."""
        return self.data.decode("utf-8", "replace")

    @property
    def payload(self) -> bytes:
        """As it was on the wire."""
        return self.data if self.kind is None else cdr.payload_of(self.kind, self.fields)

    @property
    def sample(self) -> Sample:
        """As it was heard."""
        return Sample(
            self.key, self.payload, self.encoding, self.header, self.received_ns, self.attachment
        )

    def record(self) -> Any:
        """The record, checked.

        Raises:
            CodecError: it is none, or a value is not allowed.
        """
        if self.kind is None:
            raise CodecError("malformed", f"{self.key} carries no record")
        data = self.fields.get("spec", self.fields)
        return records.from_map(self.kind, data)


class Recording:
    """A recorded run; see `open_recording`.

    Args:
        path: of the file.
        about: facts written at its beginning.
        profile_yaml: the profile that was in force.
    """

    def __init__(self, path: Path, about: dict[str, str], profile_yaml: str) -> None:
        self.path, self.about, self.profile_yaml = path, about, profile_yaml
        self.keys = Keys(about["robot"], about["root"])
        self.ended: dict[str, Any] | None = None
        """Facts written at its end, once `entries` has been there; None: it was cut off."""
        self.damage = ""
        """Why reading ended early, once it has; empty when it did not."""

    def entries(self, wanted: Callable[[str], bool] = lambda key: True) -> Iterator[RecordedEntry]:
        """Samples in the order heard. Damage ends them, see `damage`.

        Args:
            wanted: which keys; the others are passed over undecoded.
        """
        schemas: dict[int, Schema] = {}
        channels: dict[int, _Source | None] = {}
        self.damage, self.ended = "", None
        with self.path.open("rb") as file:
            for record in _whole(file, self._note_damage):
                if isinstance(record, Message):
                    source = channels.get(record.channel_id)
                    entry = None if source is None else self._read(source, record)
                    if entry is not None:
                        yield entry
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    source = _source(record, schemas)
                    channels[record.id] = source if source and wanted(source.key) else None
                elif isinstance(record, Metadata) and record.name == ENDED:
                    self.ended = self._facts(record)

    def _facts(self, record: Metadata) -> dict[str, Any] | None:
        try:
            return {name: json.loads(value) for name, value in record.metadata.items()}
        except (ValueError, RecursionError) as error:
            self.damage = self.damage or f"its last facts are not JSON: {error}"
            return None

    @property
    def dropped(self) -> int:
        """Samples that the recorder heard and could not write, once `entries` has been there."""
        counts = (self.ended or {}).get("dropped")
        counted = counts.values() if isinstance(counts, dict) else ()
        return sum(count for count in counted if type(count) is int)

    def _note_damage(self, why: str) -> None:
        self.damage = why

    def _read(self, source: _Source, message: Message) -> RecordedEntry | None:
        try:
            return source.entry(message)
        except CodecError as error:
            self.damage = self.damage or f"{source.key}: {error}"
            return None


@dataclass(frozen=True, slots=True)
class _Source:
    """A channel of ours."""

    key: str
    writer: str
    encoding: str
    schema: str

    def entry(self, message: Message) -> RecordedEntry:
        kind = _KINDS.get(self.schema)
        header = None
        if self.writer:
            try:
                header = Header(message.publish_time, message.sequence, self.writer)
            except RecordError as error:
                raise CodecError("invalid", str(error)) from error
        if kind is not None:
            _, fields = cdr.read_record(kind, message.data)
            return RecordedEntry(self.key, header, message.log_time, self.encoding, kind, fields)
        found = cdr.deserialize(self.schema, message.data)
        if self.schema == cdr.TEXT:
            data = found.data.encode()
        elif self.schema == SAMPLE_NAME:
            return self._stray(found, message.log_time)
        else:
            data = found.data.tobytes()
        return RecordedEntry(self.key, header, message.log_time, self.encoding, data=data)

    def _stray(self, found: Any, received_ns: int) -> RecordedEntry:
        attachment = found.attachment.tobytes() if found.has_attachment else None
        header = None
        if attachment is not None:
            with suppress(CodecError):
                header, attachment = records.decode_header(attachment), None
        payload = found.payload.tobytes()
        return RecordedEntry(
            self.key, header, received_ns, self.encoding, data=payload, attachment=attachment
        )


def _source(channel: Channel, schemas: dict[int, Schema]) -> _Source | None:
    facts, schema = channel.metadata, schemas.get(channel.schema_id)
    if "key" not in facts or schema is None:
        return None
    known = {*_KINDS, cdr.TEXT, cdr.IMAGE, cdr.JPEG_IMAGE, SAMPLE_NAME}
    if schema.name not in known:
        return None
    return _Source(facts["key"], facts.get("source", ""), facts.get("encoding", ""), schema.name)


def _whole(file: IO[bytes], damage: Callable[[str], None]) -> Iterator[Any]:
    """Records until the end, or until one cannot be read."""
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


def open_recording(path: Path) -> Recording:
    """Open a file that ``vla-zenoh record`` wrote.

    Raises:
        RecordingError: it cannot be read, is no MCAP file, or is one of another program.
        MissingExtraError: rosbags is not installed.
    """
    cdr.messages()
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
                    return Recording(
                        path, _checked(path, about), record.data.decode("utf-8", "replace")
                    )
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


def _checked(path: Path, about: dict[str, str]) -> dict[str, str]:
    if not {"robot", "root"} <= about.keys():
        raise RecordingError(f"{path} does not say of which robot it is")
    return about
