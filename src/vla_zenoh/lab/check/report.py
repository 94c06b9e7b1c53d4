"""What was found out about a model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from vla_zenoh.control.finding import Finding
from vla_zenoh.policy import ModelSpec


@dataclass(slots=True)
class CheckReport:
    """See the module.

    Args:
        worker: its name.
        spec: what it declares; None where it could not be made.
        findings: all that is wrong or worth knowing.
        shape: (H, D) of the first answer.
        load_s: time of ``load()``.
        first_ms: time of the first inference.
        latency_ms: ``[p50, p95, max]`` of the later ones.
        runs: how many those were.
        memory_mib: resident: before load, after it, after all runs.
        growth_kib_per_run: resident memory that every inference adds, None: too few runs.
        deterministic: the same answer to the same observation after ``reset()``.
        depends_on: pictures, colour order, prompt: whether the answer does; None: cannot be told.
        step_range: per number of a step ``[smallest, largest]`` over all answers.
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
        """Nothing found that forbids giving it the arm."""
        return not any(finding.level == "error" for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Plain types."""
        return {
            "worker": self.worker,
            "ok": self.ok,
            "findings": [finding._asdict() for finding in self.findings],
            "spec": self.spec.to_dict() if self.spec else None,
            "spec_hash": self.spec.hash if self.spec else None,
            **{
                name: getattr(self, name)
                for name in self.__dataclass_fields__
                if name not in ("worker", "spec", "findings")
            },
        }
