"""OpenMetrics of every node, and of the page itself.

Names and units follow the convention of OpenMetrics: base units, ``_total`` for counters. Labels
are names of nodes, stages, reasons and keys; of each family at most `MAX_SERIES` are given.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, StateSetMetricFamily
from prometheus_client.openmetrics.exposition import CONTENT_TYPE_LATEST, generate_latest

from vla_zenoh.cli.node_rows import NodeRow
from vla_zenoh.keys import ENDED
from vla_zenoh.sanitize import one_line

__all__ = ["CONTENT_TYPE_LATEST", "exposition"]

MAX_SERIES = 256
MAX_LABEL = 64
PREFIX = "vla_zenoh"
STATES = (
    "active", "braking", "crashed", "dead", "degraded", "ended", "fault", "holding", "inactive",
    "inferring", "latched", "missing", "ok", "recording", "routing", "running", "silent",
    "stalled",
    "starting", "stopped", "unheeded", "unreadable", "waiting",
)  # fmt: skip
OTHER = "other"
ARM = {
    # detail of the command node -> name, unit, factor to that unit, help
    "at_rest": ("at_rest", "", 1.0, "1 while the commanded arm stands."),
    "streaming": ("streaming", "", 1.0, "1 while commands are published."),
    "speed_percent": ("speed_override_ratio", "ratio", 0.01, "Speed override."),
    "speed_share": ("speed_ratio", "ratio", 1.0, "Driven share of the planned speed."),
    "tracking_mm": ("tracking_error_meters", "meters", 1e-3, "Measured from commanded TCP."),
    "external_force_n": ("external_force_newtons", "newtons", 1.0, "External force at the TCP."),
    "singular_value": ("singular_value", "", 1.0, "Smallest singular value of the Jacobian."),
    "self_distance_m": ("self_distance_meters", "meters", 1.0, "Distance of the arm to itself."),
    "table_distance_m": ("table_distance_meters", "meters", 1.0, "Distance to the table."),
    "keep_out_distance_m": ("keep_out_distance_meters", "meters", 1.0, "To the next keep-out."),
}
PERCENTILES = ("p50", "p95", "p99", "max")
LOOP = {
    "tick_us": "command_tick",
    "chunk_us": "command_chunk",
    "late_us": "command_late",
    "pose_age_ms": "command_pose_age",
}
"""Distributions in the detail of the command node -> name."""


class _Families:
    """Families by name; their series are bounded in number."""

    def __init__(self) -> None:
        self.found: dict[str, Any] = {}
        self._series: Counter[str] = Counter()
        self._labels: set[tuple[str, tuple[str, ...]]] = set()
        self.left_out = 0

    def add(
        self,
        kind: type,
        name: str,
        text: str,
        labels: Mapping[str, str],
        value: Any,
        unit: str = "",
    ) -> None:
        """Add one series of a family of this kind."""
        values = tuple(one_line(value, MAX_LABEL) for value in labels.values())
        number = isinstance(value, (int, float))
        if not (number or kind is StateSetMetricFamily):
            return
        if self._series[name] >= MAX_SERIES or (name, values) in self._labels:  # cut to the same
            self.left_out += 1
            return
        self._series[name] += 1
        self._labels.add((name, values))
        if name not in self.found:
            more: dict[str, Any] = {} if kind is StateSetMetricFamily else {"unit": unit}
            self.found[name] = kind(f"{PREFIX}_{name}", text, labels=list(labels), **more)
        self.found[name].add_metric(values, value)


def _numbers(value: Any) -> Iterator[tuple[str, float]]:
    for name, one in value.items() if isinstance(value, Mapping) else ():
        if isinstance(one, (int, float)):
            yield str(name), float(one)


def families(rows: Iterable[NodeRow], web: Mapping[str, int], pages: int) -> list[Any]:
    out = _Families()
    for row in rows:
        _of_node(out, row)
    for name, count in sorted(web.items()):
        labels, counter = {"what": name.removesuffix("_bytes")}, CounterMetricFamily
        if name.endswith("_bytes"):
            out.add(counter, "web_sent_bytes", "To pages.", labels, count, "bytes")
        else:
            out.add(counter, "web_events", "Messages and pictures.", labels, count)
    out.add(GaugeMetricFamily, "web_pages", "Open pages.", {}, pages)
    out.add(GaugeMetricFamily, "series_left_out", "Beyond the bound.", {}, out.left_out)
    return list(out.found.values())


def _of_node(out: _Families, row: NodeRow) -> None:
    node = {"node": row.name}
    gauge, counter = GaugeMetricFamily, CounterMetricFamily
    known = row.state if row.state in STATES else OTHER
    states = {state: state == known for state in (*STATES, OTHER)}
    if row.state != ENDED:  # a recorder that has done its work is not missed
        out.add(gauge, "node_alive", "1 while it has a liveliness token.", node, int(row.alive))
    out.add(StateSetMetricFamily, "node_state", "State of a node.", node, states)
    status = row.status
    if status is None:
        return
    age_s = row.age_s
    out.add(gauge, "node_status_age_seconds", "Since its status came.", node, age_s, "seconds")
    if not row.alive:  # what it said last is over
        return
    started_s = status.started_wall_ns / 1e9
    out.add(gauge, "node_start_time_seconds", "Unix time.", node, started_s, "seconds")
    for name, count in status.counters.items():
        kind, _, reason = name.partition(".")
        if kind in ("refused", "skipped") and reason:
            text = {"refused": "Rejected messages.", "skipped": "Skipped in normal operation."}
            out.add(counter, kind, text[kind], {**node, "reason": reason}, count)
        else:
            out.add(counter, "node_events", "Other counters.", {**node, "what": name}, count)
    for name, rate_hz in status.rates_hz.items():
        labels = {**node, "of": name}
        out.add(gauge, "rate_hertz", "Loops and streams.", labels, rate_hz, "hertz")
    for name, age in status.ages_s.items():
        labels = {**node, "input": name}
        out.add(gauge, "input_age_seconds", "Of the newest input.", labels, age, "seconds")
    for stage, pair in status.latency_ms.items():
        for percentile, value_ms in zip(PERCENTILES, pair, strict=False):
            labels = {**node, "stage": stage, "percentile": percentile}
            text = "Duration of a stage."
            out.add(gauge, "latency_seconds", text, labels, value_ms / 1e3, "seconds")
    _of_links(out, node, status.detail)
    _of_gpus(out, node, status.detail)
    if row.name == "command":
        _of_arm(out, status.detail)


def _of_links(out: _Families, node: dict[str, str], detail: Mapping[str, Any]) -> None:
    gauge = GaugeMetricFamily
    clocks = detail.get("clocks")
    for other, found in clocks.items() if isinstance(clocks, Mapping) else ():
        labels = {**node, "of": str(other)}
        for name, value_ms in _numbers(found):
            if name in ("offset_ms", "uncertainty_ms", "round_trip_ms"):
                what = f"clock_{name.removesuffix('_ms')}_seconds"
                out.add(gauge, what, "Of another node.", labels, value_ms / 1e3, "seconds")
    net = detail.get("net")
    net = net if isinstance(net, Mapping) else {}
    sent = net.get("sent")
    for key, pair in sent.items() if isinstance(sent, Mapping) else ():
        if isinstance(pair, (list, tuple)) and len(pair) == 3:
            labels = {**node, "key": str(key)}
            out.add(gauge, "sent_hertz", "Records published.", labels, pair[0], "hertz")
            out.add(gauge, "sent_bytes", "Published per second.", labels, pair[1], "bytes")
    for name, value in _numbers(net.get("shared_memory")):  # locked_bytes
        out.add(gauge, f"shared_memory_{name}", "Of the process.", node, value, "bytes")
    for key, count in _numbers(net.get("lost")):
        labels = {**node, "key": key}
        out.add(CounterMetricFamily, "lost_records", "Never arrived here.", labels, count)


def _of_gpus(out: _Families, node: dict[str, str], detail: Mapping[str, Any]) -> None:
    gauge, gpus = GaugeMetricFamily, detail.get("gpus")
    if not isinstance(gpus, list):  # no worker
        return
    out.add(gauge, "gpus", "Of the worker's host.", node, len(gpus))
    for index, gpu in enumerate(gpus):
        if not isinstance(gpu, Mapping):
            continue
        labels = {**node, "gpu": str(index)}
        load_percent = gpu.get("load_percent")
        if isinstance(load_percent, (int, float)):
            text = "Share of time in which a program ran on it."
            out.add(gauge, "gpu_load_ratio", text, labels, load_percent / 100, "ratio")
        for name in ("used_bytes", "total_bytes"):
            text = "Memory of the GPU, of all programs."
            what = f"gpu_memory_{name}"
            out.add(gauge, what, text, labels, gpu.get(name), "bytes")
    text = "Held by PyTorch in the worker."
    out.add(gauge, "gpu_own_bytes", text, node, detail.get("gpu_own_bytes"), "bytes")


def _of_arm(out: _Families, detail: Mapping[str, Any]) -> None:
    for field, (name, unit, factor, text) in ARM.items():
        value = detail.get(field)
        if isinstance(value, (int, float)):
            out.add(GaugeMetricFamily, f"arm_{name}", text, {}, float(value) * factor, unit)
    for field, name in LOOP.items():
        scale = 1e-6 if field.endswith("_us") else 1e-3
        for percentile, value in _numbers(detail.get(field)):
            labels = {"percentile": percentile}
            text = "Of the command loop."
            out.add(GaugeMetricFamily, f"{name}_seconds", text, labels, value * scale, "seconds")
    chunks = detail.get("accepted_chunks")
    if isinstance(chunks, int):
        text = "Of this episode."
        out.add(GaugeMetricFamily, "arm_accepted_chunks", text, {}, chunks)


def exposition(rows: Iterable[NodeRow], web: Mapping[str, int], pages: int) -> bytes:
    """The text of ``/metrics``; see `families`."""

    class Collector:
        def collect(self) -> list[Any]:
            return families(rows, web, pages)

    registry = CollectorRegistry(auto_describe=False)
    registry.register(Collector())
    return generate_latest(registry)
