"""vla-zenoh secure revoke, retire and rename: rights that end while a lab is at work."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    MAX_SECONDS,
    JsonOption,
    ProfileOption,
    node_name,
)
from vla_zenoh.cli.output import console, fail
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.client.client import Client
from vla_zenoh.errors import ProfileError, SecurityError, VlaZenohError, nearest
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.cli.output_path import output_file
from vla_zenoh.profile import Profile, load_profile, profile_file
from vla_zenoh.security.bridge import bridges
from vla_zenoh.security.names import NAMES
from vla_zenoh.security.roles import identities_of
from vla_zenoh_secure.authority import CERTIFICATE_DAYS
from vla_zenoh_secure.cli import DaysOption, copy_commands, now_utc
from vla_zenoh_secure.lab_certificates import LabCertificates, renamed
from vla_zenoh_secure.secure_profile import serving_addresses, with_robot_name, without_operator

RETRY_S, POLL_S = 0.2, 0.05
NOT_CONFIRMED = 4
"""Exit status, as of `vla-zenoh stop`: not every router has said in time that it knows."""

WaitOption = Annotated[
    float,
    typer.Option(
        "--wait",
        min=0.0,
        max=MAX_SECONDS,
        help="Seconds to wait until every router reports that the change is in force.",
    ),
]


def revoke(
    host: Annotated[str, typer.Argument(parser=node_name, help="Host whose keys were stolen.")],
    profile: ProfileOption = DEFAULT_PROFILE,
    days: DaysOption = CERTIFICATE_DAYS,
    wait_s: WaitOption = 60.0,
    as_json: JsonOption = False,
) -> None:
    """Deny all certificates of a host that stays, and make new ones under a new name.

    The router closes all links and opens anew with the new rules: active arms brake, and wait to be
    activated. Exits with 4 if not every router reports in time that it has.
    """
    loaded, store = _secured(profile)
    chosen = [*identities_of(loaded, host), *bridges(loaded, host)]
    if host not in store.hosts():
        fail(f"{store.folder} has no certificates of {host!r}{_known(host, store.hosts())}")
    denied, serves = _granted(store, host), host in _serving(store)
    addresses = serving_addresses(loaded)
    made = store.revoke(host, chosen, now_utc(), days=days, addresses=addresses)
    if serves:
        warn(
            f"{host} runs a router or a bridge, which clients know by its address, not by its "
            "name: who has its key can still pose as it. `vla-zenoh secure init` with another "
            "--folder makes a new authority, which ends that"
        )
    out = _Report(store, loaded, as_json)
    names = store.names()
    out.tell(f"revoked {host}: only certificates of NODE@{host}+{names.generations[host]} count")
    for path in made:
        out.tell(f"made {path}")
    out.names_to_copy()
    if host != store.known_host():
        out.tell(f"Then give {host} its certificates, and restart what runs there:")
        out.copy(copy_commands(loaded, profile_file(profile), store, [host]))
    else:
        out.tell(f"This computer is {host}: restart what runs here")
    out.end({"host": host, "denied": denied, "certificates": made}, profile, wait_s)


def retire(
    host: Annotated[
        str | None, typer.Argument(parser=node_name, help="Host, or computer of a person.")
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option("--robot", parser=node_name, help="In place of a host, the profile's robot."),
    ] = None,
    profile: ProfileOption = DEFAULT_PROFILE,
    wait_s: WaitOption = 60.0,
    as_json: JsonOption = False,
) -> None:
    """Deny a host, a person or a robot for good; the certificates of a host are deleted here.

    Routers open anew, as with `secure revoke`. A robot that is retired has no key left on which
    anyone may publish or listen. Exits with 4 if not every router reports in time.
    """
    if (host is None) == (robot is None):
        raise typer.BadParameter("name a host, or a robot with --robot")
    loaded, store = _secured(profile)
    out = _Report(store, loaded, as_json)
    if host is None:
        assert robot is not None
        _require_robot(loaded, robot)
        store.change(renamed(store.names(), robot, None))
        out.tell(f"retired robot {robot}: its keys are denied to everyone")
        out.names_to_copy()
        hosts = ", ".join(each for each in store.hosts() if each in loaded.hosts)
        out.tell(
            f"Its hosts keep their certificates: {hosts}. `vla-zenoh secure retire HOST` ends those"
            " of one that no other robot needs"
        )
        # Nobody hears of this robot any more, its router included.
        out.end({"robot": robot}, profile, 0.0)
        return
    known = [*loaded.hosts, *_people(loaded), *store.hosts()]
    if host not in known:
        fail(
            f"neither profile {loaded.name} nor {store.folder} knows {host!r}{_known(host, known)}"
        )
    if host == store.known_host():
        fail(f"this computer is {host}: retire it from another one that has the authority")
    denied = _granted(store, host)
    if host in loaded.hosts:
        warn(f"profile {loaded.name} still gives {host} nodes: take it out of its section hosts")
    store.retire(host)
    out.tell(f"retired {host}: its name is denied, its certificates here are deleted")
    if host in _people(loaded):
        path = profile_file(profile)
        _write_profile(path, without_operator(path.read_text("utf-8"), host))
        if host in _people(load_profile(profile)):
            warn(f"{path} still names {host}: take it out of people by hand")
    out.names_to_copy()
    out.end({"host": host, "denied": denied}, profile, wait_s)


def rename(
    old: Annotated[str, typer.Argument(parser=node_name, help="The profile's robot.")],
    new: Annotated[str, typer.Argument(parser=node_name, help="Its new name.")],
    profile: ProfileOption = DEFAULT_PROFILE,
    wait_s: WaitOption = 60.0,
    as_json: JsonOption = False,
) -> None:
    """Give a robot another name: routers move all rights from its old keys to the new ones.

    Writes it into the profile, whose nodes have to be restarted; until then the arm stands.
    Certificates name hosts, not robots, and stay valid. Exits with 4 if not every router reports in
    time.
    """
    loaded, store = _secured(profile)
    _require_robot(loaded, old)
    if new == old:
        raise typer.BadParameter(f"the robot is called {old} already")
    path = profile_file(profile)
    try:
        text = with_robot_name(path.read_text("utf-8"), new)
    except SecurityError as error:
        raise SecurityError(f"{path} {error}") from error
    _write_profile(path, text, lambda: store.change(renamed(store.names(), old, new)))
    changed = load_profile(profile)
    out = _Report(store, changed, as_json)
    out.tell(f"robot {old} is now {new} in {path}; its old keys are denied to everyone")
    out.names_to_copy()
    here = store.known_host()
    others = [each for each in (*changed.hosts, *_people(changed)) if each != here]
    out.tell("Then copy the profile, and restart `vla-zenoh up` on every host of the robot:")
    out.copy(copy_commands(changed, path, store, [], others))
    out.end({"robot": new, "was": old, "profile": path}, profile, wait_s)


class _Report:
    """What a command did and what is left to do, as lines or as one JSON object."""

    def __init__(self, store: LabCertificates, profile: Profile, as_json: bool) -> None:
        self._store, self._profile, self._json = store, profile, as_json
        self._copy: list[str] = []

    def tell(self, line: str) -> None:
        if not self._json:
            console().print(line, highlight=False, soft_wrap=True)

    def copy(self, lines: Iterable[str]) -> None:
        """Lines to type."""
        for line in lines:
            self._copy.append(line.strip())
            self.tell(line)

    def names_to_copy(self) -> None:
        """How the changed names get to the routers, which is when the change is in force."""
        security, here = self._profile.session.security, self._store.known_host()
        assert security is not None
        hosts = [host for host in _serving(self._store) if host != here]
        if hosts:
            self.tell("In force as soon as the routers have it; copy first:")
        target = security.folder.removeprefix("~/")
        self.copy(
            f"  scp {shlex.quote(str(self._store.folder / host / NAMES))} "
            f"{host}:{shlex.quote(f'{target}/{host}/')}"
            for host in hosts
        )

    def end(self, answer: dict[str, Any], profile: str, wait_s: float) -> None:
        """Wait for the routers, say which have it, and exit with 4 if one is missing."""
        revision = self._store.names().revision
        routers = _routers(self._profile)

        def told(router: str, after_s: float) -> None:
            self.tell(f"{router}: in force after {after_s:.1f} s")

        found, why = await_routers(profile, routers, revision, wait_s, told)
        missing = [name for name in routers if name not in found] if wait_s else []
        if self._json:
            in_force = {name: found.get(name) for name in routers} if wait_s else {}
            more = {"revision": revision, "copy": self._copy, "in_force_after_s": in_force}
            print_json({**answer, **more})
        if not missing:
            return
        fail(
            f"NOT CONFIRMED in {wait_s:g} s by {', '.join(missing)}{why}. A router that is off "
            f"reads {NAMES} when it starts; a zenohd needs the output of `vla-zenoh node router "
            "--config`, and a restart",
            NOT_CONFIRMED,
        )


def await_routers(
    profile: str,
    routers: Sequence[str],
    revision: int,
    wait_s: float,
    tell: Callable[[str, float], None] = lambda _name, _s: None,
) -> tuple[dict[str, float], str]:
    """Routers that have names of this revision in force -> seconds until they said so; and why no
    more could be asked, if that is so.

    Args:
        tell: called with each of them at once.
    """
    began_s, found, why = time.monotonic(), dict[str, float](), ""

    def left() -> bool:
        return len(found) < len(routers) and time.monotonic() - began_s < wait_s

    while left():
        try:
            loaded = RobotTarget(profile).load()
            with open_session(loaded.session) as session:
                client, why = Client(loaded, session).subscribe(), ""
                while left():
                    for name, (status, _, _) in client.snapshot().items():
                        has = status.detail.get("names")
                        if name not in routers or name in found or not isinstance(has, int):
                            continue
                        if has >= revision:
                            found[name] = time.monotonic() - began_s
                            tell(name, found[name])
                    time.sleep(POLL_S)
        except VlaZenohError as error:  # it may open anew at this moment
            why = f": {error}"
            time.sleep(RETRY_S)
    return found, why


def _secured(profile: str) -> tuple[Profile, LabCertificates]:
    loaded = load_profile(profile)
    if loaded.session.security is None:
        fail(f"profile {loaded.name} is not secured: run `vla-zenoh secure init` first")
    return loaded, LabCertificates(loaded.session.security.folder)


def _require_robot(profile: Profile, name: str) -> None:
    if name != profile.robot.name:
        raise ProfileError(
            f"the robot of profile {profile.name} is {profile.robot.name}, not {name}: give the "
            "profile of the one you mean"
        )


def _people(profile: Profile) -> Iterable[str]:
    return profile.session.security.people if profile.session.security is not None else ()


def _routers(profile: Profile) -> list[str]:
    """Names of the router nodes; of one that is started by hand its usual name."""
    hosts = [name for name, part in profile.hosts.items() if "router" in part.nodes]
    return [profile.node_name(host, "router") for host in hosts] or ["router"]


def _granted(store: LabCertificates, host: str) -> list[str]:
    """Names in the certificates of a host."""
    entries = store.entries(now_utc(), host)
    return sorted(each.certificate.common_name for each in entries if each.certificate)


def _serving(store: LabCertificates) -> list[str]:
    """Hosts whose certificates may serve: those of routers and bridges."""
    found = [each for each in store.entries(now_utc()) if each.host and each.certificate]
    return list(dict.fromkeys(e.host for e in found if e.certificate and e.certificate.addresses))


def _known(name: str, known: Sequence[str]) -> str:
    return f"{nearest(name, known)} Known are: {', '.join(dict.fromkeys(known)) or 'none'}"


def _write_profile(path: Path, text: str, before: Callable[[], None] = lambda: None) -> None:
    """Replace the file of a profile, after `before`; not if the new text is no valid profile."""
    with output_file(path, force=True) as part:
        part.write_text(text, "utf-8")
        try:
            load_profile(str(part))
            before()
        except VlaZenohError:
            part.unlink()
            raise
