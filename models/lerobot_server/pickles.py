"""Pickles of lerobot's policy server, read as data: nothing that they name is imported or called.

A pickle is a program. This reader knows the instructions that Python writes for values, tensors and
one class of lerobot's, and takes apart what they describe; every other name and instruction is
rejected. A tensor's storage is a torch file of the old form: four pickles, then its numbers.
"""

from __future__ import annotations

import io
import itertools
import pickletools
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import PeerError
from vla_zenoh.types import shown

HELPERS = "lerobot.async_inference.helpers"
TIMED_ACTION, TIMED_OBSERVATION = f"{HELPERS}.TimedAction", f"{HELPERS}.TimedObservation"
POLICY_CONFIG = f"{HELPERS}.RemotePolicyConfig"
MAX_INSTRUCTIONS = 200_000
"""A chunk of 50 steps has 2000."""
STORAGES = {
    "torch.FloatStorage": "<f4",
    "torch.DoubleStorage": "<f8",
    "torch.HalfStorage": "<f2",
    "torch.BFloat16Storage": "<u2",
}
TORCH_MAGIC, TORCH_VERSION = 0x1950A86A20F9469CFC6C, 1001


@dataclass(slots=True)
class Instance:
    """An object of a class: its name and its fields."""

    name: str
    fields: dict[str, Any]


@dataclass(frozen=True, slots=True)
class _Name:
    text: str


Makers = Mapping[str, Callable[[tuple[Any, ...]], Any] | None]
"""Allowed names, and the constructor of their value; None: they are only named."""


# -- read -----------------------------------------------------------------------------------------
def read(data: bytes) -> Any:
    """Values, tensors as arrays (n,), and `Instance` of `TIMED_ACTION`.

    Raises:
        PeerError: anything else; reports a name that is not allowed.
    """
    return _whole(io.BytesIO(data), _OUTER)


def _broken(why: str) -> PeerError:
    return PeerError("peer_reply", f"the server's pickle is not read: {why}")


def _whole(stream: io.BytesIO, makers: Makers) -> Any:
    try:
        return _run(stream, makers)
    except PeerError:
        raise
    # Instructions that do not fit each other; the text of pickletools' errors is that of the bytes.
    except (ValueError, TypeError, LookupError, AttributeError, struct.error) as error:
        raise _broken(shown(str(error) or type(error).__name__)) from error


_EMPTY = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_TUPLE": tuple}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_VALUES = frozenset(
    {"BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"}
    | {"BINUNICODE", "SHORT_BINUNICODE", "BINBYTES", "SHORT_BINBYTES"}
)
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


def _run(stream: io.BytesIO, makers: Makers) -> Any:
    stack: list[Any] = []
    marks: list[int] = []
    memo: list[Any] = []

    def since_mark() -> list[Any]:
        at = marks.pop()
        found = stack[at:]
        del stack[at:]
        return found

    def named(text: str) -> _Name:
        if text not in makers:
            raise PeerError(
                "peer_reply",
                f"the server's pickle names {text[:100]!r}, which is not allowed and was not "
                f"run; allowed: {', '.join(makers)}",
            )
        return _Name(text)

    def make(name: str, arguments: tuple[Any, ...]) -> Any:
        maker = makers.get(name)
        if maker is None:
            raise _broken(f"it calls {name}")
        return maker(arguments)

    for instruction, given, _ in itertools.islice(pickletools.genops(stream), MAX_INSTRUCTIONS):
        argument: Any = given
        match instruction.name:
            case "PROTO" | "FRAME":
                pass
            case name if name in _VALUES:
                stack.append(argument)
            case name if name in _CONSTANTS:
                stack.append(_CONSTANTS[name])
            case name if name in _EMPTY:
                stack.append(_EMPTY[name]())
            case "MARK":
                marks.append(len(stack))
            case "TUPLE":
                stack.append(tuple(since_mark()))
            case name if name in _TUPLES:
                stack[-_TUPLES[name] :] = [tuple(stack[-_TUPLES[name] :])]
            case "APPEND" | "APPENDS":
                items = since_mark() if instruction.name == "APPENDS" else [stack.pop()]
                _of(stack[-1], list).extend(items)
            case "SETITEM" | "SETITEMS":
                if instruction.name == "SETITEM":
                    marks.append(len(stack) - 2)
                pairs = since_mark()
                # Text alone: the hash of nested tuples could take for ever.
                keys = [_of(key, str) for key in pairs[::2]]
                _of(stack[-1], dict).update(zip(keys, pairs[1::2], strict=True))
            case "MEMOIZE" | "BINPUT" | "LONG_BINPUT":
                if argument not in (None, len(memo)):
                    raise _broken(f"entry {argument} of its memo after {len(memo)}")
                memo.append(stack[-1])
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "GLOBAL":
                stack.append(named(argument.replace(" ", ".")))
            case "STACK_GLOBAL":
                last = _of(stack.pop(), str)
                stack.append(named(f"{_of(stack.pop(), str)}.{last}"))
            case "REDUCE" | "NEWOBJ":
                arguments = _of(stack.pop(), tuple)
                stack.append(make(_of(stack.pop(), _Name).text, arguments))
            case "BUILD":
                fields = _of(stack.pop(), dict)
                _of(stack[-1], Instance).fields = fields
            case "BINPERSID":
                stack.append(make(_PERSISTENT, _of(stack.pop(), tuple)))
            case "STOP":
                (found,) = stack
                return found
            case other:
                raise _broken(f"it has the instruction {other}")
    raise _broken(f"more than {MAX_INSTRUCTIONS} instructions")


def _of(value: Any, kind: type[Any]) -> Any:
    if type(value) is not kind:
        raise TypeError(f"{type(value).__name__} where {kind.__name__} belongs")
    return value


# -- what may be named ----------------------------------------------------------------------------
_PERSISTENT = "a storage"


@dataclass(frozen=True, slots=True)
class _Storage:
    kind: str
    key: str
    count: int


def _described(arguments: tuple[Any, ...]) -> _Storage:
    what, kind, key, _, count, view = arguments
    if what != "storage" or view is not None:
        raise _broken("a part of a storage")
    return _Storage(_of(kind, _Name).text, _of(key, str), _of(count, int))


def _storage(arguments: tuple[Any, ...]) -> NDArray[Any]:
    (data,) = arguments
    file = io.BytesIO(_of(data, bytes))
    magic, version, _ = (_whole(file, {}) for _ in range(3))
    if (magic, version) != (TORCH_MAGIC, TORCH_VERSION):
        raise _broken("its storage is no file of torch")
    found = _of(_whole(file, _INNER), _Storage)
    keys = _whole(file, {})
    dtype = np.dtype(STORAGES[found.kind])
    start = file.tell() + 8
    count = int.from_bytes(data[start - 8 : start], "little")
    if keys != [found.key] or not count == found.count == (len(data) - start) / dtype.itemsize:
        raise _broken(f"{len(data) - start} bytes for {found.count} numbers of {dtype}")
    numbers = np.frombuffer(data, dtype, offset=start)
    if found.kind == "torch.BFloat16Storage":  # the upper half of a float
        numbers = (numbers.astype("<u4") << 16).view("<f4")
    return numbers


def _tensor(arguments: tuple[Any, ...]) -> NDArray[Any]:
    numbers, offset, shape, strides = arguments[:4]
    if len(_of(shape, tuple)) != 1 or len(_of(strides, tuple)) != 1:
        raise _broken(f"a step of shape {shown(shape)}, wanted (D,)")
    (size,), (stride,) = shape, strides
    if not all(type(n) is int and n >= 0 for n in (offset, size, stride)) or stride == 0:
        raise _broken(f"a tensor of {shown(shape)} at {shown(offset)}, stride {shown(strides)}")
    found = _of(numbers, np.ndarray)[offset::stride][:size]
    if len(found) != size:
        raise _broken(f"a tensor of {size} numbers in {len(numbers)}")
    return found


def _nothing(arguments: tuple[Any, ...]) -> dict[str, Any]:
    if arguments:
        raise _broken("an OrderedDict with entries")
    return {}


_OUTER: Makers = {
    TIMED_ACTION: lambda _: Instance(TIMED_ACTION, {}),
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch.storage._load_from_bytes": _storage,
    "collections.OrderedDict": _nothing,
}
_INNER: Makers = {**dict.fromkeys(STORAGES), _PERSISTENT: _described}


# -- write ----------------------------------------------------------------------------------------
def write(value: Any) -> bytes:
    """Values, uint8 arrays and `Instance` as a pickle, whose classes need not be here.

    Raises:
        TypeError: something else.
    """
    out = bytearray(b"\x80\x03")
    _write(value, out)
    return bytes(out + b".")


def _write(value: Any, out: bytearray) -> None:
    match value:
        case None:
            out += b"N"
        case bool():
            out += b"\x88" if value else b"\x89"
        case int() if -(2**31) <= value < 2**31:
            out += b"J" + struct.pack("<i", value)
        case float():
            out += b"G" + struct.pack(">d", value)
        case str():
            text = value.encode("utf-8", "surrogatepass")
            out += b"X" + struct.pack("<I", len(text)) + text
        case bytes():
            out += b"B" + struct.pack("<I", len(value)) + value
        case dict():
            out += b"}("
            for item in itertools.chain.from_iterable(value.items()):
                _write(item, out)
            out += b"u"
        case list() | tuple():
            out += b"](" if isinstance(value, list) else b"("
            for item in value:
                _write(item, out)
            out += b"e" if isinstance(value, list) else b"t"
        case np.ndarray():
            _named("numpy.ndarray", out)
            _write((value.shape, value.dtype.str, value.tobytes()), out)
            out += b"R"
        case Instance():
            _named(value.name, out)
            out += b")\x81"
            _write(value.fields, out)
            out += b"b"
        case _:
            raise TypeError(f"{type(value).__name__} is not written")


def _named(name: str, out: bytearray) -> None:
    module, _, last = name.rpartition(".")
    out += f"c{module}\n{last}\n".encode()
