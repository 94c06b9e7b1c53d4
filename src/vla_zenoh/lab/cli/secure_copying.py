"""Shell commands that copy certificates and a profile to other computers."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator
from pathlib import Path

from vla_zenoh.profile import Profile
from vla_zenoh.profile.load import followed, paths_in
from vla_zenoh.resources import shipped
from vla_zenoh.security.store import Store


def copy_commands(
    profile: Profile, file: Path, store: Store, hosts: Collection[str], more: Collection[str] = ()
) -> Iterator[str]:
    """Lines to type here, then on the other computers.

    Files beside the profile are copied with it; others that it names are listed.

    Args:
        profile: the secured one.
        file: of that profile.
        store: of the certificates.
        hosts: get their certificates and the profile.
        more: get only the profile.
    """
    if not (hosts or more):
        return
    beside, elsewhere = _files(profile, file)
    for host in (*hosts, *more):
        if host in hosts:
            yield from _certificates(profile, store, host)
        yield f"  scp {' '.join(shlex.quote(_shown(path)) for path in beside)} {host}:"
    for path in elsewhere:
        yield f"Copy this file as well, to the same place: {path}"
    there = shlex.quote(f"./{file.name}")
    if any(host in profile.hosts for host in hosts):
        yield f"There: vla-zenoh up {there} --host NAME"
    yield f"To watch, there: vla-zenoh status --profile {there}"


def _certificates(profile: Profile, store: Store, host: str) -> Iterator[str]:
    assert profile.session.security is not None
    # ssh and scp start in the home folder.
    target = shlex.quote(profile.session.security.folder.removeprefix("~/"))
    yield f"  ssh {host} mkdir -p {target}"
    yield f"  scp -rp {shlex.quote(str(store.folder / host))} {host}:{target}/"


def _files(profile: Profile, file: Path) -> tuple[list[Path], list[Path]]:
    """Files that the profile consists of or names: those beside it, and the others."""
    chain = [path for path, _ in followed(str(file)) if path.parent != shipped("profiles")]
    texts = [
        section[key].removeprefix(prefix) for section, key, prefix in paths_in(profile.model_dump())
    ]
    found = [path.absolute() for path in (*chain, *(Path(text).expanduser() for text in texts))]
    here = file.absolute().parent
    unique = list(dict.fromkeys(found))
    return [p for p in unique if p.parent == here], [p for p in unique if p.parent != here]


def _shown(path: Path) -> str:
    """The shortest path from here."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)
