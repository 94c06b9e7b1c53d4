"""A lab at work: what `net` and `doctor` say of it, and a router that is gone."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

import pytest
from netns.lab import needs_namespaces
from netns.site import Site, secured_site

pytestmark = [pytest.mark.netns, pytest.mark.slow, needs_namespaces, pytest.mark.timeout(300)]

STEPS, STEP_M, TOLERANCE_M = 5, 0.01, 0.001
FIRST, SECOND = 7447, 7457
PLAIN = f"""\
extends: panda_sim
cameras:
  front: {{source: "sim:front", width: 160, height: 120, rate_hz: 20}}
  wrist: null
session:
  listen: [tcp/127.0.0.1:{FIRST}]
  connect: [tcp/127.0.0.1:{FIRST}, tcp/127.0.0.1:{SECOND}]
  separate_links: true
hosts:
  hub: {{nodes: [router], connect: ["tcp/127.0.0.1:{FIRST}"]}}
  spare:
    nodes: [router]
    listen: [tcp/127.0.0.1:{SECOND}]
    link: [tcp/127.0.0.1:{FIRST}]
    connect: [tcp/127.0.0.1:{SECOND}]
  robot: {{nodes: [sim, camera, command]}}
  gpu: {{nodes: [worker]}}
"""


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    with secured_site(PLAIN, ("hub", "spare", "robot", "gpu"), ("hub", "spare")) as made:
        made.equip("hub", "spare", "robot", "gpu")
        made.up("hub", "spare", "robot", "gpu")
        found = made.drive("robot", "up", STEPS)
        assert found["way_m"] == pytest.approx([0.0, 0.0, STEPS * STEP_M], abs=TOLERANCE_M)
        yield made


def test_net_shows_every_pair_of_hosts_and_what_each_key_costs(site: Site) -> None:
    shown = json.loads(site.vla("robot", "net", "--profile", str(site.profile("robot")), "--json"))
    pairs = {(pair["seen_from"], pair["host"]): pair for pair in shown["hosts"]}
    assert {("robot", "gpu"), ("gpu", "robot"), ("this computer", "gpu")} <= set(pairs)
    for pair in pairs.values():  # the hosts are one machine: their clocks are the same one
        assert abs(pair["offset_ms"]) <= pair["uncertainty_ms"]
        assert pair["round_trip_ms"] > 0
    # The worker has a link for pictures beside that for all else.
    links = pairs["gpu", "robot"]["links"]
    assert sorted(links) == [f"tls/{site.hosts['hub'].address}:{at}" for at in (FIRST, FIRST + 1)]
    keys = {(line["key"], line["host"]): line for line in shown["keys"]}
    assert keys["camera/front/jpeg", "robot"]["bytes_s"] > 0
    assert ("camera/front/raw", "robot") not in keys
    assert keys["delta/scripted", "gpu"]["rate_hz"] > 0


def test_doctor_finds_nothing_wrong_on_a_host_of_the_lab(site: Site) -> None:
    words = ("doctor", "--profile", str(site.profile("gpu")), "--host", "gpu", "--json")
    found = {one["name"]: one for one in json.loads(site.vla("gpu", *words))}
    assert found["certificates of gpu"]["level"] == "ok"
    assert found["router takes worker-scripted@gpu"]["level"] == "ok"


def test_the_lab_goes_on_with_its_second_router_when_the_first_is_gone(site: Site) -> None:
    site.hosts["hub"].crash()
    began_s = time.monotonic()
    found = site.drive("robot", "down", STEPS)
    took_s = time.monotonic() - began_s
    assert found["way_m"] == pytest.approx([0.0, 0.0, -STEPS * STEP_M], abs=TOLERANCE_M)
    print(f"driven again within {took_s:.1f} s of the router's end, the motion included")
    site.up("hub")
    found = site.drive("robot", "up", STEPS)
    assert found["way_m"] == pytest.approx([0.0, 0.0, STEPS * STEP_M], abs=TOLERANCE_M)
