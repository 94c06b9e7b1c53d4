"""Outputs that cannot be written: a full disk, a reader that left, a closed stdout."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

STOP_S = 2.5
"""Beyond the first word of a stop, and short of the 10 s for which it goes on."""
NOWHERE = "tcp/127.0.0.1:9"


@contextmanager
def full_disk() -> Iterator[int]:
    number = os.open("/dev/full", os.O_WRONLY)
    yield number
    os.close(number)


@contextmanager
def no_reader() -> Iterator[int]:
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


@contextmanager
def closed() -> Iterator[None]:
    yield None


OUTPUTS = {"full disk": full_disk, "no reader": no_reader, "closed": closed}


def start(output: str, *words: str, unbuffered: str = "") -> subprocess.Popen[str]:
    """``vla-zenoh`` whose stdout is such an output, and whose stderr is read."""
    close = (lambda: os.close(1)) if output == "closed" else None
    with OUTPUTS[output]() as number:
        return subprocess.Popen(
            [sys.executable, "-m", "vla_zenoh", *words],
            stdout=number,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=close,
            env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
        )


def test_a_stop_goes_on_whatever_becomes_of_its_output() -> None:
    words = ("stop", "--profile", "panda_sim", "--connect", NOWHERE)
    running = {output: start(output, *words) for output in OUTPUTS}
    time.sleep(STOP_S)
    ended = {output: process.poll() for output, process in running.items()}
    said = {}
    for output, process in running.items():
        process.kill()
        _, said[output] = process.communicate()
    assert ended == dict.fromkeys(OUTPUTS)
    assert said == dict.fromkeys(OUTPUTS, "")


@pytest.mark.parametrize(
    ("output", "words"),
    [
        ("full disk", "--version"),
        ("no reader", "--help"),
        ("closed", "--version"),
        *((output, "profile show panda_sim") for output in OUTPUTS),
    ],
)
def test_other_commands_say_it_in_one_line_at_most(output: str, words: str) -> None:
    check_end(start(output, *words.split()), output)


def test_a_reader_that_leaves_is_no_traceback_where_nothing_is_buffered() -> None:
    check_end(start("no reader", "profile", "show", "panda_sim", "--json", unbuffered="1"), "")


def check_end(process: subprocess.Popen[str], output: str) -> None:
    """It ended with the status and the sentence for such an output."""
    _, said = process.communicate(timeout=20)
    assert process.returncode == (output != "closed")
    full = "error: the output cannot be written: No space left on device\n"
    assert said == (full if output == "full disk" else "")
