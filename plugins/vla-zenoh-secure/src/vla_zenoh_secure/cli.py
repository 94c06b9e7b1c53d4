"""vla-zenoh secure: the certificate authority of a lab, certificates of its hosts and roles."""

from __future__ import annotations

import datetime as dt
import ipaddress
import os
import shlex
import socket
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.text import Text

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    HostOption,
    JsonOption,
    ProfileOption,
    network_address,
    node_name,
    not_empty,
)
from vla_zenoh.cli.output import console, fail, new_table, styled
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import SecurityError, VlaZenohError
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.cli.output_path import ForceOption, output_file
from vla_zenoh.profile import Profile, load_profile, profile_file
from vla_zenoh.profile.load import followed, paths_in
from vla_zenoh.profile.schema import DEFAULT_FOLDER, SecurityProfile
from vla_zenoh.resources import is_path, shipped
from vla_zenoh.security.bridge import bridges
from vla_zenoh.security.certificates import Entry, unfit_certificates
from vla_zenoh.security.roles import PEOPLE, Role, identities, identities_of, operator_identities
from vla_zenoh.security.store import Store
from vla_zenoh_secure.authority import AUTHORITY_DAYS, CERTIFICATE_DAYS
from vla_zenoh_secure.lab_certificates import LabCertificates
from vla_zenoh_secure.secure_profile import (
    moved_hosts,
    profile_text,
    serving_addresses,
    with_operator,
)


def is_own(address: str) -> bool:
    """Whether `address`, or the host name it is, belongs to this computer."""
    with suppress(OSError):
        for family, _, _, _, place in socket.getaddrinfo(address, 0, type=socket.SOCK_DGRAM):
            if ipaddress.ip_address(str(place[0]).partition("%")[0]).is_unspecified:
                continue  # any computer can bind 0.0.0.0
            with socket.socket(family, socket.SOCK_DGRAM) as probe, suppress(OSError):
                probe.bind(place)
                return True
    return False


def copy_commands(
    profile: Profile, file: Path, store: Store, hosts: Collection[str], more: Collection[str] = ()
) -> Iterator[str]:
    """Lines to type here, then on the other computers.

    Files beside the profile are copied with it; others that it names are listed.

    Args:
        hosts: get their certificates and the profile.
        more: get only the profile.
    """
    if not (hosts or more):
        return
    assert profile.session.security is not None
    # ssh and scp start in the home folder.
    target = shlex.quote(profile.session.security.folder.removeprefix("~/"))
    here, files = Path.cwd(), _files(profile, file)
    beside = [path for path in files if path.parent == file.absolute().parent]
    shown = [path.relative_to(here) if path.is_relative_to(here) else path for path in beside]
    for host in (*hosts, *more):
        if host in hosts:
            yield f"  ssh {host} mkdir -p {target}"
            yield f"  scp -rp {shlex.quote(str(store.folder / host))} {host}:{target}/"
        yield f"  scp {' '.join(shlex.quote(str(path)) for path in shown)} {host}:"
    for path in (path for path in files if path not in beside):
        yield f"Copy this file as well, to the same place: {path}"
    there = shlex.quote(f"./{file.name}")
    if any(host in profile.hosts for host in hosts):
        yield f"There: vla-zenoh up {there} --host NAME"
    yield f"To watch, there: vla-zenoh status --profile {there}"


def _files(profile: Profile, file: Path) -> list[Path]:
    """Files that the profile consists of or names."""
    chain = [path for path, _ in followed(str(file)) if path.parent != shipped("profiles")]
    texts = [
        section[key].removeprefix(prefix) for section, key, prefix in paths_in(profile.model_dump())
    ]
    found = [path.absolute() for path in (*chain, *(Path(text).expanduser() for text in texts))]
    return list(dict.fromkeys(found))


def print_certificates(entries: list[Entry], now: dt.datetime) -> None:
    """Print a table of certificates, then each fault and warning."""
    table = new_table("host", "node", "valid until", "days", "serves as")
    wrong: list[Text] = []
    for entry in entries:
        found, colour = entry.certificate, "green"
        if entry.faults:
            colour = "bold red"
        elif entry.warning:
            colour = "yellow"
        table.add_row(
            entry.host or "(the lab)",
            entry.node,
            styled(f"{found.not_after:%Y-%m-%d}", colour) if found else "",
            styled(found.days_left(now), colour) if found else "",
            ", ".join(found.addresses) if found else "",
        )
        named = f"{entry.host or 'the lab'}/{entry.node}"
        whys = entry.faults or ([entry.warning] if entry.warning else [])
        wrong += [styled(f"{named}: {why}", colour) for why in whys]
    screen = console()
    screen.print(table)
    for line in wrong:
        screen.print(line, soft_wrap=True)


def certificate_row(entry: Entry, now: dt.datetime) -> dict[str, object]:
    found = entry.certificate
    return {
        "host": entry.host,
        "node": entry.node,
        "file": str(entry.path),
        "common_name": found.common_name if found else None,
        "not_after": found.not_after.isoformat() if found else None,
        "days_left": found.days_left(now) if found else None,
        "addresses": list(found.addresses) if found else [],
        "faults": list(entry.faults),
        "warning": entry.warning,
    }


FolderOption = Annotated[
    str | None,
    typer.Option(
        "--folder", parser=not_empty, help=f"Of the certificates; default: {DEFAULT_FOLDER}."
    ),
]
AddressOption = Annotated[
    list[str] | None,
    typer.Option(
        "--address",
        parser=network_address,
        help="Another name or address of the router; repeatable.",
    ),
]
DaysOption = Annotated[int, typer.Option("--days", min=1, max=AUTHORITY_DAYS, help="Validity.")]


def init(
    profile: ProfileOption = DEFAULT_PROFILE,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="File to write; default: NAME_secure.yaml."),
    ] = None,
    folder: FolderOption = None,
    lab: Annotated[str, typer.Option("--lab", help="Name of the lab, in its certificates.")] = (
        "our lab"
    ),
    at: Annotated[
        list[str] | None,
        typer.Option("--at", help="HOST=ADDRESS of a router on the network; repeatable."),
    ] = None,
    address: AddressOption = None,
    days: DaysOption = CERTIFICATE_DAYS,
    host: HostOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Make an authority, certificates for all hosts of a profile, and a secured profile."""
    plain = load_profile(profile)
    if host is not None and host not in plain.hosts:
        raise typer.BadParameter(
            f"profile {plain.name} has no host {host!r}, it has: {', '.join(plain.hosts)}. Add a "
            "computer without nodes afterwards, with `vla-zenoh secure add` and `here`"
        )
    if plain.session.security is not None:
        fail(f"profile {plain.name} is already secured; `vla-zenoh secure add HOST` adds to it")
    file = output or Path(f"{plain.name}_secure.yaml")
    store, now = LabCertificates(folder or DEFAULT_FOLDER), now_utc()
    addresses = _router_addresses(at or ())
    endpoints = moved_hosts(plain, addresses)
    text = profile_text(plain, _extends(profile, file), store.folder.absolute(), endpoints)
    with output_file(file, force=force, inputs=[profile_file(profile)]) as part:
        part.write_text(text, "utf-8")
        try:
            load_profile(str(part))
            made = [store.make_authority(lab, now)]
            serving = serving_addresses(plain, (*addresses.values(), *(address or ())))
            everyone = [*identities(plain), *bridges(plain)]
            made += store.add(everyone, now, days=days, addresses=serving)
            here = host or _this_host(plain, addresses)
            if here is not None:
                store.remember_host(here)
        except VlaZenohError:
            part.unlink()
            raise
    written = load_profile(str(file))
    others = [name for name in written.hosts if name != here]
    copy = list(copy_commands(written, file, store, others))
    if as_json:
        lines = [line.strip() for line in copy]
        print_json({"profile": file, "certificates": made, "host": here, "copy": lines})
        return
    out = console()
    for path in (*made, file):
        out.print(f"made {path}", highlight=False, soft_wrap=True)
    if others:
        which = "each of the others" if here is not None else "each host but this one"
        out.print(f"\nCopy to {which} its own folder, and to all of them the profile:")
    for line in copy:
        out.print(line, soft_wrap=True)
    _print_here(here, RobotTarget(str(file) if "/" in str(file) else f"./{file}"))
    key = store.folder / "ca.key"
    out.print(f"Keep {key} here: anyone with it can make certificates.", soft_wrap=True)
    if len(written.hosts) > 1 and all("127.0.0.1" in each for each in written.session.listen):
        warn(
            "the router listens on its own computer only; for a network give its address: "
            "--at HOST=ADDRESS"
        )


def add(
    host: Annotated[
        str, typer.Argument(parser=node_name, help="Host of the profile, or another computer.")
    ],
    profile: ProfileOption = DEFAULT_PROFILE,
    role: Annotated[
        Literal["operator", "viewer", "replay"] | None,
        typer.Option("--role", help="What a person at that computer may do."),
    ] = None,
    address: AddressOption = None,
    days: DaysOption = CERTIFICATE_DAYS,
    renew: Annotated[bool, typer.Option("--renew", help="Replace existing ones.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Make the certificates of one more host, or of a person at a computer."""
    loaded = load_profile(profile)
    security = loaded.session.security
    if security is None:
        fail(f"profile {loaded.name} is not secured: run `vla-zenoh secure init` first")
    new = ""
    if role is not None:
        path = profile_file(profile)
        try:
            new = with_operator(path.read_text("utf-8"), host, Role(role))
        except SecurityError as error:
            raise SecurityError(f"{path} {error}") from error
        chosen = operator_identities(host, Role(role))
        if host in loaded.hosts and renew:
            names = {one.node for one in chosen}
            nodes = [one for one in identities_of(loaded, host) if one.role not in PEOPLE]
            nodes += bridges(loaded, host)
            chosen = [*(one for one in nodes if one.node not in names), *chosen]
    else:
        chosen = [*identities_of(loaded, host), *bridges(loaded, host)]
    store, serving = LabCertificates(security.folder), serving_addresses(loaded, address or ())
    made = store.add(chosen, now_utc(), days=days, addresses=serving, renew=renew)
    if new:
        with output_file(profile_file(profile), force=True) as part:
            part.write_text(new, "utf-8")
        loaded = load_profile(profile)
    for path, why in unfit_certificates(loaded, store.entries(now_utc(), host)).items():
        warn(f"{path} {why}")
    here, file = store.known_host(), profile_file(profile)
    routers = [name for name, part in loaded.hosts.items() if "router" in part.nodes]
    changed = [name for name in routers if new and name not in (host, here)]
    copy = list(copy_commands(loaded, file, store, [] if host == here else [host], changed))
    if as_json:
        lines, restart = [line.strip() for line in copy], routers if new else []
        answer = {"profile": file, "certificates": made, "copy": lines, "restart_router": restart}
        print_json(answer)
        return
    out = console()
    for path in made:
        out.print(f"made {path}", highlight=False, soft_wrap=True)
    for line in copy:
        out.print(line, soft_wrap=True)
    if here is None:
        out.print(f"Is {host} this computer? Then instead: vla-zenoh secure here {host}")
    if new:
        where = " and ".join(routers)
        out.print(f"{host} is now in {file}: restart the router of {where}", soft_wrap=True)


def here(
    host: Annotated[str, typer.Argument(help="Host whose certificates are here.")],
    profile: ProfileOption = DEFAULT_PROFILE,
    folder: FolderOption = None,
) -> None:
    """Note which host this computer is, where it has certificates of several."""
    security = load_profile(profile).session.security
    store = _store(folder, security)
    if host not in store.hosts():
        known = ", ".join(store.hosts()) or "none"
        fail(f"{store.folder} has no certificates of {host!r}; it has those of: {known}")
    console().print(
        f"this computer is {host}, noted in {store.remember_host(host)}", soft_wrap=True
    )


def show(
    profile: ProfileOption = DEFAULT_PROFILE,
    folder: FolderOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show every certificate here: owner, validity, faults. Exits with 1 on a fault."""
    loaded = load_profile(profile)
    security = loaded.session.security
    store, now = _store(folder, security), now_utc()
    entries, robots = store.entries(now), store.names().robots
    if security is not None and folder is None:
        why = unfit_certificates(loaded, entries)
        entries = [
            entry if entry.faults else replace(entry, warning=why.get(entry.path, entry.warning))
            for entry in entries
        ]
    if as_json:
        print_json([certificate_row(entry, now) for entry in entries])
    else:
        print_certificates(entries, now)
        if (host := store.known_host()) is not None:
            console().print(f"this computer is {host}")
    if (robot := loaded.robot.name) in robots:
        what = "retired" if robots[robot] is None else f"renamed to {robots[robot]}"
        warn(f"robot {robot} was {what}: routers of this lab deny its keys")
    if not entries:
        if keys := store.keys_of_hosts():
            fail(f"{keys[0].parent} lacks ca.pem: {COPY}")
        fail(f"{store.folder} has no certificates: {COPY}, or run that if this is its first one")
    if any(entry.faults for entry in entries):
        raise typer.Exit(1)


COPY = "copy this host's folder from the computer where `vla-zenoh secure init` was run"


def _store(folder: str | None, security: SecurityProfile | None) -> LabCertificates:
    return LabCertificates(folder or (security.folder if security is not None else DEFAULT_FOLDER))


def _router_addresses(given: Sequence[str]) -> dict[str, str]:
    out: dict[str, str] = {}
    for text in given:
        host, equals, address = text.partition("=")
        if not equals or not host or not address:
            raise typer.BadParameter(f"--at wants HOST=ADDRESS, not {text!r}")
        if host in out:
            raise typer.BadParameter(f"--at gives host {host!r} two addresses")
        try:
            out[host] = network_address(address)
        except ValueError as error:
            raise typer.BadParameter(f"--at {text}: {error}") from error
    return out


def _this_host(profile: Profile, addresses: dict[str, str]) -> str | None:
    """Which host this computer is, if that can be known."""
    found = [name for name, address in addresses.items() if is_own(address)]
    if not addresses and len(profile.hosts) == 1:
        found = list(profile.hosts)
    return found[0] if len(found) == 1 else None


def _print_here(host: str | None, target: RobotTarget) -> None:
    out = console()
    if host is not None:
        out.print(
            f"This computer is {host}: vla-zenoh up {target.profile} --host {host}", soft_wrap=True
        )
    else:
        out.print(
            "This computer could be any of the hosts (--host): `vla-zenoh secure here HOST` notes "
            "which. Until then commands here use the certificate of any operator.",
            soft_wrap=True,
        )
    out.print(f"To watch, here: {target.typed('status')}", soft_wrap=True)


def now_utc() -> dt.datetime:
    return dt.datetime.now(dt.UTC)


def _extends(name: str, output: Path) -> str:
    """How the new profile names the one it extends: by name, or by relative path."""
    if not is_path(name):
        return name
    path = os.path.relpath(profile_file(name), output.resolve().parent)
    return Path(path).stem if "/" not in path else path
