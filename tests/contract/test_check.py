"""`vla-zenoh check` passes what keeps its contract, and names what does not."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chain import command_line
from peer_rig import ADAPTERS, KINDS, free_port, of, reachable

from vla_zenoh import resources
from vla_zenoh.lab.check import fit
from vla_zenoh.lab.check.examination import CheckReport, Examination
from vla_zenoh.lab.check.examples import chart, example_styles
from vla_zenoh.lab.check.model_runner import ModelRunner
from vla_zenoh.policy import (
    ActionSpec,
    CameraSpec,
    GripperSemantics,
    ModelSpec,
    ObservationSpec,
    check_steps,
)
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import JointLimits, Limits, load_profile, override

ROOT = Path(__file__).parents[2]
BROKEN = Path(__file__).with_name("broken_worker.py")
RUNS, PASSING_RUNS, FEW_RUNS = 40, 20, 3
"""Enough to see what memory does, and where that does not matter."""
PATIENCE_S = 5.0

ERRORS = {
    # fault: (name of the finding, what is said of it)
    "mixed": ("batch", "is not that of infer"),
    "lost": ("batch", "gave 1 answers to 2 observations"),
    "load": ("load_failed", "weights.safetensors"),
    "spec": ("spec_changed", "declare it in __init__"),
    "key": ("normalisation", "'bridge', the weights came with: libero_goal, libero_spatial"),
    "reset": ("reset_failed", "KeyError: there is no 'episode'"),
    "raises": ("inference_failed", "colour chart: RuntimeError: device-side assert"),
    "writes": ("inference_failed", "read-only"),
    "prompt": ("inference_failed", "a strange prompt: UnicodeEncodeError"),
    "horizon": ("horizon", "a chunk of 8 steps, the spec says 1 to 4"),
    "shape": ("shape", r"steps have shape \(4, 6\), the spec says \(H, 7\)"),
    "coroutine": ("dtype", "declare it with def, not async def"),
    "objects": ("dtype", "steps are not numbers but object"),
    "tensor": ("dtype", r"requires grad. Use tensor.detach\(\)"),
    "nan": ("not_finite", "NaN"),
    "millimetres": ("position_units", "are these metres"),
    "degrees": ("rotation_units", r"a step of 4\.96\d* rad, over 4 times the limit of 0\.2 rad"),
    "norm": ("quaternion", r"norm 0\.5099, wanted 1"),
    "order": ("quaternion", "the order is x, y, z, w"),
    "gripper": ("gripper_range", "gripper 255, declared as open_fraction"),
    "grows": ("memory_growth", r"every inference keeps \d+ KiB"),
    "late": ("slower_than_chunk", r"its 4 steps of 0\.001 s are over by then"),
    "camera": (
        "camera",
        "needs camera 'ceiling', the profile has: front, wrist; add it to",
    ),
    "size": ("picture_size", "sends 640x480, the spec asks for 32x24"),
}
WARNINGS = {
    "polarity": "gripper_polarity",
    "blind": "ignores_pictures",
    "gray": "ignores_colour_order",
    "deaf": "ignores_prompt",
}
NEEDS_A_PROFILE = ("camera", "size")


def examined(fault: str, *, against: str | None = None, **more: Any) -> CheckReport:
    return Examination(
        make_policy(find_model(str(BROKEN)), {"fault": fault}),
        "broken",
        ModelRunner(more.pop("patience_s", PATIENCE_S)),
        profile=load_profile(against) if against else None,
        runs=RUNS if fault in ("", "grows") else FEW_RUNS,
        **more,
    ).run()


def names(report: CheckReport, *levels: str) -> set[str]:
    return {finding.name for finding in report.findings if finding.level in levels}


def test_a_worker_that_keeps_its_contract_passes_without_a_word() -> None:
    report = examined("", against="panda_sim")
    assert report.ok
    assert names(report, "error", "warning") == set()
    assert report.shape == (4, 7)
    assert report.deterministic is True
    assert report.depends_on == {"pictures": True, "colour order": True, "prompt": True}
    assert report.latency_ms is not None
    assert report.memory_mib is not None


@pytest.mark.parametrize("fault", ERRORS)
def test_a_broken_worker_fails_with_the_name_of_its_fault(fault: str) -> None:
    name, why = ERRORS[fault]
    report = examined(fault, against="panda_sim" if fault in NEEDS_A_PROFILE else None)
    assert not report.ok
    assert names(report, "error") == {name}
    (finding,) = [finding for finding in report.findings if finding.level == "error"]
    assert re.search(why, finding.why), finding.why


def test_a_worker_too_slow_for_the_command_node_is_told_so_before_its_patience_ends() -> None:
    report = examined("slow", budget_s=3.0)
    assert names(report, "error") == {"slower_than_chunk", "too_slow"}
    assert names(report, "note") == {"cut_short"}


class SlowToLoad(ModelRunner):
    """As if the first thing that is asked of a model, to load, had taken a minute."""

    asked = 0

    def call(self, what: Callable[[], Any]) -> tuple[Any, float]:
        self.asked += 1
        return super().call(what)

    def spent_s(self) -> float:
        return 60.0 if self.asked else 0.0


def test_the_time_to_load_is_not_taken_from_that_to_examine() -> None:
    policy = make_policy(find_model(str(BROKEN)), {"fault": ""})
    report = Examination(
        policy, "broken", SlowToLoad(PATIENCE_S), runs=FEW_RUNS, budget_s=30.0
    ).run()
    assert "cut_short" not in names(report, "note")
    assert report.depends_on["pictures"]


def test_a_worker_that_hangs_is_given_up() -> None:
    report = examined("hangs", patience_s=0.3)
    assert names(report, "error") == {"hangs"}
    assert "no answer within 0.3 s" in report.findings[0].why


@pytest.mark.parametrize("fault", WARNINGS)
def test_what_a_person_should_look_at_is_a_warning(fault: str) -> None:
    report = examined(fault)
    assert report.ok
    assert names(report, "warning") == {WARNINGS[fault]}


def test_of_a_random_worker_nothing_is_said_that_cannot_be_known() -> None:
    report = examined("random")
    assert report.ok
    assert report.deterministic is False
    assert report.depends_on == {}
    assert names(report, "note") == {"random"}


@pytest.mark.parametrize("asked_hz", [2.0, 50.0])
def test_inference_longer_than_a_period_is_named(asked_hz: float) -> None:
    report = Examination(
        make_policy(find_model("scripted"), {"delay_ms": "40", "dt_s": "1"}),
        "scripted",
        ModelRunner(PATIENCE_S),
        rate_hz=asked_hz,
        runs=3,
    ).run()
    assert ("slower_than_rate" in names(report, "warning")) == (asked_hz > 25)


def test_every_finding_is_in_the_documentation() -> None:
    told = {name for name, _ in ERRORS.values()} | set(WARNINGS.values())
    page = (ROOT / "docs" / "how-to" / "models.md").read_text("utf-8")
    assert told <= set(re.findall(r"`(\w+)`", page))


# -- what is shipped ------------------------------------------------------------------------------
IN_ENVIRONMENTS_OF_THEIR_OWN = {"lerobot", "openvla"}
"""Checked by tests/models/test_*_chain.py."""
OF_ONE_SCENE = {"scripted_pair", "scripted_pick"}
"""They fail with a brick out of reach, as on noise: tests/sim/test_so101.py, test_pair.py."""
OF_BENCHMARKS = {"libero_privileged", "metaworld_expert", "ogbench_expert", "so101_expert"}
"""They act on what a benchmark knows, which no observation of a check has."""

OF_A_CLIENT = {"physicalai_client", "r2c_policy", "ray_serve"}
"""They have no answer without a peer: tests/unit/policy/test_physicalai_client.py, test_r2c_bus.py,
test_ray_spread.py."""


def test_every_shipped_worker_is_checked() -> None:
    here = {"brick", "replay", "scripted", *ADAPTERS}
    elsewhere = IN_ENVIRONMENTS_OF_THEIR_OWN | OF_ONE_SCENE | OF_BENCHMARKS | OF_A_CLIENT
    assert here | elsewhere == set(resources.names("models"))


def passes(model: str, **options: str) -> CheckReport:
    report = Examination(
        make_policy(find_model(model), options),
        model,
        ModelRunner(PATIENCE_S),
        profile=load_profile("panda_sim"),
        runs=PASSING_RUNS,
    ).run()
    assert report.ok, report.findings
    assert report.growth_kib_per_run is not None
    return report


def test_scripted_keeps_its_contract_and_is_blind() -> None:
    report = passes("scripted")
    assert names(report, "warning") == {"ignores_pictures"}
    assert report.depends_on == {"pictures": False, "prompt": True}


def test_brick_keeps_its_contract_and_looks_and_listens() -> None:
    report = passes("brick")
    assert report.depends_on == {"pictures": True, "colour order": True, "prompt": True}
    assert report.deterministic is True


def test_replay_keeps_its_contract(tmp_path: Path) -> None:
    steps = np.full((3, 4, 7), 0.01, np.float32)
    recorded = json.dumps(spec(gripper="absolute_m").to_dict())
    np.savez(tmp_path / "chunks.npz", spec=recorded, steps=steps, length=np.array([4, 2, 3]))
    passes("replay", file=str(tmp_path / "chunks.npz"))


@pytest.mark.parametrize("name", of(*ADAPTERS, quick=["openpi"]))
def test_an_adapter_keeps_its_contract_with_its_server(name: str) -> None:
    with reachable(KINDS[name]) as server:
        passes(server.kind.model, **{**server.settings, "timeout_s": "5"})


def test_an_adapter_without_its_server_is_said_to_fail_at_loading_or_inference() -> None:
    settings = KINDS["openpi"].settings(free_port())
    report = Examination(
        make_policy(find_model("openpi"), settings), "openpi", ModelRunner(PATIENCE_S), runs=3
    ).run()
    assert names(report, "error") <= {"load_failed", "inference_failed"}
    assert not report.ok


# -- spec and profile -----------------------------------------------------------------------------


def spec(*cameras: CameraSpec, **action: Any) -> ModelSpec:
    fields = {"horizon": 4, "dt_s": 0.1, **action}
    return ModelSpec(
        name="m", observation=ObservationSpec(cameras=cameras), action=ActionSpec(**fields)
    )


FRONT, WRIST = CameraSpec(camera="front"), CameraSpec(camera="wrist")


FIVE_JOINTS = {
    "robot": {
        "arm_joints": [f"panda_joint{number}" for number in range(1, 6)],
        "home_rad": [0.0, 0.0, 0.0, -2.6, 0.0],
    },
    "limits": {"joint": dict.fromkeys(JointLimits.model_fields, 1.0)},
}


SEVEN_JOINTS: dict[str, Any] = {
    "space": "joint",
    "joints": load_profile("panda_sim").robot.arm_joints,
}


@pytest.mark.parametrize(
    ("declared", "changes", "wanted"),
    [
        (spec(FRONT), {}, set()),
        (spec(CameraSpec(camera="top")), {}, {("error", "camera")}),
        (
            spec(CameraSpec(camera="front", width=224, height=224, resize="stretch")),
            {},
            {("note", "picture_shape")},
        ),
        (spec(CameraSpec(camera="front", width=224, height=224, resize="pad")), {}, set()),
        (
            spec(FRONT),
            {"cameras": {"front": {"source": "sim:front", "rate_hz": 1}}},
            {("error", "camera_rate")},
        ),
        (
            spec(FRONT, WRIST),
            {"cameras": {"wrist": {"source": "sim:wrist", "rate_hz": 5}}},
            {("warning", "camera_rate")},
        ),
        (spec(FRONT, gripper="none"), {}, {("note", "no_gripper")}),
        (spec(FRONT), {"task": {"prompt": ""}}, {("warning", "no_prompt")}),
        (spec(FRONT, horizon=1), {}, {("note", "gaps")}),
        (spec(FRONT, horizon=1, dt_s=0.3), {}, {("warning", "rushes")}),
        (spec(FRONT), FIVE_JOINTS, {("warning", "too_few_joints")}),
        (spec(FRONT, **SEVEN_JOINTS), {}, {("warning", "joints_by_pose")}),
        (spec(FRONT, **SEVEN_JOINTS), {"robot": {"command": "joint"}}, set()),
        (
            spec(FRONT, kind="absolute", rotation="quaternion"),
            FIVE_JOINTS,
            {("error", "too_few_joints")},
        ),
    ],
)
def test_what_does_not_fit_a_profile_is_named(
    declared: ModelSpec, changes: dict[str, Any], wanted: set[tuple[str, str]]
) -> None:
    profile = override(load_profile("panda_sim"), {"workers": ["scripted", "m"], **changes})
    found = fit.check_spec(profile, declared, worker="m")
    assert {finding[:2] for finding in found} == wanted


def test_a_worker_that_the_profile_does_not_run_is_noted() -> None:
    found = fit.check_spec(load_profile("panda_sim"), spec(FRONT), worker="m")
    assert [finding[:2] for finding in found] == [("note", "not_listed")]


# -- numbers --------------------------------------------------------------------------------------

MAX_WIDTH_M = 0.08
DOWN_XYZW = [1.0, 0.0, 0.0, 0.0]


def found_in(
    action: ActionSpec, row: list[float], max_width_m: float = MAX_WIDTH_M
) -> set[tuple[str, str]]:
    steps = check_steps(action, [row])
    return {f[:2] for f in fit.check_chunk(action, steps, Limits(), max_width_m)}


@pytest.mark.parametrize(
    ("max_width_m", "width_m", "fits"),
    [(0.08, 0.1, True), (0.08, 0.14, False), (0.01, 0.015, True), (0.01, 0.045, False)],
)
def test_a_width_far_beyond_the_gripper_is_in_another_unit_however_small_that_is(
    max_width_m: float, width_m: float, fits: bool
) -> None:
    action = ActionSpec(horizon=1, dt_s=0.1, gripper="absolute_m")
    found = found_in(action, [0.0] * 6 + [width_m], max_width_m)
    assert found == (set() if fits else {("error", "gripper_range")})


@pytest.mark.parametrize(
    ("row", "wanted"),
    [
        ([0.43, 0.0, 0.2, *DOWN_XYZW, 0.04], set()),
        ([430.0, 0.0, 200.0, *DOWN_XYZW, 0.04], {("error", "position_units")}),
        ([-0.43, 0.0, 0.2, *DOWN_XYZW, 0.04], {("warning", "workspace")}),
        ([0.43, 0.0, 0.2, 2.0, 0.0, 0.0, 0.0, 0.04], {("error", "quaternion")}),
        ([0.43, 0.0, 0.2, *DOWN_XYZW, 40.0], {("error", "gripper_range")}),
    ],
)
def test_absolute_poses_are_held_against_the_workspace(
    row: list[float], wanted: set[tuple[str, str]]
) -> None:
    action = ActionSpec(horizon=1, dt_s=0.1, kind="absolute", rotation="quaternion")
    assert found_in(action, row) == wanted


@pytest.mark.parametrize("controller", [None, {"kp": 150.0, "damping_ratio": 1.0}])
@pytest.mark.parametrize("rotation", ["rpy", "rotvec", "quaternion", "rotation_6d"])
@pytest.mark.parametrize("kind", ["delta", "absolute"])
@pytest.mark.parametrize("number", [0.0, 2.0, -3e38])
def test_numbers_that_may_be_no_rotation_are_findings(
    kind: str, rotation: str, number: float, controller: dict[str, float] | None
) -> None:
    fields = {"kind": kind, "rotation": rotation, "controller": controller, "gripper": "none"}
    if kind == "absolute":
        del fields["controller"]
    action = ActionSpec.model_validate({"horizon": 1, "dt_s": 0.1, **fields})
    turns = [number] * (action.dimension - 3)
    found = found_in(action, [0.43, 0.0, 0.2, *turns])
    if rotation in ("quaternion", "rotation_6d"):
        assert ("error", rotation) in found


@pytest.mark.parametrize(
    ("row", "wanted"),
    [
        ([0.05, 0.0, 0.0, 0.0, 0.0, 0.0], set()),
        ([0.06, 0.0, 0.0, 0.0, 0.0, 0.0], {("warning", "step_limit"), ("warning", "speed_limit")}),
        ([0.21, 0.0, 0.0, 0.0, 0.0, 0.0], {("error", "position_units")}),
        ([0.0, 0.0, 0.0, 0.0, 0.0, 0.08], set()),
        ([0.0, 0.0, 0.0, 0.0, 0.0, 0.12], {("warning", "speed_limit")}),
        ([0.0, 0.0, 0.0, 0.0, 0.0, 0.81], {("error", "rotation_units")}),
    ],
)
def test_deltas_are_held_against_the_limits(row: list[float], wanted: set[tuple[str, str]]) -> None:
    assert found_in(ActionSpec(horizon=1, dt_s=0.1, gripper="none"), row) == wanted


@pytest.mark.parametrize(
    ("kind", "row", "wanted"),
    [
        ("delta", [0.1, 0.0], set()),
        ("delta", [0.0, 0.15], {("warning", "speed_limit")}),
        ("delta", [0.25, 0.0], {("warning", "step_limit"), ("warning", "speed_limit")}),
        ("delta", [0.81, 0.0], {("error", "joint_units")}),
        ("velocity", [1.0, 0.0], set()),
        ("velocity", [1.5, 0.0], {("warning", "speed_limit")}),
        ("absolute", [3.0, 0.0], set()),
        ("absolute", [30.0, 0.0], {("error", "joint_units")}),
    ],
)
def test_joints_are_held_against_the_limits(
    kind: Any, row: list[float], wanted: set[tuple[str, str]]
) -> None:
    action = ActionSpec(
        horizon=1, dt_s=0.1, gripper="none", space="joint", joints=("a", "b"), kind=kind
    )
    assert found_in(action, row) == wanted


@pytest.mark.parametrize(
    ("meaning", "fits", "breaks"),
    [
        ("delta_m", (-0.08, 0.0, 0.08), (-0.2, 1.0)),
        ("absolute_m", (0.0, 0.08), (-0.05, 0.5)),
        ("open_fraction", (0.0, 1.0), (-1.0, 80.0)),
        ("binary", (-1.0, 0.0, 1.0), (255.0,)),
    ],
)
def test_the_gripper_is_held_against_its_meaning(
    meaning: GripperSemantics, fits: tuple[float, ...], breaks: tuple[float, ...]
) -> None:
    action = ActionSpec(horizon=1, dt_s=0.1, gripper=meaning)
    for value in fits:
        assert found_in(action, [0.0] * 6 + [value]) == set()
    level = "warning" if meaning == "binary" else "error"
    for value in breaks:
        assert found_in(action, [0.0] * 6 + [value]) == {(level, "gripper_range")}


def test_the_chart_differs_from_all_its_mirror_images_and_channel_orders() -> None:
    picture = chart(24, 32)
    others = [picture[::-1], picture[:, ::-1], picture[::-1, ::-1], picture[..., ::-1]]
    for other in others:
        assert np.abs(picture.astype(int) - other).mean() > 10
    assert example_styles()[0].picture is chart


# -- the command ----------------------------------------------------------------------------------


def test_the_command_passes_a_good_one() -> None:
    done = command_line("check", str(BROKEN), "--profile", "panda_sim", "--runs", "3")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "keeps its contract, 0 warnings" in done.stdout


def test_the_command_prints_json_and_fails_with_1_for_a_warning_where_it_is_strict() -> None:
    words = ("check", str(BROKEN), "--set", "fault=deaf", "--runs", "3", "--strict", "--json")
    done = command_line(*words)
    assert done.returncode == 1, done.stderr
    said = json.loads(done.stdout)
    assert said["ok"] is True
    assert [finding["name"] for finding in said["findings"]] == ["ignores_prompt"]


def test_a_file_that_is_no_model_is_named_and_fails_with_1() -> None:
    done = command_line("check", "replay", "--json")
    assert done.returncode == 1
    said = json.loads(done.stdout)
    assert said["ok"] is False
    (finding,) = said["findings"]
    assert finding["name"] == "cannot_be_made"
    assert "Its options: file" in finding["why"]
