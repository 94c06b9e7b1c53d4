"""All nodes of a simulated robot for a command, and their log lines where it fails."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_zenoh.cli.output import errors

if TYPE_CHECKING:
    from vla_zenoh.profile import Profile
    from vla_zenoh.runtime.launch import Host

LAST_LINES = 20


@contextmanager
def up_with_last_lines(host: Host, lines: Collection[str]) -> Iterator[Host]:
    """`host`, up; a failure of the block shows the last log lines.

    Args:
        lines: log lines of its nodes, growing.
    """
    from vla_zenoh.lab.episode import Interrupted

    failed_at: list[str] = []
    try:
        with host as running:
            try:
                yield running
            except Exception:  # whatever it is, it goes on
                failed_at += lines  # before the nodes end
                raise
    except Interrupted:
        raise
    except Exception:
        last = (failed_at or [*lines])[-LAST_LINES:]
        errors().print("\n".join(last), style="dim", soft_wrap=True)
        raise


@contextmanager
def running_nodes(
    profile: Profile, log_file: Path | None = None, **settings: Any
) -> Iterator[Host]:
    """All nodes of a simulated robot; a failure of the block shows the last log lines.

    Args:
        log_file: for their log; None: it is not kept.
        settings: see `Host`.
    """
    from vla_zenoh.runtime.launch import Host

    last: deque[str] = deque(maxlen=LAST_LINES)
    with (log_file or Path(os.devnull)).open("w", encoding="utf-8") as log:

        def write(node: str, line: str) -> None:
            last.append(f"{node:>16} | {line}")
            log.write(f"{last[-1]}\n")
            log.flush()

        host = Host(profile, None, log=write, tell=write, own_router=True, **settings)
        with up_with_last_lines(host, last) as running:
            yield running
