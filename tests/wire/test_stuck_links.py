"""Links that are stuck: who gives whom up first, and what the kernel is told."""

from __future__ import annotations

import socket
import sys

import pytest

from vla_zenoh.nodes.session import config
from vla_zenoh.nodes.sockets import Impatience
from vla_zenoh.profile import SessionProfile

LEASE_MS = 700
ROUTER = "tcp/127.0.0.1:7447"


def lease_ms(mode: str, *connect: str) -> int:
    """How long the other side waits for one of this kind."""
    found = config(SessionProfile(lease_ms=LEASE_MS), mode=mode, connect=connect or None)
    return found["transport"]["link"]["tx"]["lease"]


def test_who_connects_waits_longer_than_who_is_connected_to() -> None:
    client, linked, first = lease_ms("client"), lease_ms("router", ROUTER), lease_ms("router")
    # A client waits for what its router announces, and that router for what the client does.
    assert first > linked > client == LEASE_MS


def test_a_client_does_not_close_a_stuck_link_before_its_router_does() -> None:
    closes_us = {
        mode: config(SessionProfile(lease_ms=LEASE_MS), mode=mode)["transport"]["link"]["tx"][
            "queue"
        ]["congestion_control"]["block"]["wait_before_close"]
        for mode in ("client", "router")
    }
    assert closes_us["client"] >= 1000 * lease_ms("router")
    assert closes_us["router"] < 1000 * LEASE_MS


@pytest.mark.skipif(sys.platform != "linux", reason="TCP_USER_TIMEOUT is Linux's")
def test_the_kernel_ends_connections_whose_data_nobody_acknowledges() -> None:
    impatience = Impatience(0.7)
    with socket.create_server(("127.0.0.1", 0)) as server:
        before = impatience.look()
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
        with near, far, socket.socket(socket.AF_INET, socket.SOCK_DGRAM):
            assert impatience.look() == before + 2  # and not the datagrams
            for end in (near, far):
                limit_ms = end.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)
                assert limit_ms == LEASE_MS
            near.sendall(b"still at work")
            assert far.recv(64) == b"still at work"
        assert impatience.look() == before
