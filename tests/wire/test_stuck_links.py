"""Links that are stuck: who gives whom up first."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
import zenoh
from camera_rig import free_endpoint, until

from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session, session_config
from vla_zenoh.keys import Kind
from vla_zenoh.profile import SessionProfile, load_profile, override

pytestmark = pytest.mark.long

LEASE_MS = 700
ROUTER = "tcp/127.0.0.1:7447"
PICTURE = bytes(640 * 480 * 3)
PICTURES_HZ, STATES_HZ = 30, 100
MEASURED_S, TAKES_S = 4.0, 0.2
"""The reader of pictures takes so long for each, and lets no more than a few wait."""
SOONER = 5
"""So many times sooner, at least, a state arrives that has a link of its own."""


def lease_ms(mode: str, *connect: str) -> int:
    """How long the other side waits for one of this kind."""
    found = session_config(SessionProfile(lease_ms=LEASE_MS), mode=mode, connect=connect or None)
    return found["transport"]["link"]["tx"]["lease"]


def test_who_connects_waits_longer_than_who_is_connected_to() -> None:
    client, linked, first = lease_ms("client"), lease_ms("router", ROUTER), lease_ms("router")
    # A client waits for what its router announces, and that router for what the client does.
    assert first > linked > client == LEASE_MS


def test_a_client_does_not_close_a_stuck_link_before_its_router_does() -> None:
    closes_us = {
        mode: session_config(SessionProfile(lease_ms=LEASE_MS), mode=mode)["transport"]["link"][
            "tx"
        ]["queue"]["congestion_control"]["block"]["wait_before_close"]
        for mode in ("client", "router")
    }
    assert closes_us["client"] >= 1000 * lease_ms("router")
    assert closes_us["router"] < 1000 * LEASE_MS


def state_delays_ms(*, separate: bool) -> list[float]:
    """How late states arrive at a node whose own reader of pictures is stuck."""
    endpoint = free_endpoint()
    session = {"listen": [endpoint], "connect": [endpoint], "separate_links": separate}
    profile = override(load_profile("panda_sim"), {"session": session})
    delays_ms: list[float] = []
    stop = threading.Event()
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as eye,
        open_session(profile.session) as arm,
        open_session(profile.session) as far,
    ):
        camera, robot = Node("camera", profile, eye), Node("sim", profile, arm)
        reader = Node("worker-far", profile, far)
        pictures = camera.declare_publisher(profile.keys.camera_raw("front"), Kind.FRAME)
        states = robot.declare_publisher(profile.keys.state_pose, Kind.STATE)

        def heard(sample: zenoh.Sample) -> None:
            delays_ms.append((time.monotonic_ns() - int(sample.payload.to_string())) / 1e6)

        few = zenoh.handlers.FifoChannel(4)
        stuck = reader._session_for(Kind.FRAME).declare_subscriber(pictures.key, few)
        quick = far.declare_subscriber(states.key, zenoh.handlers.Callback(heard, indirect=False))

        def see() -> None:
            while not stop.is_set():
                if stuck.try_recv() is not None:
                    time.sleep(TAKES_S)

        def show() -> None:
            while not stop.wait(1 / PICTURES_HZ):
                pictures.publish(PICTURE)

        threads = [threading.Thread(target=each) for each in (see, show)]
        until("readers of both", lambda: pictures.has_subscribers and states.has_subscribers)
        for thread in threads:
            thread.start()
        end_s = time.monotonic() + MEASURED_S
        while time.monotonic() < end_s:
            states.publish(str(time.monotonic_ns()).encode())
            time.sleep(1 / STATES_HZ)
        stop.set()
        for thread in threads:
            thread.join()
        stuck.undeclare()  # it would hold up the end of its session, too
        quick.undeclare()
        for node in (reader, robot, camera):
            node.close()
    return delays_ms


@pytest.mark.slow
def test_who_is_stuck_in_a_picture_hears_of_the_arm_at_once_by_a_link_of_its_own() -> None:
    found = {separate: state_delays_ms(separate=separate) for separate in (False, True)}
    for separate, delays_ms in found.items():
        p50, p95 = np.percentile(delays_ms, [50, 95])
        word = "of their own" if separate else "shared"
        print(f"links {word}: {len(delays_ms)} states, p50 {p50:.1f}, p95 {p95:.1f} ms")
    assert np.median(found[True]) * SOONER < np.median(found[False])
