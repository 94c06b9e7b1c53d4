"""Options that several commands share, and `options`, which turns a dataclass into options."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_type_hints

import typer
import zenoh

from vla_zenoh.bus.host import HOST_VARIABLE
from vla_zenoh.errors import ProfileError, nearest
from vla_zenoh.keys import key_chunk

if TYPE_CHECKING:  # Pydantic and the schema: `up` has more to do while it loads them
    from vla_zenoh.policy.loader import ModelFile
    from vla_zenoh.profile import Profile
    from vla_zenoh.profile.stop_profile import StopProfile

MAX_SECONDS = 7 * 24 * 3600
"""Longest time that an option of a command takes: a week."""
MAX_INDEX = 2**31 - 1
"""Largest seed, and largest number of an episode."""
DEFAULT_PROFILE = "panda_sim"
PROFILE_VARIABLE = "VLA_ZENOH_PROFILE"


def endpoint(text: str) -> str:
    """Parse an endpoint of Zenoh, as tcp/10.0.0.2:7447, or raise a `ValueError`."""
    from vla_zenoh.profile.schema import endpoint

    return endpoint(text)


ProfileOption = Annotated[
    str, typer.Option("--profile", "-p", envvar=PROFILE_VARIABLE, help="Name or path of a profile.")
]
ConnectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--connect",
        "-e",
        envvar="VLA_ZENOH_CONNECT",
        parser=endpoint,
        help="Router to connect to, as tcp/HOST:PORT; repeatable.",
    ),
]
ListenOption = Annotated[
    list[str] | None,
    typer.Option(
        "--listen",
        "-l",
        envvar="VLA_ZENOH_LISTEN",
        parser=endpoint,
        help="Where the router listens, as tcp/HOST:PORT; repeatable.",
    ),
]
HostOption = Annotated[
    str | None,
    typer.Option(
        "--host", envvar=HOST_VARIABLE, help="Which host of the profile this computer is."
    ),
]
AlsoOption = Annotated[
    list[str] | None,
    typer.Option("--also", help="Profile of another robot that the router serves; repeatable."),
]
SimOption = Annotated[
    bool, typer.Option("--sim", help="Simulate the robot, whatever drives it in the profile.")
]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="Compute and check everything, command nothing.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
AnswerOption = Annotated[bool, typer.Option("--json", help="Print the answer as JSON on stdout.")]


def node_name(text: str) -> str:
    """Parse a name that is part of a key; a `ProfileError` says what is allowed."""
    return key_chunk(text, "name")


def network_address(text: str) -> str:
    """Parse the IP address or host name of one computer, or raise a `ValueError`."""
    from vla_zenoh.profile.schema import network_address

    return network_address(text)


def bind_address(text: str) -> str:
    """Parse an address to listen at: as `network_address`, or all addresses of this computer."""
    return text if text in ("0.0.0.0", "::") else network_address(text)


def key_expression(text: str) -> str:
    """Parse a key with wildcards, or raise a `ValueError`."""
    try:
        zenoh.KeyExpr(text)
    except zenoh.ZError as error:
        raise ValueError(f"{text!r} is no key: write it as in `vla-zenoh keys`") from error
    return text


def not_empty(text: str) -> str:
    """Parse a text that must say something."""
    if not text.strip():
        raise ValueError("is empty: leave the option out or give a text")
    return text


def options(command: Callable[..., None]) -> Callable[..., None]:
    """Let `command` take dataclasses whose fields are its options.

    Typer reads options from a function's signature. A parameter annotated with a dataclass is
    replaced there by the fields of that dataclass, in their order; the command is called with the
    instance made of their values. Fields are annotated as parameters of a Typer command are. The
    annotations may use Typer and the options of this module where theirs does not import them.
    """
    hints = get_type_hints(command, {**globals(), **command.__globals__}, include_extras=True)
    groups: dict[str, Any] = {
        name: hint for name, hint in hints.items() if dataclasses.is_dataclass(hint)
    }
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        if name in groups:
            names = {**globals(), **vars(sys.modules[groups[name].__module__])}
            signature = inspect.signature(groups[name], eval_str=True, globals=names)
            parameters += signature.parameters.values()
        else:
            parameters.append(parameter.replace(annotation=hints[name]))
    # Keyword only: a field without a default may follow one that has one.
    keywords = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        for name, group in groups.items():
            fields = dataclasses.fields(group)
            given[name] = group(**{field.name: given.pop(field.name) for field in fields})
        command(**given)

    setattr(run, "__signature__", inspect.Signature(keywords))  # noqa: B010
    run.__annotations__ = {each.name: each.annotation for each in keywords}
    return run


def effective_profile(
    profile: str | Profile,
    connect: list[str] | None = None,
    listen: list[str] | None = None,
    host: str | None = None,
    *,
    sim: bool = False,
) -> Profile:
    """A profile with endpoints of the command line in place of its own.

    `host` is this computer among the profile's hosts; it selects the certificates. `sim` replaces
    the robot by a simulated one.

    Raises:
        ProfileError: the profile is invalid.
    """
    from vla_zenoh.profile import load_profile, override, simulated

    loaded = load_profile(profile) if isinstance(profile, str) else profile
    loaded = simulated(loaded) if sim else loaded
    if host is not None:
        require_host(loaded, host)
    changes: dict[str, Any] = {"connect": connect} if connect else {}
    changes |= {"listen": listen} if listen else {}
    if host is not None and loaded.session.security is not None:
        changes["security"] = {"host": host}
    return override(loaded, {"session": changes}) if changes else loaded


def require_host(profile: Profile | StopProfile, host: str) -> None:
    """Raise a `ProfileError` if the profile has no such host, with those it has."""
    security = profile.session.security
    people = () if security is None else tuple(security.people)
    known = (*profile.hosts, *people)
    if host not in known:
        named = ", ".join(known) or "none"
        raise ProfileError(
            f"profile {profile.name} has no host {host!r}{nearest(host, known)} It has: {named}"
        )


@dataclass(frozen=True)
class NodeOptions:
    """Options of a command that runs a node."""

    profile: ProfileOption = DEFAULT_PROFILE
    connect: ConnectOption = None

    def load(self) -> Profile:
        return effective_profile(self.profile, self.connect)


class WorkerChoice(NamedTuple):
    """The worker to run: its name in keys, its model file, and the options of the model."""

    name: str
    model: ModelFile
    options: Mapping[str, str]


@dataclass(frozen=True)
class ModelOptions:
    """Options of a command that loads a model."""

    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="Option of the model as name=value, overrides the profile's; repeatable."
        ),
    ] = None
    python: Annotated[
        str | None, typer.Option("--python", help="Interpreter of a prepared environment.")
    ] = None

    def choose(self, profile: Profile | None, word: str, name: str | None = None) -> WorkerChoice:
        """Find the worker that `word` names: one of the profile, a model's name, or its path.

        Raises:
            ResourceError: there is no such model.
            WorkerError: its header cannot be read, or it has no such option.
            typer.BadParameter: an option is not ``name=value``.
        """
        from vla_zenoh.policy.loader import find_worker

        given = model_options(self.settings or [])
        own, model = find_worker(word, profile.models if profile is not None else {})
        called = name or own
        usual = profile.options.get(called, {}) if profile is not None else {}
        chosen = {**usual, **given}
        # Before an environment is made for the model, which may take minutes and gigabytes.
        if model.missing():
            model.check_options(chosen)
        return WorkerChoice(called, model.for_options(chosen), chosen)


def model_options(given: list[str]) -> dict[str, str]:
    """Parse ``name=value`` texts; `typer.BadParameter` if one is not of this form."""
    out: dict[str, str] = {}
    for option in given:
        key, equals, value = option.partition("=")
        if not equals or not key.isidentifier():
            raise typer.BadParameter(f"--set wants name=value, not {option!r}")
        out[key] = value
    return out
