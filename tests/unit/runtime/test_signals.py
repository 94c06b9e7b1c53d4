"""What ends a program in an orderly way."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from vla_zenoh.runtime.process import stop_on_signals


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    kept = {
        number: signal.getsignal(number)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_a_service_manager_and_a_terminal_that_is_closed_end_it(number: int) -> None:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    stop = stop_on_signals()
    assert signal.getsignal(number) != signal.SIG_DFL
    os.kill(os.getpid(), number)
    assert stop.wait(5.0)


def test_under_nohup_it_outlives_its_terminal() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    stop_on_signals()
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
