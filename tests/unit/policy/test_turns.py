"""What a policy reads of joints that turn without an end: as it declares, in every place alike."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
from endless_arm import ENDLESS, endless_arm
from vla_zenoh_dataset.episodes import _as_deltas
from vla_zenoh_dataset.features import _actions, worker_options
from vla_zenoh_policy_servers.action_semantics import read_action_semantics
from vla_zenoh_policy_servers.state_vector import StateNumbers

from vla_zenoh.lab.check.fit import check_chunk
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.frozen import FrozenImages
from vla_zenoh.policy.inference import ChunkPrefix, Committed
from vla_zenoh.policy.meaning import joints_as, nearest_turn, wrapped
from vla_zenoh.policy.observation import Streams, assemble
from vla_zenoh.profile import Limits
from vla_zenoh.types import Header, JointState, Stamped, Task

TURN = 2 * math.pi
Turns = Literal["wrapped", "counted"]
NAMES = ("lift", "wrist")
NOW_NS = 10**18
STILL = np.zeros(2)


def state(wrist_rad: float, lift_rad: float = 7.0) -> JointState:
    at = np.array([lift_rad, wrist_rad])
    return JointState(NAMES, at, STILL, None, at, endless=("wrist",))


def model(turns: Turns, history: int = 1) -> ModelSpec:
    action = ActionSpec(
        horizon=4,
        dt_s=0.1,
        kind="absolute",
        space="joint",
        joints=NAMES[::-1],
        gripper="none",
        turns=turns,
    )
    spaced = {"history": history, "history_spacing_s": 0.1} if history > 1 else {}
    seen = ObservationSpec(state=("joint",), prompt=False, **spaced)
    return ModelSpec(name="m", observation=seen, action=action)


def observed(spec: ModelSpec, *wrist_rad: float) -> Observation:
    """The observation of a wrist at these places, 0.1 s apart, the last one now."""
    streams = Streams.of(spec.observation)
    for ago, at in enumerate(reversed(wrist_rad)):
        header = Header(NOW_NS - ago * 100_000_000, 10 - ago, "sim-1")
        streams.states["joint"].entries.insert(0, Stamped(header, state(at), NOW_NS))
    task = Task(1, True, "", "m", 10.0)
    found = assemble(spec, task, streams, not_before_ns=0, now_ns=NOW_NS)
    assert isinstance(found, Observation), found
    return found


@pytest.mark.parametrize(("turns", "told"), [("wrapped", 3.5 - TURN), ("counted", 3.5 + 6 * TURN)])
def test_an_observation_has_the_declared_form_and_so_has_its_history(
    turns: Turns, told: float
) -> None:
    found = observed(model(turns, 2), 3.4 + 6 * TURN, 3.5 + 6 * TURN)
    assert found.joint is not None
    assert found.joint.position_rad == pytest.approx([7.0, told])
    assert found.joint.reference_rad == pytest.approx([7.0, told])
    (before,) = found.history
    assert before.joint is not None
    assert before.joint.position_rad == pytest.approx([7.0, told - 0.1])


def test_the_declaration_changes_the_hash_and_its_default_does_not() -> None:
    known = model("wrapped")
    assert "turns" not in known.to_dict()["action"]
    assert model("counted").hash != known.hash


@pytest.mark.parametrize("at", [-math.pi, math.pi, -7 * math.pi, 0.0, 100.0, -1e-9])
def test_wrapped_angles_are_above_minus_pi_and_up_to_pi(at: float) -> None:
    found = float(wrapped(np.array([at]))[0])
    assert -math.pi < found <= math.pi
    assert math.cos(found - at) == pytest.approx(1.0)
    assert abs(float(nearest_turn(np.array([found]), np.array([at]))[0]) - at) < 1e-9


def test_what_is_executed_is_mixed_on_the_shortest_way_and_told_in_the_same_form() -> None:
    told: list[Committed | None] = []

    class Model:
        spec = model("wrapped")
        takes_committed = True

        def infer(
            self, observation: Observation, committed: Committed | None = None
        ) -> ActionSteps:
            told.append(committed)
            return ActionSteps(np.zeros((4, 2)))

    prefix = ChunkPrefix(Model())
    before = observed(Model.spec, 3.0)
    steps = np.array([[3.08, 7], [-3.12, 7], [-3.04, 7], [-2.96, 7]], np.float32)
    prefix.published(before, steps, NOW_NS, obeyed=True)
    prefix.infer(replace(before, stamp_wall_ns=NOW_NS + 150_000_000))
    (committed,) = told
    assert committed is not None
    halfway = [(3.08 + TURN - 3.12) / 2 - TURN, -3.08, -3.0]
    wanted = wrapped(np.array(halfway))[-len(committed.steps) :]
    assert committed.steps[:, 0] == pytest.approx(wanted, abs=1e-5)
    assert committed.steps[:, 1] == pytest.approx(7.0)


def test_an_arm_that_crosses_half_a_turn_has_not_moved_far() -> None:
    pixels = np.zeros((4, 4, 3), np.uint8)
    images = FrozenImages({"front": 0.5}, frozenset())
    spec = model("wrapped")

    def look(at: float, ago_s: float) -> Observation:
        found = observed(spec, at)
        stamp_ns = NOW_NS - round(ago_s * 1e9)
        return replace(found, images={"front": pixels}, stamp_wall_ns=stamp_ns)

    assert not images.judge(look(math.pi - 0.01, 2.0))
    assert not images.judge(look(math.pi + 0.01, 1.0))
    assert images.judge(look(math.pi + 0.5, 0.0))


def test_deltas_from_a_start_are_exported_without_the_turn_of_a_reading_at_pi() -> None:
    """And a joint with ends keeps its long step."""
    part = SimpleNamespace(joints=[SimpleNamespace(record=state(3.0))])
    run: Any = SimpleNamespace(of_part=lambda _: part)
    changed = {"kind": "delta", "relative_to": "start"}
    spec = model("wrapped").action.model_copy(update=changed)
    wrist_rad = wrapped(3.0 + 0.08 * np.arange(1, 5)) - 3.0
    steps = np.stack([wrist_rad, np.full(4, 4.0)], axis=1).astype(np.float32)
    assert wrist_rad.min() < -6.0
    meant, rows = _as_deltas(run, spec, steps)
    assert meant.relative_to == "previous"
    assert rows[:, 0] == pytest.approx(0.08, abs=1e-6)
    assert rows[:, 1] == pytest.approx([4.0, 0, 0, 0])


@pytest.mark.parametrize(("turns", "told"), [("wrapped", False), ("counted", True)])
def test_a_check_takes_no_step_over_half_a_turn_for_a_whole_one(turns: Turns, told: bool) -> None:
    wrist_rad = wrapped(3.08 + 0.02 * np.arange(1, 5))
    steps = np.stack([wrist_rad, np.full(4, 2.0)], axis=1).astype(np.float32)
    found = check_chunk(model(turns).action, steps, Limits(), 0.08)
    assert any(each.name == "speed_limit" for each in found) == told


@pytest.mark.parametrize("turns", ["wrapped", "counted"])
def test_data_sets_and_servers_have_the_declared_form(tmp_path: Path, turns: Turns) -> None:
    profile = endless_arm(tmp_path)
    names, still = profile.robot.arm_joints, np.zeros(6)
    at = np.array([0.0, 2.0, 2.0, 0.0, 2.0, 20.0])
    known = JointState(names, at, still, None, endless=ENDLESS)
    part = SimpleNamespace(joints=[SimpleNamespace(record=known)], profile=profile)
    run: Any = SimpleNamespace(of_part=lambda _: part)
    action = ActionSpec(
        horizon=4,
        dt_s=0.1,
        kind="absolute",
        space="joint",
        joints=names,
        gripper="none",
        turns=turns,
    )
    wanted = at - [0, 0, 0, 0, 0, 3 * TURN * (turns == "wrapped")]
    rows = _actions(action, at[None].astype(np.float32), run, "")
    assert np.deg2rad(rows[0]) == pytest.approx(wanted, abs=1e-5)
    options = {**worker_options(action, profile), "horizon": "4"}
    semantics = read_action_semantics(options, joints=names)
    assert semantics.spec.turns == turns
    numbers = StateNumbers(("joint",), names, 0.0, semantics.state_units, (0, 0, 0, 1))
    seen = replace(observed(model(turns), 0.0), joint=joints_as(known, turns))
    assert np.deg2rad(numbers.encode(seen)) == pytest.approx(wanted)


def test_a_state_without_such_joints_is_left_alone() -> None:
    plain = JointState(NAMES, np.array([7.0, 7.0]), STILL, None)
    assert joints_as(plain, "wrapped") is plain
