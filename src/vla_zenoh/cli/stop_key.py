"""vla-zenoh stop --wait-key: a standby emergency stop for a person beside the arm."""

from __future__ import annotations

import os
import select
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from vla_zenoh.cli.plain import BOLD_RED, say, say_marked

if TYPE_CHECKING:
    from vla_zenoh.bus.client import Client
    from vla_zenoh.cli.target import RobotTarget

POLL_S = 0.1
SILENT_S = 2.0
"""The command node publishes its status twice a second."""
APPEARS_S = 1.5
LEAVING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)


def stop_by_key(target: RobotTarget, confirm: Callable[[Client], None]) -> None:
    """Stop the robot at every key, and when the person leaves; the session stays open meanwhile.

    `confirm` waits until it has stopped and reports that, or raises `SystemExit`.
    """
    with target.client(stop=True) as client, _keys() as pressed:
        try:
            _stand(client, target.named(client), pressed, confirm)
        finally:
            client.stop()
            with suppress(OSError):  # the terminal may be gone
                confirm(client)


def _stand(
    client: Client, name: str, pressed: Callable[[], bool | None], confirm: Callable[[Client], None]
) -> None:
    """Stop the robot at every key, until the input ends."""
    client.wait_for(lambda: _connected(client), APPEARS_S)
    say(f"Every key stops {name}; so does leaving: Ctrl-C, or closing this terminal.")
    connected = True
    while (key := pressed()) is not False:
        if key:
            client.stop()
            with suppress(SystemExit):  # reported already; stay on standby
                confirm(client)
        if connected != (connected := _connected(client)):
            if connected:
                say(f"Connected: every key stops {name}.")
            else:
                silent = f": its command node is silent, no key stops {name}"
                say_marked("NOT CONNECTED", BOLD_RED, silent)


def _connected(client: Client) -> bool:
    found = client.snapshot().get("command")
    return found is not None and found[2] and found[1] < SILENT_S


@contextmanager
def _keys() -> Iterator[Callable[[], bool | None]]:
    """A function that waits briefly for a key: True; None: there was none; False: input ended.

    Signals that end or suspend a program raise `KeyboardInterrupt`, the first one alone.
    """
    number = sys.stdin.fileno()

    def pressed() -> bool | None:
        if not select.select([number], [], [], POLL_S)[0]:
            return None
        return bool(os.read(number, 4096))

    def leave(*_: object) -> None:
        for each in LEAVING:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {each: signal.signal(each, leave) for each in LEAVING}
    restore = _single_keys(number)
    try:
        yield pressed
    finally:
        restore()
        for each, handler in before.items():
            signal.signal(each, handler)


def _single_keys(number: int) -> Callable[[], None]:
    """Let a terminal deliver every key at once, without echo; returns what undoes that."""
    if not os.isatty(number):
        return lambda: None
    import termios
    import tty

    before = termios.tcgetattr(number)
    tty.setcbreak(number)

    def restore() -> None:
        with suppress(termios.error, OSError):  # the terminal may be gone
            termios.tcsetattr(number, termios.TCSADRAIN, before)

    return restore
