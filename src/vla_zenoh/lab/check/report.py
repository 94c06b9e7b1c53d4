"""Report of a model check."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from vla_zenoh.control.policy_check import Finding
from vla_zenoh.policy import ModelSpec


@dataclass(slots=True)
class CheckReport:
    """Report of a model check.

    Args:
        spec: of the model; None: the model could not be made.
        shape: (H, D) of the first answer.
        load_s: duration of ``load()``.
        latency_ms: ``[p50, p95, max]`` of the later ones.
        memory_mib: resident: before load, after it, after all runs.
        growth_kib_per_run: growth of resident memory per inference, None: too few runs.
        deterministic: the same answer to the same observation after ``reset()``.
        depends_on: pictures, colour order, prompt -> the answer depends on it; None: unknown.
        step_range: per component of a step ``[smallest, largest]`` over all answers.
    """

    worker: str
    spec: ModelSpec | None = None
    findings: list[Finding] = field(default_factory=list)
    shape: tuple[int, int] | None = None
    load_s: float = 0.0
    first_ms: float | None = None
    latency_ms: tuple[float, float, float] | None = None
    runs: int = 0
    memory_mib: tuple[float, float, float] | None = None
    growth_kib_per_run: float | None = None
    deterministic: bool | None = None
    depends_on: dict[str, bool | None] = field(default_factory=dict)
    step_range: list[tuple[float, float]] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        return not any(finding.level == "error" for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        return {
            "worker": self.worker,
            "ok": self.ok,
            "findings": [finding._asdict() for finding in self.findings],
            "spec": self.spec.to_dict() if self.spec else None,
            "spec_hash": self.spec.hash if self.spec else None,
            **{name: getattr(self, name) for name in list(self.__dataclass_fields__)[3:]},
        }


def distinct(findings: Iterable[Finding]) -> list[Finding]:
    """The first of every level and name, the worst first."""
    order = {"error": 0, "warning": 1, "note": 2}
    first: dict[tuple[str, str], Finding] = {}
    for finding in findings:
        first.setdefault(finding[:2], finding)
    return sorted(first.values(), key=lambda finding: order[finding.level])
