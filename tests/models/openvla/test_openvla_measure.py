"""What ``vla-zenoh bench openvla`` reports."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("timm", reason="needs OpenVLA's environment: make test-models")
import tiny_openvla
import torch
from vla_zenoh_model_openvla import measure
from vla_zenoh_model_openvla.checkpoint import read_checkpoint
from vla_zenoh_model_openvla.load import empty_network

from vla_zenoh.errors import WorkerError

pytestmark = pytest.mark.models

PUBLISHED_BYTES = 15_082_474_368
"""``total_size`` in the index of openvla/openvla-7b, in bfloat16."""


def test_the_full_size_network_is_as_large_as_the_published_weights() -> None:
    weights = empty_network(measure.full_size()).state_dict().values()
    assert sum(weight.numel() for weight in weights) * 2 == PUBLISHED_BYTES


def test_every_stage_is_reported_and_both_ways_agree(tmp_path: Path) -> None:
    tiny_openvla.write(tmp_path / "tiny")
    network = measure.random_network(
        read_checkpoint(tmp_path / "tiny"), device="cpu", dtype=torch.float32
    )
    report = measure.measure(network, "tiny", rounds=3)
    names = [stage.name for stage in report.stages]
    assert names[2:] == [
        "vision",
        "projector",
        "prefill and first token",
        "decode",
        "action",
        "generate",
    ]
    assert all(0 < stage.p50_ms <= stage.p95_ms for stage in report.stages)
    assert report.same_tokens
    assert report.parameters * 4 == pytest.approx(
        1e6 * sum(report.memory_mb[part] for part in ("vision", "projector", "llama"))
    )
    assert report.to_dict()["stages"][3]["times"] == 1


def test_what_does_not_fit_is_refused_before_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "_free_bytes", lambda _device: int(10e9))
    with pytest.raises(WorkerError, match=r"need 17.3 GB on cpu, 10.0 GB are free"):
        measure.random_network(measure.full_size(), device="cpu", dtype=torch.bfloat16)
