"""Who may use the page: people and their tokens, hosts, origins, headers. Pure."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple

from vla_zenoh.errors import ProfileError, SecurityError, in_words
from vla_zenoh.keys import key_chunk
from vla_zenoh.profile.load import read_yaml
from vla_zenoh.security.store import open_to_others

PageRole = Literal["operator", "viewer"]
MIN_TOKEN = 16
"""Characters: `openssl rand -hex 16` makes 32."""
MAX_PEOPLE = 64


class Person(NamedTuple):
    """A person who may use the page.

    Args:
        name: in messages and in the name of a deadman.
        role: rights, as in `vla_zenoh.security.roles`.
    """

    name: str
    role: PageRole
    token: str

    @property
    def drives(self) -> bool:
        return self.role == "operator"


class People:
    """The people of a page, found by their tokens.

    Args:
        most: highest role: that of the certificate with which the page is on the bus.
        file: where `people` were read, and are read again when it changes.
    """

    def __init__(
        self, people: Iterable[Person], most: PageRole = "operator", file: Path | None = None
    ) -> None:
        self._most: PageRole = most
        self._file, self._version = file, _version(file)
        self._named = self._digested(people)
        self._invited: list[tuple[bytes, Person]] = []

    def _digested(self, people: Iterable[Person]) -> list[tuple[bytes, Person]]:
        return [(_digest(one.token), self._bounded(one)) for one in people]

    @property
    def _people(self) -> list[tuple[bytes, Person]]:
        return [*self._named, *self._invited]

    def reread(self) -> bool:
        """Read the file again; whether it had changed.

        Raises:
            SecurityError: it is none of people any more; those that it had stay.
        """
        version = _version(self._file)
        if self._file is None or version == self._version:
            return False
        self._version = version
        self._named = self._digested(read_people(self._file))
        return True

    def has(self, person: Person) -> bool:
        """Whether this person, with this token and role, is one of them still."""
        return any(known == person for _, known in self._people)

    def _bounded(self, person: Person) -> Person:
        return person if self._most == "operator" else person._replace(role=self._most)

    def invite(self, name: str, role: PageRole, token: str) -> Person:
        """One more person, for as long as this server runs.

        Raises:
            SecurityError: the name is none, or taken, or there are too many people.
        """
        try:
            person = self._bounded(Person(key_chunk(name, "person"), role, token))
        except ProfileError as error:
            raise SecurityError(str(error)) from error
        if any(known.name == name for _, known in self._people):
            raise SecurityError(f"there is a {name} already: choose another name")
        if len(self._people) >= MAX_PEOPLE:
            raise SecurityError(f"{MAX_PEOPLE} people have a token: restart the server")
        self._invited.append((_digest(token), person))
        return person

    def find(self, token: str) -> Person | None:
        """Whose token this is; takes the same time whatever is wrong with it."""
        given, found = _digest(token), None
        for digest, person in self._people:
            if hmac.compare_digest(digest, given):
                found = person
        return found


def _version(file: Path | None) -> tuple[int, int, int] | None:
    """Differs after a change of the file; None: there is none."""
    if file is None:
        return None
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ino, found.st_size


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "replace")).digest()


def read_people(path: Path) -> list[Person]:
    """People of a YAML file ``NAME: {role: operator, token: ...}``.

    Raises:
        SecurityError: it cannot be read, others can read it, or an entry is wrong; says which.
    """
    try:
        if fault := open_to_others(path):
            raise SecurityError(fault)
        data, _ = read_yaml(path.read_bytes(), str(path))
    except (OSError, ProfileError) as error:
        raise SecurityError(f"--people: {in_words(error)}") from error
    people: list[Person] = []
    for name, entry in data.items():
        fields = entry if isinstance(entry, dict) else {}
        role, token = fields.get("role"), fields.get("token")
        if fields.keys() != {"role", "token"} or role not in ("operator", "viewer"):
            raise SecurityError(
                f"{path}: {name}: write {{role: operator, token: ...}}; a role is operator or "
                "viewer"
            )
        if not isinstance(token, str) or len(token) < MIN_TOKEN:
            raise SecurityError(
                f"{path}: {name}: the token needs {MIN_TOKEN} characters or more, in quotes; "
                "`openssl rand -hex 16` makes one"
            )
        try:
            people.append(Person(key_chunk(name, "person"), role, token))
        except ProfileError as error:
            raise SecurityError(f"{path}: {error}") from error
    if not people:
        raise SecurityError(f"{path} names no person: write NAME: {{role: operator, token: ...}}")
    if len({person.token for person in people}) < len(people):
        raise SecurityError(f"{path}: two people have the same token")
    return people


def host_is_ours(host: str, names: Iterable[str]) -> bool:
    """Whether the header ``Host`` names this server.

    A foreign name that was made to resolve to us (DNS rebinding) does not; an address
    cannot be such a name.

    Args:
        host: with or without a port.
        names: of this server, beside ``localhost``.
    """
    name = host.rpartition("]")[0].lstrip("[") if host.startswith("[") else host.partition(":")[0]
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name.lower() in {"localhost", *(known.lower() for known in names)}
    return True


def origin_is_ours(origin: str, host: str, *, secure: bool) -> bool:
    """Whether the header ``Origin`` says that the page itself asks, not a page of another site."""
    return bool(host) and origin.lower() == f"http{'s' if secure else ''}://{host}".lower()


HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
    "cache-control": "no-store",
}


def with_headers(send: Any) -> Any:
    """`send` with `HEADERS` on every response that has none of its own."""

    async def sending(message: Any) -> None:
        if message["type"] == "http.response.start":
            own = list(message.get("headers", ()))
            given = {name for name, _ in own}
            more = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
            own += [(name, value) for name, value in more if name not in given]
            message = {**message, "headers": own}
        await send(message)

    return sending
