"""Which network addresses are this computer's own."""

from __future__ import annotations

import ipaddress
import socket
from typing import Any


def is_own(address: str) -> bool:
    """Whether `address`, or the host name it is, belongs to this computer."""
    try:
        found = socket.getaddrinfo(address, 0, type=socket.SOCK_DGRAM)
    except OSError:
        return False
    return any(_can_bind(family, place) for family, _, _, _, place in found)


def _can_bind(family: int, place: tuple[Any, ...]) -> bool:
    if ipaddress.ip_address(str(place[0]).partition("%")[0]).is_unspecified:
        return False  # any computer can bind 0.0.0.0
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(place)
        except OSError:
            return False
    return True
