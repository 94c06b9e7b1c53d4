"""Shell commands that copy certificates, a profile and all its files to other computers."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator
from pathlib import Path

from vla_zenoh.profile import Profile
from vla_zenoh.profile.files import FileUse, NeededFiles, needed_files
from vla_zenoh.security.store import Store

SEARCHED = "vla-zenoh"
"""Folder in the home on the other computer, for files that a profile finds by name."""


def copy_commands(
    profile: Profile, file: Path, store: Store, hosts: Collection[str], more: Collection[str] = ()
) -> Iterator[str]:
    """Lines to type here, then on the other computers.

    Args:
        profile: the secured one.
        file: of that profile.
        store: of the certificates.
        hosts: get their certificates and the profile.
        more: get only the profile.
    """
    needed = needed_files(str(file))
    for host in (*hosts, *more):
        if host in hosts:
            yield from _certificates(profile, store, host)
        yield from _files(needed, file, host)
    for what in needed.missing:
        yield f"Not on this computer, so not copied: {what}"
    if not (hosts or more):
        return
    if needed.searched:
        yield f"There, first: export VLA_ZENOH_PATH=~/{SEARCHED}"
    there = shlex.quote(f"./{needed.profile}")
    if any(host in profile.hosts for host in hosts):
        yield f"There: vla-zenoh up {there} --host NAME"
    yield f"To watch, there: vla-zenoh status --profile {there}"


def _certificates(profile: Profile, store: Store, host: str) -> Iterator[str]:
    assert profile.session.security is not None
    # ssh and scp start in the home folder.
    target = shlex.quote(profile.session.security.folder.removeprefix("~/"))
    yield f"  ssh {host} mkdir -p {target}"
    yield f"  scp -rp {shlex.quote(str(store.folder / host))} {host}:{target}/"


def _files(needed: NeededFiles, file: Path, host: str) -> Iterator[str]:
    beside = needed.beside
    if all("/" not in name and (beside.base / name).is_file() for name in beside.names):
        paths = [file if name == needed.profile else beside.base / name for name in beside.names]
        yield f"  scp {' '.join(shlex.quote(_shown(path)) for path in paths)} {host}:"
    else:
        yield _packed(beside, host)
    for part in needed.searched:
        yield f"  ssh {host} mkdir -p {SEARCHED}"
        yield _packed(part, host, SEARCHED)
    if needed.home.names:
        yield _packed(needed.home, host)
    if needed.whole.names:
        yield _packed(needed.whole, host, "/")


def _packed(part: FileUse, host: str, there: str = "") -> str:
    """Files with their folders, copied below the home or another folder there."""
    names = " ".join(map(shlex.quote, part.names))
    into = f"-C {there} " if there else ""
    return f"  tar -C {shlex.quote(str(part.base))} -chf - {names} | ssh {host} tar {into}-xf -"


def _shown(path: Path) -> str:
    """The shortest path from here."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)
