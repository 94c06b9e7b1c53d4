"""The files in wire/: test vectors and the JSON Schema, made by scripts/wire.py."""

from __future__ import annotations

import hashlib
import json
import runpy
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import msgpack
import pytest

from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import SCHEMA

ROOT = Path(__file__).parents[2]
MADE = runpy.run_path(str(ROOT / "scripts" / "wire.py"))
LEAST_VECTORS = 60


def text(name: str) -> str:
    return (ROOT / "wire" / name).read_text("utf-8")


@pytest.fixture(scope="module")
def vectors() -> list[dict[str, Any]]:
    found = json.loads(text("wire.json"))
    assert found["schema"] == SCHEMA
    return found["vectors"]


@pytest.mark.parametrize(
    ("name", "make"), [("wire.json", "wire"), ("records.schema.json", "schema")]
)
def test_the_files_are_those_of_the_code(name: str, make: str) -> None:
    assert text(name) == MADE[make](), "run python scripts/wire.py"


def test_there_are_vectors_of_every_record_valid_and_not(vectors: list[dict[str, Any]]) -> None:
    assert len(vectors) >= LEAST_VECTORS
    kinds = {type(record).__name__ for record in MADE["VALID"]}
    for valid in (True, False):
        assert kinds <= {each["kind"] for each in vectors if each["valid"] is valid}


def test_any_reader_of_msgpack_finds_the_value_of_a_valid_record(
    vectors: list[dict[str, Any]],
) -> None:
    for each in vectors:
        if each["valid"] and each["what"] != "setting":
            found = msgpack.unpackb(bytes.fromhex(each["bytes"]))
            assert {name: found[name] for name in each["value"]} == each["value"]


def test_the_schema_requires_exactly_the_fields_that_the_readers_require(
    vectors: list[dict[str, Any]],
) -> None:
    kinds = {type(record).__name__: type(record) for record in MADE["VALID"]}
    schemas = json.loads(text("records.schema.json"))["$defs"]
    firsts = {v["kind"]: v for v in reversed(vectors) if v["valid"] and v["what"] != "setting"}
    for name, vector in firsts.items():
        fields = msgpack.unpackb(bytes.fromhex(vector["bytes"]))
        for left_out in fields:
            payload = msgpack.packb({key: fields[key] for key in fields if key != left_out})
            required = left_out in schemas[name]["required"]
            with pytest.raises(CodecError) if required else nullcontext():
                if name == "Header":
                    records.decode_header(payload)
                else:
                    records.decode(kinds[name], payload)


def test_the_hash_of_a_spec_is_that_of_its_json_as_the_page_says(
    vectors: list[dict[str, Any]],
) -> None:
    (vector,) = (each for each in vectors if "spec_hash" in each)
    canonical = json.dumps(vector["value"], sort_keys=True, separators=(",", ":"))
    assert vector["spec_hash"] == hashlib.sha256(canonical.encode()).hexdigest()[:16]
