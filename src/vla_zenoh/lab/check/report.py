"""Report of a model check."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from vla_zenoh.control.policy_check import Finding
from vla_zenoh.policy import ModelSpec

MEANINGS: Mapping[str, str] = {
    "cannot_be_made": "the file does not import, or its class refuses its options",
    "load_failed": "load() raised",
    "hangs": "a call of the model did not come back in time",
    "spec_changed": "the spec is another one after load() than before",
    "normalisation": "the spec's normalisation is not among the keys the weights came with",
    "reset_failed": "reset() raised",
    "inference_failed": "infer() raised",
    "batch": "infer_batch() answers otherwise than infer() does for each alone",
    "close_failed": "close() raised",
    "horizon": "more steps than the spec declares, or none",
    "shape": "steps of another width than the spec declares",
    "dtype": "steps that are not numbers",
    "not_finite": "NaN or infinity among the steps",
    "position_units": "steps too long to be metres",
    "joint_units": "joints too far to be radians",
    "rotation_units": "rotations too large to be radians",
    "joints_as_pose": "joint positions that the spec declares as poses",
    "too_few_joints": "the arm has fewer joints than a pose of the TCP needs",
    "quaternion": "a quaternion that is not unit, or not in the order x, y, z, w",
    "gripper_range": "a number that the declared meaning of the gripper cannot have",
    "gripper_polarity": "it shuts an open, empty gripper whatever it sees",
    "step_limit": "steps longer than the limits: the command node shortens them",
    "speed_limit": "steps that ask for more speed than the limits allow",
    "workspace": "absolute poses outside the workspace",
    "too_slow": "inference takes longer than an observation may be old",
    "slower_than_chunk": "a chunk is over before it is there",
    "slower_than_rate": "inference takes longer than a period of the asked rate",
    "gaps": "a chunk is over before the next one is asked for",
    "memory_growth": "every inference keeps memory",
    "random": "another answer to the same observation after reset()",
    "ignores_pictures": "the same answer whatever the pictures show",
    "ignores_colour_order": "the same answer with red and blue exchanged",
    "ignores_prompt": "the same answer whatever the prompt says",
    "stands_still": "no example made it move",
    "cut_short": "it is so slow that not everything was tried",
    "camera": "a camera that the profile does not have",
    "picture_size": "pictures of another size, and no rule to resize them",
    "picture_shape": "pictures are stretched out of shape",
    "camera_rate": "cameras are too slow for the age or skew the spec allows",
    "no_gripper": "the robot has a gripper and the model does not use it",
    "no_prompt": "the model needs a prompt and the profile has none",
    "not_listed": "the profile does not run this worker",
}
"""Every name a finding may have, and what it stands for."""


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
