"""The fields of records, and the version of the wire.

A decoder ignores a field that it does not know: a new field with a default needs no new version,
only its place in the table below, a line in CHANGELOG.md and a strategy in tests/random_records.py.
A field that goes, is required, or means something else raises `vla_zenoh.keys.SCHEMA`.
"""

from __future__ import annotations

import dataclasses

import pytest

from vla_zenoh.keys import SCHEMA
from vla_zenoh.types import records, stream

OF_VERSION = 1
FIELDS = {
    "ActionChunk": (
        "worker spec_hash episode observation_stamp_ns observation_seq valid_until_ns steps "
        "observed_ns inference_start_ns inference_end_ns done"
    ),
    "Cause": (
        "worker chunk_seq observation_stamp_ns observed_ns inference_start_ns inference_end_ns "
        "published_ns received_ns"
    ),
    "Event": "level kind what why value limit count",
    "GripperCommand": "width_m speed_m_s force_n",
    "GripperState": "width_m moving holding mode faults",
    "Header": "stamp_wall_ns seq source",
    "InferenceDebug": (
        "worker chunk_seq spec_hash episode observation_stamp_ns prompt steps inference_ms raw done"
    ),
    "JointCommand": "names position_rad velocity_rad_s acceleration_rad_s2 state cause",
    "JointState": "names position_rad velocity_rad_s effort_nm reference_rad",
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
        for module in (records, stream)
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
