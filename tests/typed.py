"""Commands as a person types them, run in this process."""

from __future__ import annotations

import signal
import sys
from typing import NamedTuple

import pytest

from vla_zenoh.program.entry import main

HANDLED = (signal.SIGINT, signal.SIGTERM)


class Typed(NamedTuple):
    """What a command left behind."""

    code: int
    stdout: str
    stderr: str

    @property
    def said(self) -> str:
        """Its errors on one line, without the frame around errors of usage."""
        return " ".join(self.stderr.translate(str.maketrans("│╭╮╰╯─", "      ")).split())


def typed(capsys: pytest.CaptureFixture[str], *words: str) -> Typed:
    """Run ``vla-zenoh`` with `words`; a traceback is an error of the test."""
    before = [signal.getsignal(number) for number in HANDLED]
    argv, sys.argv = sys.argv, ["vla-zenoh", *words]
    capsys.readouterr()
    code = 0
    try:
        main()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
    finally:
        sys.argv = argv
        for number, handler in zip(HANDLED, before, strict=True):
            signal.signal(number, handler)
    out, err = capsys.readouterr()
    return Typed(code, out, err)
