"""What the node ``ros2`` makes of a bridge's answers about DDS."""

from __future__ import annotations

from pathlib import Path

import pytest
import zenoh
from camera_rig import until
from ros2_rig import write_profile
from vla_zenoh_ros2.bridge_view import BridgeView
from vla_zenoh_ros2.middleware import Bridges

from vla_zenoh.bus.session import open_session
from vla_zenoh.profile import load_profile

WRITER = "@/b1/ros2/dds/010f00/writer/010f0001/rt"


@pytest.mark.parametrize(
    ("silent", "written", "named"),
    [
        (["/joint_states"], ["/joint_states"], ["/joint_states"]),
        (["/joint_states", "/front"], ["/front"], ["/front"]),
        (["/joint_states", "/front"], ["/joint_states", "/front"], ["/joint_states", "/front"]),
        (["/joint_states"], [], []),
        ([], ["/joint_states"], []),
    ],
)
def test_a_topic_that_a_node_publishes_and_the_bridge_does_not_pass_on_is_named(
    tmp_path: Path, silent: list[str], written: list[str], named: list[str]
) -> None:
    profile = load_profile(str(write_profile(tmp_path)))

    def describe(query: zenoh.Query) -> None:
        for key in [f"{WRITER}{topic}" for topic in written]:
            if query.key_expr.intersects(zenoh.KeyExpr(key)):
                query.reply(key, "{}")
        query.drop()

    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as ours,
        open_session(profile.session) as theirs,
    ):
        handler = zenoh.handlers.Callback(describe, indirect=False)
        theirs.declare_queryable("@/b1/ros2/**", handler)
        bridges = Bridges(ours, profile, lambda: silent)
        faults = dict(bridges.faults(BridgeView({}, {})))
        if named:
            faults = until("the bridge answers", lambda: _told(bridges))
        why = faults.get("not_matched", "")
        assert why.partition(", and nothing")[0] == "a node publishes " * bool(named) + (
            " and ".join(named)
        )
        assert ("fastdds.type_propagation=disabled" in why) == bool(named)


def _told(bridges: Bridges) -> dict[str, str] | None:
    faults = dict(bridges.faults(BridgeView({}, {})))
    return faults if "not_matched" in faults else None
