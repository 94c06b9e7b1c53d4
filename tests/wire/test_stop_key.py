"""``vla-zenoh stop --wait-key``: every key stops, and so does leaving, in whatever way."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from chain import Chain

END_S = 20.0


@contextmanager
def standing(chain: Chain, stdin: int) -> Iterator[subprocess.Popen[str]]:
    """The command, ready."""
    words = [sys.executable, "-m", "vla_zenoh", "stop", "--wait-key"]
    with subprocess.Popen(
        [*words, "--profile", str(chain.profile_file)],
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("Every key stops robot panda")
            yield process
        finally:
            process.kill()


def stopped(chain: Chain) -> bool:
    status = chain.client.status("command")
    return status is not None and status.state == "stopped"


def test_every_key_of_a_terminal_stops_and_the_command_stays(chain: Chain) -> None:
    terminal, other = pty.openpty()
    try:
        with standing(chain, other) as process:
            for key in (b" ", b"\r", b"x", b"x"):  # one of them again
                assert not stopped(chain)
                os.write(terminal, key)
                chain.until(f"{key!r} has stopped it", lambda: stopped(chain))
                assert process.poll() is None
                chain.settle()
    finally:
        os.close(terminal)
        os.close(other)


@pytest.mark.parametrize(
    "number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP], ids=lambda n: n.name
)
def test_leaving_by_a_signal_stops(chain: Chain, number: signal.Signals) -> None:
    read, write = os.pipe()
    with standing(chain, read) as process:
        os.close(read)
        process.send_signal(number)
        assert process.stdout is not None
        said = process.stdout.read()
        assert process.wait(END_S) == 130
        assert "CONFIRMED: robot panda" in said
    os.close(write)
    chain.until("it is stopped", lambda: stopped(chain))


def test_the_end_of_the_input_stops(chain: Chain) -> None:
    read, write = os.pipe()
    with standing(chain, read) as process:
        os.close(read)
        os.close(write)
        assert process.wait(END_S) == 0
    chain.until("it is stopped", lambda: stopped(chain))
