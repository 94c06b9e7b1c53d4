"""Names of a lab that are no longer what its profiles say: renewed, renamed, retired.

Zenoh has no revocation lists, so a stolen certificate is denied by the name in it: its host gets
another one. ``names.json`` in a folder of certificates holds them; the package vla-zenoh-secure
writes it, and routers read it while they run.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from vla_zenoh.errors import SecurityError

NAMES = "names.json"


class Names(msgspec.Struct, frozen=True):
    """What changed since the lab was made; `revision` counts the changes.

    Args:
        generations: host -> number of its name, where that is not 1.
        robots: former name of a robot -> its present one; null: retired.
    """

    revision: int = 0
    generations: dict[str, int] = {}
    robots: dict[str, str | None] = {}

    def current(self, name: str) -> str:
        """Common name in the valid certificate of the identity ``NODE@HOST``."""
        generation = self.generations.get(name.rpartition("@")[2], 1)
        return name if generation == 1 else f"{name}+{generation}"


UNCHANGED = Names()


def read_names(folder: Path) -> Names:
    """The file in `folder`; without it nothing has changed.

    Raises:
        SecurityError: it cannot be read. No name is valid then.
    """
    path = folder / NAMES
    try:
        return msgspec.json.decode(path.read_bytes(), type=Names)
    except FileNotFoundError:
        return UNCHANGED
    except (OSError, msgspec.DecodeError) as error:
        raise SecurityError(
            f"{path} cannot be read: {error}. Copy it from the computer of `vla-zenoh secure init`"
        ) from error
