"""A cable that delays, loses, reorders and throttles, as radio or the way to another site does.

Run as a program it joins two network devices that it makes itself:

    wire.py DEVICE DEVICE          then one JSON object a line on standard input: a `Shape`

The kernel hands over finished Ethernet frames (TAP devices offer no offloading, so every TCP
segment is one), what becomes of each is decided here, and TCP at both ends does the rest. Unlike tc
netem it needs no kernel module, keeps the order of frames unless told otherwise, and changes
between one frame and the next.
"""

from __future__ import annotations

import fcntl
import heapq
import json
import os
import random
import select
import struct
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass

TUN_DEVICE = "/dev/net/tun"
_TUNSETIFF = 0x400454CA
_TAP_WITHOUT_HEADER = 0x0002 | 0x1000
QUEUE_BYTES = 128 * 1024
"""What a small access point holds back when more comes than goes; what is beyond it is dropped."""
ETHERNET_BYTES = 14
MAX_FRAME = 65536
NAP_S = 0.05


@dataclass(frozen=True, slots=True)
class Shape:
    """What a link does to frames, each way alike.

    Args:
        delay_s: one way.
        jitter_s: that varies by up to so much either way, evenly; order is kept.
        loss: share of frames that never arrive.
        reorder: share of frames that overtake those before them.
        rate_bit_s: 0: as fast as it can.
        mtu: larger packets are dropped without a word; 0: none is.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    reorder: float = 0.0
    rate_bit_s: float = 0.0
    mtu: int = 0

    def to_json(self) -> str:
        return json.dumps(asdict(self))


GOOD = Shape()
CUT = Shape(loss=1.0)


class Way:
    """One direction of a link: says when each frame comes out, if it does.

    Args:
        seed: of its luck.
    """

    def __init__(self, seed: int) -> None:
        self.shape = GOOD
        self.carried = self.lost = 0
        self._luck = random.Random(seed)
        self._free_s = self._last_s = 0.0

    def out_s(self, size: int, now_s: float) -> float | None:
        """When a frame of `size` bytes that goes in at `now_s` comes out; None: never."""
        due_s = self._fate(size, now_s)
        if due_s is None:
            self.lost += 1
        else:
            self.carried += 1
        return due_s

    def _fate(self, size: int, now_s: float) -> float | None:
        shape = self.shape
        if shape.mtu and size - ETHERNET_BYTES > shape.mtu:
            return None
        if shape.loss and self._luck.random() < shape.loss:
            return None
        start_s = now_s
        if shape.rate_bit_s:
            start_s = max(now_s, self._free_s)
            if (start_s - now_s) * shape.rate_bit_s > QUEUE_BYTES * 8:
                return None
            start_s += size * 8 / shape.rate_bit_s
            self._free_s = start_s
        if shape.reorder and self._luck.random() < shape.reorder:
            return start_s
        due_s = start_s + shape.delay_s
        if shape.jitter_s:
            due_s += shape.jitter_s * self._luck.uniform(-1.0, 1.0)
        self._last_s = max(due_s, self._last_s)
        return self._last_s


class Wire:
    """Carries frames between two devices until standard input ends.

    Args:
        devices: their names; they are made, and are gone when the process is.
    """

    def __init__(self, devices: Sequence[str]) -> None:
        self._ends = [_tap(name) for name in devices]
        self._ways = {
            end: (Way(seed), other)
            for seed, (end, other) in enumerate(zip(self._ends, reversed(self._ends), strict=True))
        }
        self._flying: list[tuple[float, int, int, bytes]] = []
        self._count = 0

    def run(self) -> None:
        """See the class."""
        orders = sys.stdin.fileno()
        os.set_blocking(orders, False)
        text = b""
        while True:
            wait_s = self._flying[0][0] - time.monotonic() if self._flying else NAP_S
            # Not epoll, which waits in whole milliseconds.
            ready, _, _ = select.select([*self._ends, orders], [], [], min(max(wait_s, 0), NAP_S))
            for descriptor in ready:
                if descriptor != orders:
                    self._take(descriptor)
                    continue
                said = os.read(orders, MAX_FRAME)
                if not said:
                    return
                *lines, text = (text + said).split(b"\n")
                for line in lines:
                    self._obey(line)
            self._hand_over()

    def _obey(self, line: bytes) -> None:
        shape = Shape(**json.loads(line))
        for way, _ in self._ways.values():
            way.shape = shape
        figures = [{"carried": way.carried, "lost": way.lost} for way, _ in self._ways.values()]
        print(json.dumps(figures), flush=True)

    def _take(self, end: int) -> None:
        way, other = self._ways[end]
        while True:
            try:
                frame = os.read(end, MAX_FRAME)
            except (BlockingIOError, OSError):
                return
            due_s = way.out_s(len(frame), time.monotonic())
            if due_s is not None:
                self._count += 1
                heapq.heappush(self._flying, (due_s, self._count, other, frame))

    def _hand_over(self) -> None:
        while self._flying and self._flying[0][0] <= time.monotonic():
            _, _, end, frame = heapq.heappop(self._flying)
            with suppress(OSError):  # the device is down: the frame is lost, as on a pulled cable
                os.write(end, frame)


def _tap(name: str) -> int:
    descriptor = os.open(TUN_DEVICE, os.O_RDWR | os.O_NONBLOCK)
    wish = struct.pack("16sH22x", name.encode(), _TAP_WITHOUT_HEADER)
    fcntl.ioctl(descriptor, _TUNSETIFF, wish)
    return descriptor


if __name__ == "__main__":
    wire = Wire(sys.argv[1:3])
    print("ready", flush=True)
    wire.run()
