"""Every shipped model keeps the contract: whoever adds one gets these tests for nothing."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vla_zenoh import resources
from vla_zenoh.control.actions import step_pose
from vla_zenoh.control.plan_timeline import Goal, GoalTimeline, Plan
from vla_zenoh.errors import SpecError, WorkerError
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, Policy, check_steps
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.types import JointState

MODELS = resources.names("models")
ELSEWHERE = {
    "groot",
    "lerobot",
    "lerobot_server",
    "openpi",
    "openvla",
    "openvla_rest",
    "origami",
    "physicalai_client",
    "r2c_policy",
    "ray_serve",
    "xpolicylab",
}
"""They need weights, a server or a client: tested with those, by themselves."""
EXPERTS = {"libero_privileged", "metaworld_expert", "ogbench_expert", "so101_expert"}
"""They need their benchmark and its state."""
HERE = [name for name in MODELS if name not in ELSEWHERE | EXPERTS]
HEAVY = ("torch", "tensorflow", "jax", "zenoh", "mujoco")
OUR_PACKAGE = re.compile(r"(?m)^\s*from (vla_zenoh_(?!model_)\w+)")
"""A package of ours besides the core: an environment of the model's own has what its header names.
"""
PROMPTS = {"scripted": "HARD: go up"}
PROFILES = {"scripted_pair": "two_pandas_sim", "scripted_pick": "so101_sim"}
"""Of workers that act for one robot."""
ATOL = 1e-7


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A chunk file with three chunks of different lengths."""
    return write_chunks(tmp_path_factory.mktemp("chunks") / "chunks.npz", spec(), [3, 1, 2])


def spec(**action: Any) -> ModelSpec:
    fields = {"horizon": 4, "dt_s": 0.1, "gripper": "absolute_m", **action}
    return ModelSpec(name="recorded", action=ActionSpec(**fields))


def write_chunks(path: Path, of: ModelSpec, length: list[int]) -> Path:
    shape = (len(length), of.action.horizon, of.action.dimension)
    steps = np.arange(np.prod(shape), dtype=np.float32).reshape(shape) / 1e4
    np.savez(path, spec=json.dumps(of.to_dict()), steps=steps, length=np.array(length))
    return path


def make(name: str, recorded: Path) -> Policy:
    options = {"file": str(recorded)} if name == "replay" else {}
    return make_policy(find_model(name), options)


def looked_at(policy: Policy, name: str, *, active: bool = True) -> Any:
    seen = example_observation(policy.spec, prompt=PROMPTS.get(name, "hold"))
    if name in PROFILES:
        profile = load_profile(PROFILES[name])
        parts = {part: at_home(profile.of_part(part), own) for part, own in seen.parts.items()}
        seen = replace(seen, parts=parts) if parts else at_home(profile, seen)
    return replace(seen, task=replace(seen.task, active=active))


def at_home(profile: Profile, seen: Observation) -> Observation:
    home = np.array(profile.robot.home_rad)
    still = np.zeros_like(home)
    return replace(seen, joint=JointState(profile.robot.arm_joints, home, still, still))


def test_models_are_shipped() -> None:
    assert {"replay", "scripted"} <= set(MODELS)


@pytest.mark.parametrize("name", MODELS)
def test_its_header_says_what_it_needs(name: str) -> None:
    model = find_model(name)
    assert model.dependencies, "a PEP 723 header with its dependencies is missing"
    assert model.requires_python
    ours = {need for need in model.dependencies if need.startswith("vla-zenoh")}
    imported = set(OUR_PACKAGE.findall(sources(model.path)))
    assert ours == {name.replace("_", "-") for name in imported}


def sources(path: Path) -> str:
    """Text of the file of a model and of those beside it."""
    files = path.parent.glob("*.py") if path.name == "model.py" else [path]
    return "".join(file.read_text("utf-8") for file in files)


@pytest.fixture(scope="module")
def heavy() -> dict[str, list[str]]:
    """Model -> what its import alone loads of `HEAVY`: one after the other in a new process."""
    code = (
        "import json, sys; from vla_zenoh.policy.loader import find_model, import_model\n"
        f"names, heavy, found = {MODELS!r}, {HEAVY!r}, {{}}\n"
        "for name in names:\n"
        "    import_model(find_model(name))\n"
        "    found[name] = sorted(heavy & sys.modules.keys())\n"
        "    for module in found[name]: del sys.modules[module]\n"
        "print(json.dumps(found))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", MODELS)
def test_importing_it_loads_nothing_heavy(heavy: dict[str, list[str]], name: str) -> None:
    assert heavy[name] == []


@pytest.mark.parametrize("name", HERE)
def test_its_spec_travels_and_comes_back(name: str, recorded: Path) -> None:
    declared = make(name, recorded).spec
    again = ModelSpec.from_dict(json.loads(json.dumps(declared.to_dict())))
    assert again == declared
    assert again.hash == declared.hash


@pytest.mark.parametrize("name", HERE)
def test_it_answers_with_steps_of_the_declared_shape(name: str, recorded: Path) -> None:
    policy = make(name, recorded)
    for method in ("load", "reset"):
        getattr(policy, method, lambda: None)()
    for _ in range(8):
        answer = policy.infer(looked_at(policy, name))
        assert isinstance(answer, ActionSteps)
        steps = check_steps(policy.spec.action, answer.steps)
        assert steps.shape[1] == policy.spec.action.dimension
        assert isinstance(answer.done, bool)


@pytest.mark.parametrize("name", HERE)
def test_after_a_reset_it_answers_as_at_first(name: str, recorded: Path) -> None:
    policy = make(name, recorded)
    seen = looked_at(policy, name)
    reset = getattr(policy, "reset", None)
    if reset is None:
        pytest.skip("has nothing to reset")
    first = [np.array(policy.infer(seen).steps) for _ in range(5)]
    reset()
    second = [np.array(policy.infer(seen).steps) for _ in range(5)]
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


# -- scripted -------------------------------------------------------------------------------------


@pytest.mark.parametrize("horizon", [1, 3, 8])
@pytest.mark.parametrize("period_s", [0.1, 0.17, 0.4, 1.3])
@pytest.mark.parametrize(
    ("prompt", "way_m"),
    [("go up x1", 0.01), ("go down x25", -0.25), ("go up x25 within 0.1", 0.05)],
)
def test_scripted_asks_for_exactly_the_way_of_its_prompt_however_often_it_is_asked(
    horizon: int, period_s: float, prompt: str, way_m: float
) -> None:
    policy = make_policy(find_model("scripted"), {"horizon": str(horizon)})
    action = policy.spec.action
    seen = looked_at(policy, "scripted")
    seen = replace(seen, task=replace(seen.task, prompt=f"HARD: {prompt}"))
    timeline = GoalTimeline(Goal(Pose(np.zeros(3), np.eye(3)), 0.08), 0)
    now_ns, done, standing, more = 10**15, False, timeline.plan, 20
    for _ in range(300):
        if not more:  # done long ago
            break
        more -= done
        now_ns += round(period_s * 1e9)
        plan, executed = timeline.plan, None
        if plan is not standing:
            steps = plan.elapsed_ns(now_ns) / plan.dt_ns
            executed = min(max(steps, 1.0), len(plan.goals))
        answer = policy.infer(replace(seen, stamp_wall_ns=now_ns, executed_steps=executed))
        assert done <= answer.done
        done = answer.done
        goals = [timeline.at(now_ns)]
        for step in np.array(answer.steps):
            goals.append(Goal(step_pose(action, step, goals[-1].pose), 0.08))
        timeline.add(Plan(now_ns, now_ns, int(action.dt_s * 1e9), goals[1:]), now_ns)
    assert done
    end_m = timeline.at(now_ns + 10**12).pose.position_m
    np.testing.assert_allclose(end_m, [0, 0, way_m], atol=1e-6)


def test_scripted_gives_one_step_a_request_and_is_done_with_the_last_one() -> None:
    policy = make_policy(find_model("scripted"))
    seen = looked_at(policy, "scripted")
    seen = replace(seen, task=replace(seen.task, prompt="HARD: yaw left x3"))
    executed = [None, *[1.0] * 4]
    answers = [policy.infer(replace(seen, executed_steps=steps)) for steps in executed]
    turns = [float(np.array(answer.steps)[0, 5]) for answer in answers]
    assert turns == pytest.approx([0.05, 0.05, 0.05, 0.0, 0.0])
    assert [answer.done for answer in answers] == [False, False, True, True, True]


def test_scripted_counts_nothing_while_it_is_not_obeyed() -> None:
    policy = make_policy(find_model("scripted"))
    seen = looked_at(policy, "scripted", active=False)
    assert not any(policy.infer(seen).done for _ in range(10))


def test_scripted_names_the_prompts_it_knows() -> None:
    policy = make_policy(find_model("scripted"))
    with pytest.raises(SpecError, match=r"does not know the prompt 'dance'; it knows: 'hold'"):
        policy.infer(example_observation(policy.spec, prompt="dance"))


# -- replay ---------------------------------------------------------------------------------------


def test_replay_gives_back_what_was_recorded_and_then_stands(recorded: Path) -> None:
    policy = make("replay", recorded)
    data = np.load(recorded)
    seen = looked_at(policy, "replay")
    for steps, length, last in zip(
        data["steps"], data["length"], (False, False, True), strict=True
    ):
        answer = policy.infer(seen)
        np.testing.assert_array_equal(np.array(answer.steps), steps[:length])
        assert answer.done is last
    still = policy.infer(seen)
    assert still.done
    expected = [0, 0, 0, 0, 0, 0, data["steps"][2][1][6]]  # the gripper keeps its width
    np.testing.assert_allclose(np.array(still.steps), [expected], atol=ATOL)


def test_replay_does_not_run_away_while_it_is_not_obeyed(recorded: Path) -> None:
    policy = make("replay", recorded)
    idle, obeyed = looked_at(policy, "replay", active=False), looked_at(policy, "replay")
    first = np.array(policy.infer(idle).steps)
    np.testing.assert_array_equal(np.array(policy.infer(idle).steps), first)
    np.testing.assert_array_equal(np.array(policy.infer(obeyed).steps), first)
    assert np.array(policy.infer(obeyed).steps).shape != first.shape


@pytest.mark.parametrize(
    ("action", "still"),
    [
        ({"gripper": "delta_m"}, [0, 0, 0, 0, 0, 0, 0]),
        ({"gripper": "none"}, [0, 0, 0, 0, 0, 0]),
        ({"gripper": "none", "rotation": "quaternion"}, [0, 0, 0, 0, 0, 0, 1]),
        ({"gripper": "delta_m", "rotation": "quaternion"}, [0, 0, 0, 0, 0, 0, 1, 0]),
    ],
)
def test_replay_stands_still_in_every_form_of_delta(
    tmp_path: Path, action: dict[str, Any], still: list[float]
) -> None:
    policy = make("replay", write_chunks(tmp_path / "c.npz", spec(**action), [1]))
    seen = looked_at(policy, "replay")
    policy.infer(seen)
    np.testing.assert_allclose(np.array(policy.infer(seen).steps), [still], atol=ATOL)


def test_replay_of_absolute_poses_stands_at_the_last_one(tmp_path: Path) -> None:
    file = write_chunks(tmp_path / "c.npz", spec(kind="absolute"), [2])
    policy = make("replay", file)
    seen = looked_at(policy, "replay")
    last = np.array(policy.infer(seen).steps)[-1:]
    np.testing.assert_array_equal(np.array(policy.infer(seen).steps), last)


def bad_file(path: Path, fault: str) -> Path:
    good = spec()
    steps, length = np.zeros((2, 4, 7), np.float32), np.array([1, 2])
    if fault == "missing":
        return path
    if fault == "text":
        path.write_text("hello")
    elif fault == "cut zip":
        path.write_bytes(write_chunks(path, good, [1, 2]).read_bytes()[:200])
    elif fault == "one array":
        np.save(path.with_suffix(".npy"), steps)
        return path.with_suffix(".npy")
    elif fault == "no spec":
        np.savez(path, steps=steps, length=length)
    elif fault == "bad spec":
        np.savez(path, spec=json.dumps({"name": "x"}), steps=steps, length=length)
    elif fault == "pickled":
        np.savez(path, spec=np.array([{}], object), steps=steps, length=length)
    elif fault == "lengths":
        np.savez(path, spec=json.dumps(good.to_dict()), steps=steps, length=np.array([1]))
    elif fault == "text lengths":
        np.savez(path, spec=json.dumps(good.to_dict()), steps=steps, length=np.array(["a", "b"]))
    elif fault == "empty chunk":
        np.savez(path, spec=json.dumps(good.to_dict()), steps=steps, length=np.array([1, 0]))
    elif fault == "no chunk":
        np.savez(path, spec=json.dumps(good.to_dict()), steps=steps[:0], length=length[:0])
    elif fault == "not finite":
        np.savez(path, spec=json.dumps(good.to_dict()), steps=steps * np.nan, length=length)
    return path


@pytest.mark.parametrize(
    "fault",
    ["missing", "text", "cut zip", "one array", "no spec", "bad spec", "pickled", "lengths"]
    + ["text lengths", "empty chunk", "no chunk", "not finite"],
)
def test_replay_says_what_is_wrong_with_a_chunk_file(tmp_path: Path, fault: str) -> None:
    file = bad_file(tmp_path / "chunks.npz", fault)
    with pytest.raises(WorkerError, match="Replay cannot be made") as raised:
        make("replay", file)
    assert isinstance(raised.value.__cause__, SpecError), repr(raised.value.__cause__)
