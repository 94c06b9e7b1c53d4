"""Entry of ``vla-zenoh``. The words that drive a robot start at once; all others go by Typer.

Typer, Rich and the profile's schema take half a second to load, in which an arm that shall stop
moves on. `WORDS` says which options those commands have; a test compares it with their signatures.
What is not parsed here, ``--help`` and mistakes above all, goes by Typer as well.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, NamedTuple

EXTRA_OF = {
    "pinocchio": "control",
    "ruckig": "control",
    "mujoco": "sim",
    "matplotlib": "sim",
    "av": "sim",
    "mcap": "record",
    "plotly": "record",
    "jinja2": "record",
    "rosbags": "record",
    "rerun": "view",
}
"""Module -> extra that brings it, for the error of a missing import."""


class Word(NamedTuple):
    """A command that starts at once.

    Args:
        arguments: their names; those that may be left out end in ``?``.
        flags: option -> name.
        module: where its function is.
    """

    arguments: tuple[str, ...] = ()
    flags: Mapping[str, str] = {}
    module: str = "vla_zenoh.cli.drive"


WORDS: Mapping[str, Word] = {
    "prompt": Word(("text",)),
    "activate": Word(flags={"--hold": "held"}),
    "deactivate": Word(),
    "use": Word(("worker",)),
    "rate": Word(("rate_hz",)),
    "speed": Word(("percent?",)),
    "stop": Word(flags={"--all": "every", "--wait-key": "wait_key"}),
    "reset": Word(),
    "status": Word(flags={"--json": "as_json", "--once": "once"}, module="vla_zenoh.cli.status"),
}
OPTIONS = {
    **dict.fromkeys(("--profile", "-p"), "profile"),
    **dict.fromkeys(("--connect", "-e"), "connect"),
    "--host": "host",
    "--robot": "robot",
}
"""Of every word: fields of `vla_zenoh.cli.target.RobotTarget`."""
VARIABLES = {
    "VLA_ZENOH_PROFILE": "profile",
    "VLA_ZENOH_CONNECT": "connect",
    "VLA_ZENOH_HOST": "host",
}
REPEATABLE = frozenset({"connect"})
NUMBERS = frozenset({"rate_hz"})


def parse(words: Sequence[str]) -> tuple[str, dict[str, Any], dict[str, Any]] | None:
    """A command line as (word, its arguments, fields of its target); None: it is for Typer."""
    if not words or words[0] not in WORDS:
        return None
    word = WORDS[words[0]]
    target: dict[str, Any] = {}
    for variable, name in VARIABLES.items():
        if given := os.environ.get(variable):
            target[name] = given.split() if name in REPEATABLE else given
    found: dict[str, Any] = dict.fromkeys(word.flags.values(), False)
    positional: list[str] = []
    typed: dict[str, list[str]] = {}
    rest = iter(words[1:])
    for part in rest:
        option, equals, value = part.partition("=")
        if part in word.flags:
            found[word.flags[part]] = True
        elif option in OPTIONS and (not equals or option.startswith("--")):
            following = value if equals else next(rest, None)
            if following is None or following.startswith("-"):
                return None
            typed.setdefault(OPTIONS[option], []).append(following)
        elif part.startswith("-"):
            return None
        else:
            positional.append(part)
    needed = sum(not name.endswith("?") for name in word.arguments)
    if not needed <= len(positional) <= len(word.arguments):
        return None
    for name, value in zip(word.arguments, positional, strict=False):
        try:
            found[name.rstrip("?")] = float(value) if name in NUMBERS else value
        except ValueError:
            return None
    for name, values in typed.items():
        target[name] = values if name in REPEATABLE else values[-1]
    return words[0], found, target


def main() -> None:
    """Run the command line. Errors of this package become one line and exit code 1."""
    try:
        _chosen(sys.argv[1:])()
    except ImportError as error:
        extra = EXTRA_OF.get((error.name or "").partition(".")[0])
        if extra is None and ".so" not in str(error):
            raise
        from vla_zenoh.cli.plain import fail
        from vla_zenoh.errors import how_to_install

        fail(
            f"{error}; install it with: {how_to_install(extra)}"
            if extra
            else f"{error}; `vla-zenoh doctor` names the system package"
        )
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        from vla_zenoh.errors import VlaZenohError

        if not isinstance(error, VlaZenohError):
            raise
        from vla_zenoh.cli.plain import fail

        fail(str(error))


def _chosen(words: Sequence[str]) -> Callable[[], None]:
    parsed = parse(words)
    if parsed is None:
        from vla_zenoh.cli.main import app

        return app
    import zenoh

    from vla_zenoh.cli.target import RobotTarget

    zenoh.init_log_from_env_or("off")  # as main.py does
    name, arguments, target = parsed
    function = getattr(import_module(WORDS[name].module), name)
    return lambda: function(target=RobotTarget(**target), **arguments)
