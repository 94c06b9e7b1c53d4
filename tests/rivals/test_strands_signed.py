"""strands-robots 0.5.3 itself: its own code signs an order for us, and checks our answer."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from peer_rig import free_port
from r2c_rig import Router
from strands_lab import Lab
from strands_rig import PROVIDER, OurPeer, StrandsPeer

ARM, BOSS, PATIENCE_S = "panda", "boss", 30.0
PROFILE = """\
extends: panda_sim
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
"""

pytestmark = pytest.mark.timeout(170)


def test_signatures_of_both_sides_are_believed(tmp_path: Path) -> None:
    """Without an arm: an order that is believed ends at the command node, which is missing."""
    lab, port = Lab(tmp_path), free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    profile_file = tmp_path / "alone.yaml"
    profile_file.write_text(PROFILE.format(endpoint=endpoint))
    certificate, key = map(str, lab.files(ARM))
    theirs = dict(zip(("certificate", "key"), map(str, lab.files(BOSS, "rsa")), strict=True))
    words = ("--obey", BOSS, "--ca", str(lab.authority), "--certificate", certificate, "--key", key)
    answer = f"strands/{BOSS}/response/{ARM}/t1"
    fields = {"instruction": "hold", "duration": 0.2, "policy_provider": PROVIDER}
    order = {"sender_id": BOSS, "target_id": ARM, "command": {"action": "start", **fields}}
    with (
        Router(tmp_path / "router.log", port),
        OurPeer(tmp_path / "ours.log", profile_file, *words) as ours,
        StrandsPeer("carrier", endpoint, tmp_path) as carrier,
    ):
        carrier.ask("watch", key=answer)
        unsigned = {**order, "turn_id": "t0", "timestamp": time.time()}
        carrier.ask("publish", key=f"strands/{ARM}/cmd", body=unsigned)
        ours.until("refused, unsigned")
        signed = [
            (f"strands/{BOSS}/presence", {"robot_id": BOSS}),
            (f"strands/{ARM}/cmd", {**order, "turn_id": "t1"}),
        ]
        carrier.ask("publish_signed", messages=signed, **theirs)
        end_s = time.monotonic() + PATIENCE_S
        while (said := carrier.ask("newest", key=answer)) is None:
            assert time.monotonic() < end_s, ours.text
            time.sleep(0.1)
        assert said["reason"] == "refused"
        assert "no command node" in said["error"]
        assert carrier.ask("verify", authority=str(lab.authority), message=said) == {"cn": ARM}
