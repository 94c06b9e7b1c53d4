"""The shipped lab with full pictures: the demo, and an exact motion over a link like a bad radio.

Everything is measured where the arm is: see `netns.flight_log`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

import numpy as np
import pytest
from camera_rig import until
from chain import READY_PATIENCE_S
from netns.flight_log import Flight, read_flight
from netns.lab import needs_namespaces
from netns.site import HERE, Site, secured_site
from netns.wire import Shape

pytestmark = [pytest.mark.netns, pytest.mark.slow, needs_namespaces, pytest.mark.timeout(300)]

STEPS, STEP_M, TOLERANCE_M = 50, 0.01, 0.002
RADIO = Shape(delay_s=0.02, jitter_s=0.005, loss=0.01, rate_bit_s=10e6)
HOSTS = ("robot", "gpu", "desk")
TOUR_S = 120.0
STANDS_S = 1.0


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    with secured_site("extends: panda_sim_lab\n", HOSTS, ("robot",), ("gpu", "desk")) as made:
        made.add("desk", "operator")
        made.hosts["robot"].environment["FLIGHT_FOLDER"] = str(made.folder)
        made.hosts["robot"].python_folders.append(str(HERE / "flight"))
        made.equip(*HOSTS)
        made.up("robot", "gpu")
        log = made.folder / "sim.flight"
        until("the simulator", lambda: log.exists() and log.stat().st_size, READY_PATIENCE_S)
        yield made


def flight(site: Site) -> Flight:
    return read_flight(site.folder / "sim.flight")


def test_the_demo_passes_from_a_desk_with_certificates(site: Site) -> None:
    outcomes = site.ask("desk", "tour.py", timeout_s=TOUR_S)
    assert {outcome["prompt"]: outcome["faults"] for outcome in outcomes if not outcome["ok"]} == {}
    assert len(outcomes) == 10


def test_fifty_steps_are_exact_over_a_link_like_a_bad_radio(site: Site) -> None:
    """20 +-5 ms, 1 % loss, 10 Mbit/s, to the model and to the operator; 5 chunks a second."""
    for host in ("gpu", "desk"):
        site.hosts.shape(host, RADIO)
    time.sleep(STANDS_S)
    start_m = flight(site).position_m[-1]
    found = site.drive("desk", "up", STEPS)
    time.sleep(STANDS_S)
    way_m = flight(site).position_m[-1] - start_m
    carried = {host: site.hosts.shape(host) for host in ("gpu", "desk")}
    net = json.loads(site.vla("robot", "net", "--profile", str(site.profile("robot")), "--json"))
    print(f"way {way_m}, {found}, frames {carried}, keys {net['keys']}")
    assert found["begun_anew"] == []
    assert way_m == pytest.approx([0.0, 0.0, STEPS * STEP_M], abs=TOLERANCE_M)
    assert np.linalg.norm(flight(site).twist[-1, :3]) < TOLERANCE_M
    assert all(way["lost"] > 0 for ways in carried.values() for way in ways)
