"""Ten thousand puts a second by a stranger's own process do not delay the command loop."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chain import Chain
from test_strangers import STRANGER, samples_of

from vla_zenoh.codec import records
from vla_zenoh.nodes.command.node import SPREAD_S
from vla_zenoh.types import Header

FLOOD_HZ = 10_000
LEAST_SHARE = 0.6
"""Of those puts a busy machine must manage, or the flood is none."""
LOOP_SHARE = 0.9
"""Of the ticks of the command loop that must still take place."""
FLOODER = Path(__file__).parent / "flood.py"

pytestmark = pytest.mark.slow


class Flood:
    """What a flood was, once it is over."""

    sent_hz = 0.0


@contextmanager
def flood(
    chain: Chain, key: str, payload: bytes, head: bytes | None, folder: Path
) -> Iterator[Flood]:
    """A stranger's process puts `payload` on `key` while the block lasts."""
    file = folder / "payload"
    file.write_bytes(payload)
    if head is not None:
        (folder / "payload.head").write_bytes(head)
    connect = chain.profile.session.connect[0]
    words = [sys.executable, str(FLOODER), connect, key, str(FLOOD_HZ), str(file)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    found = Flood()
    try:
        yield found
    finally:
        process.terminate()
        said, _ = process.communicate(timeout=30)
    sent, took_s = said.split()
    found.sent_hz = int(sent) / float(took_s)


def commands_gap_s(chain: Chain, since_ns: int, until_ns: int) -> tuple[float, float]:
    """The longest time between two commands, and how many a second."""
    stamps = np.array(
        [
            header.stamp_wall_ns
            for header, _ in chain.recorder.commands()
            if since_ns < header.stamp_wall_ns < until_ns
        ]
    )
    return float(np.diff(stamps).max()) / 1e9, len(stamps) / ((until_ns - since_ns) / 1e9)


def late_us(chain: Chain) -> dict[str, float]:
    found: Any = chain.detail("late_us")
    return found


@pytest.mark.parametrize("name", ["prompt", "delta"])
def test_a_flood_does_not_delay_the_command_loop_beyond_its_watchdog(
    chain: Chain, tmp_path: Path, name: str
) -> None:
    chain.activate_when_ready()
    keys = chain.profile.keys
    if name == "prompt":
        key, payload, head = keys.prompt, b"\xffflood", None
    else:
        key = keys.delta("scripted")
        payload, _ = samples_of(chain, 0.6, key)[key]
        head = records.encode_header(Header(time.time_ns(), 1, STRANGER))
    chain.client.set_prompt("HARD: go up within 0.1")
    chain.until("it moves", chain.moves)
    time.sleep(SPREAD_S)
    before, pid = late_us(chain), chain.pid("command")
    chain.recorder.forget()
    with flood(chain, key, payload, head, tmp_path) as stranger:
        time.sleep(1.0)
        began_ns = time.time_ns()
        time.sleep(SPREAD_S)
        ended_ns = time.time_ns()
        during = late_us(chain)
    gap_s, rate_hz = commands_gap_s(chain, began_ns, ended_ns)
    print(
        f"{name}: {stranger.sent_hz:.0f} puts/s, loop {rate_hz:.1f} Hz, longest gap "
        f"{gap_s * 1e3:.1f} ms, late us before {before}, during {during}"
    )
    assert stranger.sent_hz > LEAST_SHARE * FLOOD_HZ, "this machine cannot make the flood"
    assert chain.pid("command") == pid
    assert gap_s < chain.profile.timing.watchdog_s
    assert during["max"] < chain.profile.timing.watchdog_s * 1e6
    assert rate_hz > LOOP_SHARE * chain.profile.timing.command_hz
    chain.settle()


def test_a_flood_of_stops_stops_the_arm_and_not_the_command_loop(
    chain: Chain, tmp_path: Path
) -> None:
    chain.move()
    began_ns = time.time_ns()
    with flood(chain, chain.profile.keys.stop, b"stop", None, tmp_path) as stranger:
        chain.until("it is stopped", lambda: chain.state() == "stopped")
        time.sleep(SPREAD_S)
        late = late_us(chain)
        status = chain.client.status("command")
        assert status is not None
        rate_hz = status.rates_hz["loop"]
        # Whoever resets is overruled as long as somebody says stop.
        chain.client.publish(chain.client.keys.reset, "")
        time.sleep(1.0)
        assert chain.state() == "stopped"
    assert chain.recorder.track().time_to_stand_s(began_ns) < SPREAD_S
    print(f"stop: {stranger.sent_hz:.0f} puts/s, loop {rate_hz:.1f} Hz, late us {late}")
    assert stranger.sent_hz > LEAST_SHARE * FLOOD_HZ, "this machine cannot make the flood"
    assert late["max"] < chain.profile.timing.watchdog_s * 1e6
    assert rate_hz > LOOP_SHARE * chain.profile.timing.command_hz
    chain.client.publish(chain.client.keys.reset, "")
    chain.until("it is reset", lambda: chain.state() == "inactive")
    chain.activate_when_ready()
    chain.settle()
