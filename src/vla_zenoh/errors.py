"""Every error the package raises on purpose: all are a `VlaZenohError`.

A message says what is wrong, what is allowed and what to do. Errors of libraries are turned into
these at the edge, with ``from``.
"""

from __future__ import annotations

import difflib
import importlib.metadata
import json
import re
import reprlib
from collections.abc import Iterable
from typing import Any


class VlaZenohError(Exception):
    """Root of every error this package raises on purpose."""


class RecordError(VlaZenohError, ValueError):
    """A value cannot be a valid record: its shape, range, or NaN."""


class CountedError(VlaZenohError):
    """An error whose `reason` is the stable name of its counter in status, as ``truncated``."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class CodecError(CountedError, ValueError):
    """Bytes from the wire are not what their key promises."""


class ProfileError(VlaZenohError, ValueError):
    """A profile file is wrong; the message names file, line and path.

    `place` has the keys from the top down to what is wrong, where the message has none.
    """

    def __init__(self, message: str, place: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.place = place


class SpecError(VlaZenohError, ValueError):
    """A model's spec is wrong, or does not fit the profile, or an answer does not fit the spec.

    `reason` is a stable name of what does not fit, for example ``horizon``.
    """

    def __init__(self, message: str, reason: str = "contract") -> None:
        super().__init__(message)
        self.reason = reason


class PromptError(SpecError):
    """A model does not know the prompt. It counts against a worker that is chosen only: to any
    other the prompt was not addressed."""


class ResourceError(VlaZenohError, FileNotFoundError):
    """A model, scene, profile or robot description was not found."""

    def __str__(self) -> str:  # FileNotFoundError would print errno and file name
        return str(self.args[0]) if self.args else ""


def how_to_install(extra: str = "", package: str = "", needed: Iterable[str] = ()) -> str:
    """Command that installs this package, with an extra; or a `package` of its ``plugins/``.

    `needed` are others of them, without which the package does not work.

    Never by name alone: the package is on no index, and anyone could register the name there.
    """
    extras = f"[{extra}]" if extra else ""
    if not package and (wheel := _wheel_url()):
        what = f"'vla-zenoh{extras} @ {wheel}'"
        return f"pip install {what}, or in one go: uvx --from {what} vla-zenoh ..."
    this = f"'.{extras}'" if extra and not package else "."
    folders = [f"'./plugins/{other}'" for other in needed]
    folders += [f"'./plugins/{package}{extras}'"] if package else []
    what = " ".join((this, *folders))
    return f"pip install -c constraints.txt {what} in a checkout of vla-zenoh"


def _wheel_url() -> str:
    """Address of the wheel that this package was installed from; empty: it was no wheel."""
    try:
        origin = importlib.metadata.distribution("vla-zenoh").read_text("direct_url.json")
    except importlib.metadata.PackageNotFoundError:
        return ""
    url = str(json.loads(origin or "{}").get("url", ""))
    return url if url.endswith(".whl") else ""


class MissingExtraError(VlaZenohError, ImportError):
    """A Python module is not installed; an extra of this package or of a plug-in brings it."""

    def __init__(self, module: str, extra: str, package: str = "") -> None:
        super().__init__(
            f"the Python module {module!r} is not installed; "
            f"install it with: {how_to_install(extra, package)}"
        )


class PluginError(VlaZenohError):
    """A plug-in is not installed, or cannot be imported; see `vla_zenoh.plugins`."""


class SessionError(VlaZenohError, ConnectionError):
    """No Zenoh session could be opened."""


class StartingError(SessionError):
    """An activation was rejected only because something is still starting."""


class WorkerError(VlaZenohError):
    """A model worker cannot be loaded, or broke its contract."""


class RecordingError(VlaZenohError):
    """A recorded run cannot be written or read."""


class OutputError(VlaZenohError):
    """An output file or folder cannot be written, or would overwrite something."""


class PeerError(CountedError):
    """A policy server gave no usable answer."""


class NodeError(VlaZenohError):
    """A node cannot start or continue: a second command node, a dead device."""


class SecurityError(VlaZenohError):
    """A certificate or key cannot be made or used."""


_VALIDATION_WORDS = {
    "missing": "is missing",
    "extra_forbidden": "is not known here",
    **dict.fromkeys(("float_type", "float_parsing"), "wants a number"),
    **dict.fromkeys(("int_type", "int_from_float", "int_parsing"), "wants a whole number"),
    "int_parsing_size": "has too many digits",
    **dict.fromkeys(("bool_type", "bool_parsing"), "wants true or false"),
    "string_type": "wants text",
    "string_unicode": "holds half a character (a surrogate)",
    "tuple_type": "wants a list",
    **dict.fromkeys(("dict_type", "model_type"), "wants a map"),
    "finite_number": "wants a finite number",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "too_long": "has {actual_length} entries, at most {max_length} fit",
    "too_short": "has {actual_length} entries, wants at least {min_length}",
    "string_too_long": "is longer than {max_length} characters",
    "string_too_short": "must not be empty",
}
_QUOTED = re.compile(r"'([^']*)'")


def describe_fault(fault: Any) -> str:
    """One entry of ``ValidationError.errors()``, as text that follows a field's name."""
    context = fault.get("ctx", {})
    if fault["type"] == "literal_error":
        near = nearest(str(fault.get("input")), _QUOTED.findall(context["expected"]), "")
        return f"wants {context['expected']}{near}"
    words = _VALIDATION_WORDS.get(fault["type"])
    if words is not None:
        return words.format(**context)
    said = fault["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
    if not said.startswith("Input should "):
        return said
    wanted = re.sub(r", unable to .*|(?<=a )valid ", "", said.removeprefix("Input should "))
    return f"wants {wanted.removeprefix('be ')}"


_OF_TYPE = re.compile(r"[a-z-]+\[.*\]|(constrained|function)-.*")
"""In what Pydantic calls a type."""


def describe_faults(error: Any, top: str, most: int = 20, *, given: bool = False) -> str:
    """The faults of a ``ValidationError`` in one line: each with its field, or `top`.

    With the value that was `given`, if asked for.
    """
    out: list[str] = []
    for fault in error.errors(include_url=False)[:most]:
        # Pydantic names the types of a union among the fields.
        fields = [str(each) for each in fault["loc"] if not _OF_TYPE.fullmatch(str(each))]
        place, value = ".".join(fields) or top, fault.get("input")
        said = f"{place}: {describe_fault(fault)}" if place else describe_fault(fault)
        if given and isinstance(value, (str, int, float)) and fault["type"] != "missing":
            said += f" (given: {reprlib.repr(value)})"
        out.append(said[:300])
    return "; ".join(out)


def nearest(word: str, known: Iterable[str], otherwise: str = ".") -> str:
    """``; did you mean 'x'?`` if one of `known` is like `word`, else `otherwise`."""
    close = difflib.get_close_matches(word, list(known), 1)
    return f"; did you mean {close[0]!r}?" if close else otherwise


def counted(count: int, noun: str) -> str:
    """``1 error``, ``2 errors``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


MAX_FOREIGN = 600
"""Characters of another library's message that are kept."""


def in_words(error: BaseException) -> str:
    """Message of any exception, for a person: without addresses of manuals or unsafe advice.

    A message of ours is kept. That of another library follows the name of its exception; faults of
    a Pydantic model are named field by field, and for a file that PyTorch refuses to unpickle its
    own advice to execute the file's content is replaced.
    """
    if isinstance(error, VlaZenohError):
        return str(error)
    if type(error).__name__ == "ValidationError" and callable(getattr(error, "errors", None)):
        title = getattr(error, "title", "it")
        return f"{title} is wrong: {describe_faults(error, '', given=True)}"
    name, text = type(error).__name__, str(error).strip()
    if "weights_only" in text:
        return (
            f"{name}: the file holds Python objects beside weights, and loading "
            "those runs code from the file. Convert it to safetensors, or save its state_dict() "
            "alone, where you trust it"
        )
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, KeyError) and error.args:
        return f"KeyError: there is no {error.args[0]!r}"
    short = text if len(text) <= MAX_FOREIGN else f"{text[:MAX_FOREIGN]} ..."
    return f"{name}: {short}" if short else name
