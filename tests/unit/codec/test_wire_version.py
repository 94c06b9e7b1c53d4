"""The fields of records, and the version of the wire.

A decoder ignores a field that it does not know: a new field with a default needs no new version,
only its place in the table below, a line in CHANGELOG.md and a strategy in tests/random_records.py.
A field that goes, is required, or means something else raises `vla_zenoh.keys.SCHEMA`.
"""

from __future__ import annotations

import dataclasses
import runpy
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from random_records import same

from vla_zenoh import keys
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import SCHEMA
from vla_zenoh.types import Header, stream
from vla_zenoh.types import records as record_types
from vla_zenoh.types.form import Count

VALID = runpy.run_path(str(Path(__file__).parents[3] / "scripts" / "wire.py"))["VALID"]

OF_VERSION = 2
FIELDS = {
    "ActionChunk": (
        "worker spec_hash episode observation_stamp_ns observation_seq valid_until_ns steps "
        "observed_ns inference_start_ns inference_end_ns done"
    ),
    "Cause": (
        "worker chunk_seq observation_stamp_ns observed_ns inference_start_ns inference_end_ns "
        "published_ns received_ns"
    ),
    "ClockReply": "heard_ns said_ns",
    "Event": "level kind what why value limit count",
    "GripperCommand": "width_m speed_m_s force_n",
    "GripperState": "width_m moving holding mode faults",
    "Header": "stamp_wall_ns seq source",
    "InferenceDebug": (
        "worker chunk_seq spec_hash episode observation_stamp_ns prompt steps inference_ms raw done"
    ),
    "JointCommand": "names position_rad velocity_rad_s acceleration_rad_s2 state cause",
    "JointState": "names position_rad velocity_rad_s effort_nm reference_rad endless sliding",
    "NodeStatus": (
        "node state host pid started_wall_ns ages_s rates_hz latency_ms counters detail boot"
    ),
    "ObjectPoses": "names position_m quat_xyzw",
    "PoseCommand": (
        "position_m quat_xyzw twist acceleration goal_position_m goal_quat_xyzw state cause"
    ),
    "PoseState": ("position_m quat_xyzw twist wrench reference_position_m reference_quat_xyzw"),
    "PrivilegedState": "values",
    "SceneState": "scene qpos seed",
    "Task": "episode active prompt worker rate_hz speed_percent",
}
NOT_AS_MAPS = {"Stamped", "Image", "Depth"}
"""Never on the wire, or with an encoding of their own."""


def records_of_the_package() -> dict[str, type]:
    return {
        name: kind
        for module in (record_types, stream)
        for name, kind in vars(module).items()
        if dataclasses.is_dataclass(kind)
        and isinstance(kind, type)
        and kind.__module__ == module.__name__
    }


def test_the_table_is_of_this_version_and_has_every_record() -> None:
    assert SCHEMA == OF_VERSION
    assert records_of_the_package().keys() - NOT_AS_MAPS == FIELDS.keys()


@pytest.mark.parametrize("name", FIELDS)
def test_a_record_has_the_fields_of_this_version(name: str) -> None:
    found = [field.name for field in dataclasses.fields(records_of_the_package()[name])]
    assert found == FIELDS[name].split(), "see the head of this file"


# -- three builds of the wire -----------------------------------------------------------------
class Build(NamedTuple):
    """A version of this program.

    Args:
        schema: its version of the wire.
        more: its records have one optional field more.
    """

    schema: int
    more: bool

    def kind(self, kind: type[Any]) -> type[Any]:
        if not self.more:
            return kind
        later = ("later", Count, dataclasses.field(default=LATER))
        return dataclasses.make_dataclass(kind.__name__, [later], bases=(kind,), frozen=True)

    def write(self, record: Any) -> tuple[bytes, bytes]:
        """Attachment and payload of a record with its own fields."""
        own = self.kind(type(record))(
            **{field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
        )
        with self.running():
            return records.encode_header(Header(1, 2, "sim#1")), records.encode(own)

    def read(self, kind: type[Any], attachment: bytes, payload: bytes) -> tuple[Any, list[str]]:
        """The record, and the fields that this build does not know."""
        unknown: list[str] = []
        with self.running():
            records.decode_header(attachment)
            return records.decode(self.kind(kind), payload, unknown), unknown

    @contextmanager
    def running(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(keys, "SCHEMA", self.schema)
            yield


LATER = 7
BUILDS = {
    "now": Build(SCHEMA, more=False),
    "more": Build(SCHEMA, more=True),
    "raised": Build(SCHEMA + 1, more=False),
}
EACH = [record for record in VALID if dataclasses.is_dataclass(record)]


@pytest.mark.parametrize("reads", BUILDS)
@pytest.mark.parametrize("writes", BUILDS)
def test_two_builds_understand_each_other_or_say_who_is_to_be_updated(
    writes: str, reads: str
) -> None:
    writer, reader = BUILDS[writes], BUILDS[reads]
    for record in EACH:
        name = type(record).__name__
        sent = writer.write(record)
        if writer.schema != reader.schema:
            who = "this side" if writer.schema > reader.schema else "the sender"
            why = f"schema {writer.schema} of the wire, .* {reader.schema}: update .* on {who}"
            with pytest.raises(CodecError, match=why) as caught:
                reader.read(type(record), *sent)
            assert caught.value.reason == "schema"
            continue
        found, unknown = reader.read(type(record), *sent)
        for field in dataclasses.fields(record):
            assert same(getattr(found, field.name), getattr(record, field.name))
        assert unknown == ([f"{name}.'later'"] if writer.more and not reader.more else [])
        if reader.more:
            assert found.later == LATER
