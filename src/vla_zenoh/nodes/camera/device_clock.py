"""Converts the time stamps of a camera's own clock to the clock of this computer."""

from __future__ import annotations

from collections import deque

WINDOW_S = 20.0
"""A clock that is off by 100 ppm moves by 2 ms in this time."""
SET_S = 0.5
"""A stamp that jumps further against its arrival means that the camera's clock was set."""


class DeviceClock:
    """Offset of a camera's clock: the shortest time from stamp to arrival in the last `WINDOW_S`.

    Extra time over that of the fastest image is delay of the bus or this computer, not part of the
    capture time. The delay of the fastest one is unknown and counts as zero.
    """

    def __init__(self) -> None:
        self._offsets: deque[tuple[int, int]] = deque()  # arrival, arrival - stamp; both ascending

    def host_ns(self, device_ns: int, arrival_ns: int) -> int:
        """Time of capture on the clock of `arrival_ns`, never later than that.

        Args:
            device_ns: stamp of the camera, on its own clock.
            arrival_ns: when the image arrived, on the clock of this computer.
        """
        offset_ns = arrival_ns - device_ns
        offsets = self._offsets
        if offsets and abs(offset_ns - offsets[0][1]) > SET_S * 1e9:
            offsets.clear()
        while offsets and offsets[-1][1] >= offset_ns:
            offsets.pop()
        offsets.append((arrival_ns, offset_ns))
        while arrival_ns - offsets[0][0] > WINDOW_S * 1e9:
            offsets.popleft()
        return device_ns + offsets[0][1]
