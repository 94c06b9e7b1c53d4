"""msgpack as openpi writes it, and what is refused of it."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from random_records import refusal, same
from vla_zenoh_policy_servers import message

from vla_zenoh.errors import CodecError

MEMORY_LIMIT_BYTES = 3 * 1024**3  # of address space, most of it the libraries' own
MAX_GROWTH_MIB = 400  # the payload and what decoding it takes


def openpi_form(value: Any) -> Any:
    """What openpi-client's packer makes of arrays and scalars: maps with bytes keys."""
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    return value


VALUES = [
    1,
    1.5,
    "hello",
    b"bytes",
    None,
    True,
    np.bool_(True),
    np.array([1, 2, 3])[0],
    np.float32(0.5),
    [1, 2, 3],
    {"key": {"nested": [1, 2]}},
    np.array(1.0),
    np.array([]),
    np.zeros((0, 3), np.float32),
    np.array([1, 2, 3], np.int32),
    np.array([1, 2, 3], ">i2"),
    np.array(["asdf", "qwér"]),
    np.array([b"ab", b"c"]),
    np.array([True, False]),
    np.array([np.nan, np.inf]),
    np.arange(24, dtype=np.uint8).reshape(2, 4, 3),
    np.asfortranarray(np.arange(6).reshape(2, 3)),
]


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_a_value_comes_back_as_it_was(value: Any) -> None:
    back = message.unpack(message.pack({"v": value}))["v"]
    assert same(value, back)


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_our_bytes_are_those_that_openpi_writes(value: Any) -> None:
    assert message.pack({"v": value}) == msgpack.packb({"v": value}, default=openpi_form)


@given(
    hnp.arrays(
        hnp.boolean_dtypes()
        | hnp.integer_dtypes()
        | hnp.unsigned_integer_dtypes()
        | hnp.floating_dtypes(sizes=(16, 32, 64))
        | hnp.byte_string_dtypes(min_len=1)
        | hnp.unicode_string_dtypes(min_len=1),
        hnp.array_shapes(min_dims=0, min_side=0, max_side=4),
    )
)
def test_an_array_comes_back_read_only_and_bit_by_bit(array: np.ndarray[Any, Any]) -> None:
    back = message.unpack(message.pack(array))
    assert same(array, back)
    assert not back.flags.writeable


@pytest.mark.parametrize(
    "value",
    [
        np.array([object()]),
        np.array([1 + 2j]),
        np.zeros(2, "f8,i4"),
        np.array(["2020-01-01"], "M8[D]"),
        np.array([1.0], np.longdouble),
        object(),
        {1, 2},
        2**64,
        "half a character \ud800",
    ],
    ids=lambda value: repr(value).split(" at 0x")[0],
)
def test_what_has_no_form_is_not_written(value: Any) -> None:
    with pytest.raises(CodecError) as caught:
        message.pack({"v": value})
    assert caught.value.reason == "unencodable"


def test_a_list_that_holds_itself_is_not_written() -> None:
    loop: list[Any] = []
    loop.append(loop)
    with pytest.raises(CodecError):
        message.pack(loop)


@given(st.binary(max_size=400))
def test_arbitrary_bytes_are_refused_or_read(payload: bytes) -> None:
    error = refusal(message.unpack, payload)
    assert error is None or error.reason == "malformed"


def array_map(**changes: Any) -> bytes:
    form = openpi_form(np.arange(3.0)) | {key.encode(): v for key, v in changes.items()}
    return msgpack.packb({"v": form})


def scalar_map(dtype: Any, data: Any) -> bytes:
    return msgpack.packb({"v": {b"__npgeneric__": True, b"dtype": dtype, b"data": data}})


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        b"\x93\x01",
        b"\x01\x02",  # something behind the end
        b"\xa1\xff",  # text that is not UTF-8
        b"\xa3\xed\xa0\x80",  # a surrogate
        b"\xd6\xff\x00\x00\x00\x01",  # a timestamp
        b"\x81\xa1t\xd6\xff\x00\x00\x00\x01",
        b"\xc7\x0c\xff" + b"\xff" * 12,  # a timestamp with impossible nanoseconds
        b"\xd4\x05\x00",  # an extension
        b"\x81\x91\x01\x02",  # a list as key
        b"\x81\x01\x02",  # a number as key
        b"\x81\xc4\x00",
        b"\x91" * 33 + b"\x00",
        b"\x91" * 5000 + b"\x00",
        b"\x81\xa1a" * 2000 + b"\x00",
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xdb\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\xc9\xff\xff\xff\xff\x05",
        b"\xdc\xff\xff" + b"\x00" * 65535,  # whole, and longer than is read
        array_map(shape=[4]),
        array_map(shape=[-3]),
        array_map(shape=[3.0]),
        array_map(shape=[True, 3]),
        array_map(shape="3"),
        array_map(shape=[2**62, 2**62]),
        array_map(shape=[1] * 64),
        array_map(shape=[0, 2**63], data=b""),
        array_map(data="text"),
        array_map(data=None),
        array_map(dtype="O"),
        array_map(dtype="|O8"),
        array_map(dtype="c16"),
        array_map(dtype="f16"),
        array_map(dtype="V8"),
        array_map(dtype="f8,f8"),
        array_map(dtype="(3,)f8"),
        array_map(dtype="U0"),
        array_map(dtype="a8"),
        array_map(dtype=b"f8"),
        array_map(dtype=["f8"]),
        array_map(dtype="<U6", shape=[1], data=b"\xff" * 24),
        scalar_map("<f8", "1.5"),
        scalar_map("<f8", [1.0, 2.0]),
        scalar_map("<f8", None),
        scalar_map("<f4", 1e300),
        scalar_map("|i1", 300),
        scalar_map("|b1", 1),
        scalar_map("<i8", True),
        scalar_map("|S9", 10**9),  # bytes(10**9) would be a gigabyte of zeros
        scalar_map("|O", 1),
    ],
)
def test_what_is_forged_is_malformed(payload: bytes) -> None:
    with pytest.raises(CodecError) as caught:
        message.unpack(payload)
    assert caught.value.reason == "malformed"
    assert len(str(caught.value)) < 1000


def test_the_last_depth_that_is_read_is_read() -> None:
    assert message.unpack(b"\x91" * message.MAX_DEPTH + b"\x00")


def test_an_oversize_payload_is_refused_by_its_length() -> None:
    with pytest.raises(CodecError) as caught:
        message.unpack(bytes(message.MAX_PAYLOAD_BYTES + 1))
    assert caught.value.reason == "oversize"


def test_forged_lengths_take_no_memory() -> None:
    # Each level claims as many entries as the payload has bytes: half a gigabyte a level.
    script = f"""
        import resource
        from vla_zenoh_policy_servers import message
        from vla_zenoh.errors import CodecError
        resource.setrlimit(resource.RLIMIT_AS, ({MEMORY_LIMIT_BYTES}, {MEMORY_LIMIT_BYTES}))
        size = 60 * 1024 * 1024
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for claim in (size, message.MAX_ITEMS):
            level = b"\\xdd" + claim.to_bytes(4, "big")
            payload = level * 1000 + bytes(size - 5000)
            try:
                message.unpack(payload)
            except CodecError as error:
                print(error.reason)
        print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    *reasons, grown_mib = done.stdout.split()
    assert reasons == ["malformed", "malformed"], done.stderr
    assert int(grown_mib) < MAX_GROWTH_MIB
