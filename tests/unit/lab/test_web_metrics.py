"""``/metrics`` is OpenMetrics whatever a status holds; the arm's lines are its kinematics."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_records import statuses
from vla_zenoh_web.arm import ArmLines

from vla_zenoh.cli.node_rows import NodeRow
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.policy import ActionSpec, ModelSpec, ObservationSpec
from vla_zenoh.profile import load_profile
from vla_zenoh.types import JointState, NodeStatus

parser = pytest.importorskip("prometheus_client.openmetrics.parser", reason="needs vla-zenoh-web")
metrics = pytest.importorskip("vla_zenoh_web.metrics", exc_type=ImportError)
exposition, MAX_SERIES = metrics.exposition, metrics.MAX_SERIES

ATOL_M = 2e-4
"""Lines are rounded to 0.1 mm."""
HOME = load_profile("panda_sim").robot.home_rad


def row(status: NodeStatus, name: str = "command") -> NodeRow:
    return NodeRow(name, status.host, status.state, "", status, 0.5, True)


def parsed(text: bytes) -> dict[str, list]:
    """Family -> samples; raises where the text is no OpenMetrics."""
    families = list(parser.text_string_to_metric_families(text.decode()))
    return {family.name: family.samples for family in families}


@given(st.lists(statuses, max_size=3))
def test_whatever_a_status_holds_it_is_openmetrics(found: list[NodeStatus]) -> None:
    rows = [row(status, f"node{number}") for number, status in enumerate(found)]
    assert "vla_zenoh_web_pages" in parsed(exposition([*rows[:1], *rows[1:]], {"a b": 1}, 2))


def test_gpus_of_a_workers_host_are_told_apart_and_none_is_a_number() -> None:
    gpu = {"name": "Card", "used_bytes": 3, "total_bytes": 80, "load_percent": 34}
    unknown = {**gpu, "load_percent": None}
    details = {
        "worker-a": {"gpus": [gpu, unknown], "gpu_own_bytes": 2},
        "worker-b": {"gpus": [], "gpu_own_bytes": None},
        "camera": {},
    }
    statuses = {
        name: NodeStatus(name, "ok", "h", 1, 2, detail=detail) for name, detail in details.items()
    }
    rows = [row(status, name) for name, status in statuses.items()]
    found = parsed(exposition(rows, {}, 0))
    counts = {sample.labels["node"]: sample.value for sample in found["vla_zenoh_gpus"]}
    assert counts == {"worker-a": 2, "worker-b": 0}
    used = found["vla_zenoh_gpu_memory_used_bytes"]
    assert [(sample.labels["gpu"], sample.value) for sample in used] == [("0", 3), ("1", 3)]
    (load,) = found["vla_zenoh_gpu_load_ratio"]
    assert (load.labels["gpu"], load.value) == ("0", 0.34)
    (own,) = found["vla_zenoh_gpu_own_bytes"]
    assert (own.labels["node"], own.value) == ("worker-a", 2)


def test_counters_latencies_and_the_arm_have_base_units() -> None:
    status = NodeStatus(
        "command",
        "active",
        "h",
        1,
        2_000_000_000,
        {"pose": 0.1},
        {"loop": 250.0},
        {"inference": (40.0, 80.0)},
        {"refused.stale_chunk": 3, "skipped.older": 1, "command.missed_ticks": 2},
        {"at_rest": True, "tracking_mm": 1.5, "late_us": {"p50": 10.0, "max": 200.0}},
    )
    found = parsed(exposition([row(status)], {}, 0))
    (refused,) = found["vla_zenoh_refused"]
    assert refused.name == "vla_zenoh_refused_total"
    assert (refused.labels["reason"], refused.value) == ("stale_chunk", 3)
    latency = {s.labels["percentile"]: s.value for s in found["vla_zenoh_latency_seconds"]}
    assert latency == {"p50": 0.04, "p95": 0.08}
    assert found["vla_zenoh_arm_tracking_error_meters"][0].value == pytest.approx(0.0015)
    late = {s.labels["percentile"]: s.value for s in found["vla_zenoh_command_late_seconds"]}
    assert late == pytest.approx({"p50": 1e-5, "max": 2e-4})
    active = [
        s.labels["vla_zenoh_node_state"] for s in found["vla_zenoh_node_state"] if s.value == 1
    ]
    assert active == ["active"]


def test_a_node_that_is_gone_says_no_more_than_that() -> None:
    status = NodeStatus("sim", "running", "h", 1, 2, {}, {"loop": 1.0})
    found = parsed(exposition([NodeRow("sim", "h", "dead", "", status, 9.0, False)], {}, 0))
    assert found["vla_zenoh_node_alive"][0].value == 0
    assert "vla_zenoh_rate_hertz" not in found


def test_a_node_that_ended_well_is_not_missed() -> None:
    """The shipped alert NodeGone fires where node_alive is 0."""
    status = NodeStatus("recorder", "ended", "h", 1, 1)
    gone = NodeRow("recorder", "h", "ended", "", status, 5.0, False)
    found = parsed(exposition([gone], {}, 0))
    assert "vla_zenoh_node_alive" not in found
    states = {
        one.labels["vla_zenoh_node_state"]: one.value for one in found["vla_zenoh_node_state"]
    }
    assert [name for name, value in states.items() if value] == ["ended"]


def test_the_shared_memory_of_a_process_is_told() -> None:
    memory = {"off": "", "locked_bytes": 9_000_000}
    status = NodeStatus("router", "routing", "h", 1, 1, detail={"net": {"shared_memory": memory}})
    found = parsed(exposition([row(status, "router")], {}, 0))
    assert found["vla_zenoh_shared_memory_locked_bytes"][0].value == 9e6


def test_names_of_strangers_do_not_grow_the_metrics_without_bound() -> None:
    statuses = [
        NodeStatus(f"n{number}", f"state{number}", "h", 1, 2, {}, {}, {}, {f"refused.{number}": 1})
        for number in range(2 * MAX_SERIES)
    ]
    rows = [row(status, status.node) for status in statuses]
    found = parsed(exposition(rows, {}, 0))
    assert len(found["vla_zenoh_refused"]) == MAX_SERIES
    assert found["vla_zenoh_series_left_out"][0].value >= MAX_SERIES
    assert all(len(label) < 100 for s in found["vla_zenoh_node_state"] for label in s.labels)


# -- the arm ----------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def lines() -> ArmLines:
    return ArmLines(make_kinematics(load_profile("panda_sim")))


def home(lines: ArmLines) -> tuple[JointState, Pose]:
    kinematics = make_kinematics(load_profile("panda_sim"))
    joints = np.array(HOME)
    state = JointState(kinematics.arm_joints, joints, 0 * joints, None)
    return state, kinematics.forward(joints)


def test_the_links_go_from_the_base_to_the_tcp(lines: ArmLines) -> None:
    state, tcp = home(lines)
    points = np.array(lines.links_of(state))
    assert points.shape == (len(HOME) + 2, 3)
    np.testing.assert_allclose(points[0], 0)
    np.testing.assert_allclose(points[-1], tcp.position_m, atol=ATOL_M)


def spec(**changes: object) -> ModelSpec:
    action = ActionSpec(**{"horizon": 10, "dt_s": 0.1, "gripper": "none", **changes})  # pyright: ignore
    return ModelSpec(name="m", observation=ObservationSpec(), action=action)


def test_a_chunk_of_poses_is_a_line_from_where_it_begins(lines: ArmLines) -> None:
    state, start = home(lines)
    steps = np.tile([0.01, 0, 0, 0, 0, 0], (5, 1)).astype(np.float32)
    line = np.array(lines.chunk(steps, spec().action, start, state))
    assert len(line) == 6
    np.testing.assert_allclose(line[-1] - line[0], [0.05, 0, 0], atol=ATOL_M)


def test_a_chunk_of_joints_is_the_path_of_the_tcp_in_any_order_of_joints(lines: ArmLines) -> None:
    state, start = home(lines)
    backwards = tuple(reversed(state.names))
    joints = np.array(HOME)[::-1].copy()
    joints[-1] += 0.1  # the first joint turns the arm about z
    whole = spec(space="joint", kind="absolute", joints=backwards)
    line = np.array(lines.chunk(joints[None].astype(np.float32), whole.action, start, state))
    turned = np.hypot(*line[1, :2]), np.arctan2(line[1, 1], line[1, 0])
    assert turned[0] == pytest.approx(np.hypot(*line[0, :2]), abs=ATOL_M)
    assert turned[1] - np.arctan2(line[0, 1], line[0, 0]) == pytest.approx(0.1, abs=1e-3)


def test_a_chunk_that_does_not_fit_is_named(lines: ArmLines) -> None:
    state, start = home(lines)
    with pytest.raises(RecordError, match="numbers"):
        lines.chunk(np.zeros((1, 9), np.float32), spec().action, start, state)
    foreign = spec(space="joint", kind="absolute", joints=("a", "b"))
    with pytest.raises(RecordError, match="not those of the arm"):
        lines.chunk(np.zeros((1, 2), np.float32), foreign.action, start, state)
