"""Examination of a model: runs it on example observations and collects findings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vla_zenoh.control.policy_check import Finding, error, joints_as_pose
from vla_zenoh.errors import SpecError
from vla_zenoh.kinematics.description import sliding_joints
from vla_zenoh.lab.check import judge
from vla_zenoh.lab.check.examples import (
    MAX_WIDTH_M,
    PROMPTS,
    ExampleMaker,
    ExampleStyle,
    example_styles,
    noise,
)
from vla_zenoh.lab.check.fit import check_chunk, check_spec, note
from vla_zenoh.lab.check.judge import Steps
from vla_zenoh.lab.check.model_runner import ModelFailed, ModelHung, ModelRunner
from vla_zenoh.policy import ModelSpec, Policy, check_steps, reset_of
from vla_zenoh.policy.inference import ChunkPrefix
from vla_zenoh.profile import Limits, Profile, Timing

DEFAULT_RUNS = 100
ENOUGH_RUNS = 12
"""Timed runs needed for a finding on memory."""


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


class Examination:
    """Examination of one model.

    Args:
        profile: to check it against; None: its own spec and default limits.
        rate_hz: requested chunks per second; None: of the profile.
        prompts: the first one most often; None: the model's `example_prompts`, or `PROMPTS`.
        budget_s: time limit for new examples; loading does not count.
    """

    def __init__(
        self,
        policy: Policy,
        worker: str,
        runner: ModelRunner,
        *,
        profile: Profile | None = None,
        rate_hz: float | None = None,
        prompts: Sequence[str] | None = None,
        runs: int = DEFAULT_RUNS,
        budget_s: float = 30.0,
    ) -> None:
        self._policy, self._runner, self._profile = policy, runner, profile
        self._rate_hz = rate_hz or (profile.task.rate_hz if profile else None)
        self._limits = profile.limits if profile else Limits()
        self._timing = profile.timing if profile else Timing()
        self._width_m = profile.robot.max_width_m if profile else MAX_WIDTH_M
        named = prompts or getattr(policy, "example_prompts", None)
        self._styles = example_styles(tuple(named) if named else PROMPTS)
        self._runs, self._budget_s = runs, budget_s
        self._loaded_s = 0.0
        self._maker, self._continuation = ExampleMaker(policy.spec, profile), ChunkPrefix(policy)
        self._answers: list[tuple[ExampleStyle, Steps]] = []
        self._took_ms: list[float] = []
        self.report = CheckReport(worker, policy.spec)

    def run(self) -> CheckReport:
        """Examine; errors of the model become findings."""
        report = self.report
        try:
            self._run()
            close = getattr(self._policy, "close", None)
            if callable(close):
                self._runner.call(close)
        except ModelFailed as failed:
            report.findings.append(error("close_failed", str(failed)))
        except ModelHung as hung:
            report.findings.append(error("hangs", str(hung)))
        report.findings = distinct(report.findings)
        return report

    def _run(self) -> None:
        report = self.report
        if self._profile is not None:
            report.findings += check_spec(
                self._profile, self._policy.spec, worker=report.worker, rate_hz=self._rate_hz
            )
        before_kib = self._runner.memory_kib()
        if not (self._load() and self._infer_first()):
            return
        loaded_kib = self._runner.memory_kib()
        self._compare()
        self._compare_batch()
        for style in self._styles[1:]:
            if not self._in_budget():
                break
            self._reset()
            self._infer(style)
        self._measure()
        report.memory_mib = (before_kib / 1024, loaded_kib / 1024, self._runner.memory_kib() / 1024)
        self._judge()

    # -- stages -------------------------------------------------------------------------------
    def _load(self) -> bool:
        report, policy = self.report, self._policy
        declared = policy.spec.hash
        load = getattr(policy, "load", None)
        if callable(load):
            try:
                _, report.load_s = self._runner.call(load)
            except ModelFailed as failed:
                report.findings.append(error("load_failed", str(failed)))
                return False
        self._loaded_s = self._runner.spent_s()
        if policy.spec.hash != declared:
            why = "load() changed the spec, which was published before; declare it in __init__"
            report.findings.append(error("spec_changed", why))
        known = getattr(policy, "normalisation_keys", None)
        key = policy.spec.action.normalisation
        if known is not None and key not in known:
            there = ", ".join(sorted(map(str, known))) or "none"
            why = f"the spec says normalisation {key!r}, the weights came with: {there}"
            report.findings.append(error("normalisation", why))
        return True

    def _infer_first(self) -> bool:
        """First inference; without an answer there is no point in others."""
        self._reset()
        steps = self._infer(self._styles[0], again=True)
        if steps is None:
            return False
        self.report.first_ms = self._took_ms.pop()
        self.report.shape = (steps.shape[0], steps.shape[1])
        return True

    def _compare(self) -> None:
        """Repeat an observation, and change one thing at a time."""
        report, chart = self.report, self._styles[0]
        seen = self._policy.spec.observation
        first, again = self._infer_again(chart), self._infer_again(chart)
        if first is None or again is None:
            return
        report.deterministic = judge.alike(first, again)
        if not report.deterministic:
            why = "answers to one observation differ after reset(); usual where noise is drawn, "
            why += "and then it is not known what the answer depends on"
            report.findings.append(note("random", why))
            return
        trials: dict[str, ExampleStyle] = {}
        if seen.camera_names:
            trials["pictures"] = replace(chart, picture=noise)
        if seen.cameras:
            trials["colour order"] = replace(chart, swapped=True)
        if seen.prompt:
            trials["prompt"] = replace(chart, prompt=self._another_prompt())
        for name, style in trials.items():
            if not self._in_budget():
                continue
            if name == "colour order" and report.depends_on.get("pictures") is False:
                continue
            other = self._infer_again(style)
            report.depends_on[name] = None if other is None else not judge.alike(first, other)

    def _compare_batch(self) -> None:
        """Compare ``infer_batch`` on two observations with ``infer`` on each."""
        takes_batches = callable(getattr(self._policy, "infer_batch", None))
        if not takes_batches or not self.report.deterministic:
            return
        chart = self._styles[0]
        pair = (chart, replace(chart, picture=noise, prompt=self._another_prompt()))
        alone = [self._infer_again(style) for style in pair]
        if any(steps is None for steps in alone):
            return
        self._reset()
        both = [self._maker.make(style, again=True) for style in pair]
        # Of two robots: the second must not find what the first one left.
        seen = [replace(each, robot=name) for each, name in zip(both, "ab", strict=True)]
        try:
            found, _ = self._runner.call(lambda: judge.ask_batch(self._policy, seen))
        except ModelFailed as failed:
            self.report.findings.append(error("batch", f"infer_batch: {failed}"))
            return
        self.report.findings += judge.batch_findings(self._policy.spec.action, found, alone)

    def _another_prompt(self) -> str:
        prompts = [style.prompt for style in self._styles if not style.strange]
        return next((text for text in prompts if text != prompts[0]), PROMPTS[1])

    def _measure(self) -> None:
        kib: list[float] = []
        self._reset()
        for index in range(self._runs):
            if not self._in_budget():
                break
            if self._infer(self._styles[index % 2]) is None:
                return
            kib.append(self._runner.memory_kib())
        if len(kib) >= ENOUGH_RUNS:
            self.report.growth_kib_per_run, leaks = judge.growth(kib)
            self.report.findings += leaks

    # -- one inference ------------------------------------------------------------------------
    def _infer_again(self, style: ExampleStyle) -> Steps | None:
        self._reset()
        return self._infer(style, again=True)

    def _reset(self) -> None:
        self._continuation = ChunkPrefix(self._policy)
        reset = reset_of(self._policy)
        if reset is None:
            return
        try:
            self._runner.call(reset)
        except ModelFailed as failed:
            self.report.findings.append(error("reset_failed", str(failed)))

    def _infer(self, style: ExampleStyle, *, again: bool = False) -> Steps | None:
        """A checked answer, None: there is none, and the report has the finding."""
        findings, action = self.report.findings, self._policy.spec.action
        try:
            observation = self._maker.make(style, again=again)
        except SpecError as fault:
            findings.append(error("picture_size", str(fault)))
            return None
        try:
            answer, took_s = self._runner.call(lambda: self._continuation.infer(observation))
        except ModelFailed as failed:
            refused = style.strange and isinstance(failed.error, SpecError)
            if not refused:
                findings.append(error("inference_failed", f"{style.name}: {failed}"))
            return None
        self._took_ms.append(took_s * 1e3)
        try:
            steps = check_steps(action, answer.steps)
        except SpecError as fault:
            findings.append(error(fault.reason, f"{style.name}: {fault}"))
            return None
        robot = None if self._profile is None else self._profile.robot
        findings += check_chunk(action, steps, self._limits, self._width_m, robot)
        if robot is not None:
            slides = np.isin(robot.arm_joints, [*sliding_joints(robot)])
            home_rad = np.array(robot.home_rad)
            findings += joints_as_pose(action, steps, home_rad, slides, self._limits)
        self._answers.append((style, steps))
        # A model with real-time chunking gets committed steps at the next inference.
        arrival_ns = observation.stamp_wall_ns + round(took_s * 1e9)
        self._continuation.published(observation, steps, arrival_ns, obeyed=style.active)
        return steps

    def _in_budget(self) -> bool:
        if self._runner.spent_s() - self._loaded_s < self._budget_s:
            return True
        if not any(finding.name == "cut_short" for finding in self.report.findings):
            why = f"not everything was tried in {self._budget_s:g} s; --budget gives more"
            self.report.findings.append(note("cut_short", why))
        return False

    # -- findings ------------------------------------------------------------------------------
    def _judge(self) -> None:
        report, action = self.report, self._policy.spec.action
        report.runs = len(self._took_ms)
        if self._took_ms:
            p50, p95 = np.percentile(self._took_ms, (50, 95))
            report.latency_ms = (float(p50), float(p95), max(self._took_ms))
            report.findings += judge.slowness(
                action,
                float(p50) / 1e3,
                float(p95) / 1e3,
                oldest_s=self._timing.max_observation_age_s,
                rate_hz=self._rate_hz,
            )
        numbers = np.concatenate([steps for _, steps in self._answers])
        low, high = numbers.min(axis=0).tolist(), numbers.max(axis=0).tolist()
        report.step_range = list(zip(low, high, strict=True))
        report.findings += judge.behaviour(action, self._answers, report.depends_on)


def distinct(findings: Iterable[Finding]) -> list[Finding]:
    """The first of every level and name, the worst first."""
    order = {"error": 0, "warning": 1, "note": 2}
    first: dict[tuple[str, str], Finding] = {}
    for finding in findings:
        first.setdefault(finding[:2], finding)
    return sorted(first.values(), key=lambda finding: order[finding.level])
