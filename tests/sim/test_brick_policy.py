"""The shipped policy does its tasks: the whole chain in lockstep, true poses judge."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vla_zenoh_benchmarks.lockstep.loop import Lockstep

from vla_zenoh import resources
from vla_zenoh.errors import WorkerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.lab.tasks.episode import TaskEpisode, draw_episode
from vla_zenoh.lab.tasks.judge import TaskJudge, Verdict
from vla_zenoh.lab.tasks.order import HELD_OUT, NONSENSE, TRAINING, Order, brick, phrase
from vla_zenoh.lab.tasks.task import DemoPlan, order_of
from vla_zenoh.policy import ActionSteps, Policy, check_steps
from vla_zenoh.policy.inference import Committed
from vla_zenoh.policy.loader import find_model, import_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.world import World, build_world
from vla_zenoh.types import Image, ObjectPoses, PoseState

FOLDER = resources.find("models", "brick")
BRICK: Any = import_model(find_model("brick"))
HELD_OUT_FILES = ("held_out.txt", "held_out_no_task.txt", "final.txt", "final_no_task.txt")
COMMANDS = (
    "put the red brick in the box",
    "stack the blue brick on the green brick",
    "push the yellow brick to the left",
)
ORDERS = (
    Order("put", "green"),
    Order("stack", "blue", onto="red"),
    Order("push", "yellow", direction="closer"),
)
PROFILE = "panda_bricks"
LIMIT_S, STAY_S = 20.0, 1.0
CAMERA_SIZE = (320, 240)
MAX_WEIGHTS_BYTES = 9_000_000
SEED = 5
STILL_M = 1e-4
WALK_STEPS, WALK_STEP_M = 150, 0.02
MANY = 12
ENOUGH = 11
FROZEN = 3


@dataclass(slots=True)
class Stage:
    world: World
    renderer: Renderer

    def picture(self, camera: str) -> Image:
        self.renderer.set_qpos(self.world.qpos())
        return Image(self.renderer.render(camera, *CAMERA_SIZE))

    def objects(self) -> ObjectPoses:
        objects = self.world.objects()
        places, turns = zip(*objects.values(), strict=True)
        return ObjectPoses(tuple(objects), np.array(places), np.array(turns))


@pytest.fixture(scope="module")
def stage() -> Iterator[Stage]:
    profile = load_profile(PROFILE)
    with Renderer(profile.sim.scene, [RobotModel()]) as renderer:
        yield Stage(build_world(profile), renderer)


@pytest.fixture(scope="module")
def policy() -> Policy:
    made = make_policy(find_model("brick"))
    made.load()  # pyright: ignore[reportAttributeAccessIssue]
    return made


def carry_out(stage: Stage, episode: TaskEpisode, limit_s: float = LIMIT_S) -> Verdict:
    """Reset, ask, and look on until it is decided."""
    stage.world.reset(episode.seed)
    loop = Lockstep(
        load_profile(PROFILE),
        stage.world,
        make_policy(find_model("brick")),
        picture=stage.picture,
        steps=2,
    )
    loop.put("prompt", episode.prompt)
    loop.run(0.6)
    loop.put("active", True)
    loop.run(0.02)
    assert loop.commander.state.value == "active", loop.commander.why
    judge = TaskJudge(episode.order, stage.objects(), stage.world.tcp()[0])
    begin_ns = loop.now_ns
    while (time_s := (loop.now_ns - begin_ns) / 1e9) < limit_s:
        loop.run(0.1)
        world = stage.world
        width_m = world.gripper_state().width_m
        verdict = judge.update(stage.objects(), width_m, time_s, world.tcp()[0])
        if verdict is not None:
            return verdict
    return judge.end()


def drawn(stage: Stage, seed: int, family: str, target: str | None = None) -> TaskEpisode:
    stage.world.reset(seed)
    return draw_episode(seed, stage.objects(), family=family, target=target)


@pytest.mark.long
@pytest.mark.parametrize("family", ["put", pytest.param("stack", marks=pytest.mark.slow), "push"])
def test_each_family_of_tasks_is_done(stage: Stage, family: str) -> None:
    verdict = carry_out(stage, drawn(stage, SEED, family))
    assert verdict.success, verdict.failure


@pytest.mark.slow
def test_another_prompt_in_the_same_scene_fetches_another_brick(stage: Stage) -> None:
    for colour in ("red", "yellow"):
        episode = drawn(stage, SEED + 1, "put", colour)
        verdict = carry_out(stage, episode)
        assert verdict.success, (episode.prompt, verdict.failure)


def test_a_prompt_without_sense_makes_it_stay(stage: Stage) -> None:
    stage.world.reset(SEED)
    before = stage.objects().position_m
    verdict = carry_out(stage, TaskEpisode(SEED, Order("stay"), NONSENSE[6]), STAY_S)
    assert verdict.success
    np.testing.assert_allclose(stage.objects().position_m, before, atol=STILL_M)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("family", ["put", "stack", "push"])
def test_tasks_are_done_in_many_layouts(stage: Stage, family: str) -> None:
    verdicts = [carry_out(stage, drawn(stage, 900 + seed, family)) for seed in range(MANY)]
    done = sum(verdict.success for verdict in verdicts)
    assert done >= ENOUGH - (family != "put"), [verdict.failure for verdict in verdicts]


# -- what it reads -------------------------------------------------------------------------------


def understood(policy: Policy, prompt: str) -> bool:
    """Whether it would do anything at all."""
    policy.reset()  # pyright: ignore[reportAttributeAccessIssue]
    result = policy.infer(example_observation(policy.spec, prompt=prompt))
    assert isinstance(result, ActionSteps)
    return bool(np.any(check_steps(policy.spec.action, result.steps)))


def test_nonsense_is_not_understood(policy: Policy) -> None:
    assert [sentence for sentence in NONSENSE if understood(policy, sentence)] == []


@pytest.mark.parametrize("wordings", [TRAINING, HELD_OUT], ids=["training", "held out"])
def test_every_wording_is_understood(policy: Policy, wordings: dict) -> None:
    orders = {
        "put": Order("put", "green"),
        "stack": Order("stack", "blue", onto="red"),
        "push": Order("push", "yellow", direction="closer"),
    }
    missed = [
        sentence
        for family, order in orders.items()
        for choice in range(len(wordings[family]))
        if not understood(policy, sentence := phrase(order, choice, held_out=wordings is HELD_OUT))
    ]
    assert missed == []


def held_out(name: str) -> list[str]:
    return (FOLDER / "training" / name).read_text("utf-8").splitlines()


def read(policy: Policy, prompt: str) -> str:
    """What it takes a prompt for."""
    policy.reset()  # pyright: ignore[reportAttributeAccessIssue]
    result = policy.infer(example_observation(policy.spec, prompt=prompt))
    assert isinstance(result, ActionSteps)
    assert result.raw is not None
    return str(result.raw["read"])


@pytest.mark.parametrize(
    ("name", "count", "right", "wrong"),
    [
        pytest.param("held_out.txt", 300, 0.95, 0.01, marks=pytest.mark.long),
        ("final.txt", 60, 0.9, 0.02),
        ("independent.txt", 60, 0.95, 0.0),
    ],
)
def test_free_wordings_that_were_never_taught_are_read(
    policy: Policy, name: str, count: int, right: float, wrong: float
) -> None:
    meant = [line.split(": ", 1) for line in held_out(name)]
    found = [read(policy, sentence) for _, sentence in meant]
    assert len(found) >= count
    as_meant = [one == meaning for one, (meaning, _) in zip(found, meant, strict=True)]
    otherwise = [one != "no task" and not ok for one, ok in zip(found, as_meant, strict=True)]
    assert np.mean(as_meant) >= right
    assert np.mean(otherwise) <= wrong


@pytest.mark.parametrize(
    ("name", "count", "still"),
    [
        pytest.param("held_out_no_task.txt", 160, 0.98, marks=pytest.mark.long),
        ("final_no_task.txt", 40, 0.9),
        ("independent_no_task.txt", 47, 1.0),
    ],
)
def test_nonsense_and_negation_that_were_never_taught_do_nothing(
    policy: Policy, name: str, count: int, still: float
) -> None:
    found = [read(policy, sentence) for sentence in held_out(name)]
    assert len(found) >= count
    assert np.mean([one == "no task" for one in found]) >= still


def test_what_it_reads_needs_no_pictures_and_is_a_goal(policy: Any) -> None:
    assert order_of(policy.read("toss the red cube in the tray")) == Order("put", "red")
    assert order_of(policy.read("pile blue onto red")) == Order("stack", "blue", onto="red")
    pulled = Order("push", "green", direction="closer")
    assert order_of(policy.read("pull the green one closer to you")) == pulled
    assert order_of(policy.read("don't toss the red cube in the tray")) is None


def test_a_demo_judges_free_wording_by_the_goal_that_was_read() -> None:
    goal = Order("put", "red")
    plan = DemoPlan("brick", 1, 1, prompts=("toss it", "go"), orders={"toss it": goal})
    first, second = plan.requests()
    assert first.prompt is not None
    nowhere = ObjectPoses((), np.zeros((0, 3)), np.zeros((0, 4)))
    assert first.draw(nowhere, held_out=False).order == goal
    assert second.draw(nowhere, held_out=False).order == Order("stay")


@pytest.mark.parametrize("command", COMMANDS)
def test_a_negated_command_is_never_obeyed(policy: Policy, command: str) -> None:
    negated = [form.format(command) for form in held_out("negated.txt")]
    negated += [form.replace("'", "\u2019").format(command) for form in held_out("negated.txt")]
    assert read(policy, command) != "no task"
    assert [one for one in negated if read(policy, one) != "no task"] == []


@pytest.mark.parametrize(
    "prompt", ["", "!!", "x" * 4000, "put " * 40, "put the rot brick in Kiste"]
)
def test_odd_prompts_make_it_stay(policy: Policy, prompt: str) -> None:
    assert not understood(policy, prompt)


def test_no_sentence_that_is_held_out_is_taught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER / "training"))
    for name in ("model", "expert", "states", "worker", "phrases"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    from phrases import Phrases  # pyright: ignore[reportMissingImports]

    phrases, random = Phrases([]), np.random.default_rng(3)
    taught = {phrases.draw(random)[0] for _ in range(5000)}
    kept = {line.partition(": ")[2] or line for name in HELD_OUT_FILES for line in held_out(name)}
    kept |= {phrase(order, choice, held_out=True) for order in ORDERS for choice in range(100)}
    assert not taught & {sentence.lower() for sentence in kept | {*NONSENSE}}


@settings(max_examples=30)
@given(st.text(max_size=500))
def test_any_text_becomes_as_many_numbers(prompt: str) -> None:
    words = (FOLDER / "words.txt").read_text("utf-8").split()
    tokens = BRICK.tokens_of(prompt, {word: index + 2 for index, word in enumerate(words)})
    assert tokens.shape == (1, BRICK.MAX_PIECES)
    assert tokens[0, 0] > 0
    assert tokens.max() < len(words) + 2


def test_an_unknown_word_is_cut_into_the_longest_pieces_from_its_beginning() -> None:
    words = {"play": 2, "##ing": 3, "##i": 4, "'": 5, "s": 6}
    assert BRICK.tokens_of("Playing, plaÿ's", words)[0, :6].tolist() == [2, 3, 1, 2, 5, 6]
    assert BRICK.tokens_of("xplay " * 40, words)[0].tolist() == [1] + [0] * 31


# -- what it remembers ---------------------------------------------------------------------------


def test_worker_and_teacher_remember_the_same_of_a_hand(
    policy: Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(FOLDER / "training"))
    monkeypatch.delitem(sys.modules, "expert", raising=False)
    from expert import Hand  # pyright: ignore[reportMissingImports]

    random = np.random.default_rng(SEED)
    policy.reset()  # pyright: ignore[reportAttributeAccessIssue]
    observation = example_observation(policy.spec, prompt="")
    assert observation.pose is not None
    place, swept_m, down = np.array([0.45, 0.0, 0.1]), 0.0, None
    greatest_m = 0.0
    for _ in range(WALK_STEPS):
        place = place + random.normal(size=3) * WALK_STEP_M
        place[2] = min(max(place[2], 0.01), 0.12)
        pose = replace(observation.pose, position_m=place)
        policy.infer(replace(observation, pose=pose))
        taught = Hand(*place.tolist(), 0.0, 0.08, swept_m, down).swept()
        swept_m, down = taught.swept_m, taught.down
        remembered = policy._memory[""].hand  # pyright: ignore[reportAttributeAccessIssue]
        assert remembered.swept_m == pytest.approx(swept_m)
        assert (remembered.down_m is None) == (down is None)
        greatest_m = max(greatest_m, swept_m)
    assert greatest_m > WALK_STEP_M


def test_a_push_that_was_made_is_forgotten_with_another_prompt(policy: Policy) -> None:
    policy.reset()  # pyright: ignore[reportAttributeAccessIssue]
    low = [np.array([x, 0.0, 0.016]) for x in (0.4, 0.55)]
    for prompt, swept_m in (("push the red brick away", 0.15), ("push the blue brick away", 0.0)):
        observation = example_observation(policy.spec, prompt=prompt)
        assert observation.pose is not None
        for place in low:
            policy.infer(replace(observation, pose=replace(observation.pose, position_m=place)))
            low = [low[-1]]
        remembered = policy._memory[""].hand  # pyright: ignore
        assert remembered.swept_m == pytest.approx(swept_m)


# -- the steps in execution ----------------------------------------------------------------------


def test_a_chunk_that_goes_on_from_given_steps_is_nearer_to_the_teacher_than_one_that_does_not(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(FOLDER / "training"))
    monkeypatch.delitem(sys.modules, "expert", raising=False)
    from expert import Hand, Point, foretell  # pyright: ignore[reportMissingImports]

    made: Any = make_policy(find_model("brick"), {"prefix": "on"})
    think = made.think
    off_m: dict[bool, list[float]] = {True: [], False: []}
    for seed, told in product(range(SEED, SEED + 6), off_m):
        stage.world.reset(seed)
        stage.renderer.set_qpos(stage.world.qpos())
        objects, position_m = stage.world.objects(), stage.world.tcp()[0]
        seen = {
            each.camera: stage.renderer.render(each.camera, each.width, each.height)
            for each in made.spec.observation.cameras
        }
        observation = example_observation(made.spec, prompt="put the red brick in the box")
        assert observation.pose is not None
        pose = PoseState(position_m, observation.pose.quat_xyzw, np.zeros(6))
        gripper = stage.world.gripper_state()
        observation = replace(observation, images=seen, pose=pose, gripper=gripper)
        made.reset()
        blue = replace(observation.task, prompt="put the blue brick in the box")
        other = made.infer(replace(observation, task=blue)).steps
        made.reset()
        monkeypatch.setattr(
            made,
            "think",
            lambda asked, told=told: think([q._replace(given=q.given * told) for q in asked]),
        )
        steps = made.infer(observation, committed=Committed(other[:-1], FROZEN)).steps
        np.testing.assert_array_equal(steps[:FROZEN], other[:FROZEN])
        hand = Hand(*position_m.tolist(), 0.0, gripper.width_m)
        ends = np.cumsum(other[:FROZEN][:, [0, 1, 2, 5]], axis=0)
        opened = (other[:FROZEN, 6] > 0).tolist()
        rows = [(*end, float(o)) for end, o in zip(ends.tolist(), opened, strict=True)]
        red, box = (Point(*objects[name][0].tolist()) for name in (brick("red"), "box"))
        taught = np.array(foretell("put", hand, red, box, "", rows))
        way = np.cumsum(steps[:, :3], axis=0)
        off_m[told].append(float(np.linalg.norm(way - taught[:, :3], axis=1)[FROZEN:].mean()))
    assert np.mean(off_m[True]) < 0.7 * np.mean(off_m[False]), off_m


# -- what it is made of --------------------------------------------------------------------------


def test_the_weights_are_small_and_are_those_of_the_manifest() -> None:
    manifest = json.loads((FOLDER / "weights.json").read_text())
    files = {FOLDER / name: sha256 for name, sha256 in manifest["sha256"].items()}
    assert {file.suffix for file in files} == {".onnx", ".safetensors", ".txt"}
    assert sum(file.stat().st_size for file in files) < MAX_WEIGHTS_BYTES
    for file, sha256 in files.items():
        assert hashlib.sha256(file.read_bytes()).hexdigest() == sha256


def test_changed_weights_are_refused_with_both_sums(tmp_path: Path) -> None:
    for name in ("brick.onnx", "words.txt", "weights.json"):
        shutil.copy(FOLDER / name, tmp_path / name)
    graph = tmp_path / "brick.onnx"
    graph.write_bytes(graph.read_bytes()[:-1] + b"x")
    changed = make_policy(find_model("brick"), {"weights": str(tmp_path)})
    found = hashlib.sha256(graph.read_bytes()).hexdigest()
    with pytest.raises(WorkerError, match=found):
        changed.load()  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("missing", ["brick.onnx", "words.txt", "weights.json"])
def test_a_file_that_is_missing_is_named(tmp_path: Path, missing: str) -> None:
    for name in {"brick.onnx", "words.txt", "weights.json"} - {missing}:
        shutil.copy(FOLDER / name, tmp_path / name)
    with pytest.raises(WorkerError, match=missing):
        make_policy(find_model("brick"), {"weights": str(tmp_path)}).load()  # pyright: ignore
