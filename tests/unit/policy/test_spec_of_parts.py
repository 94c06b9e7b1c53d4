"""A spec of several parts: whose columns are whose, and what the model sees of each."""

from __future__ import annotations

import pytest

from vla_zenoh.errors import SpecError
from vla_zenoh.policy import ActionSpec, ModelSpec, ObservationSpec, check_steps
from vla_zenoh.policy.observation import state_names

SIX = tuple(f"joint{i}" for i in range(6))


def part() -> ActionSpec:
    return ActionSpec(
        space="joint",
        joints=SIX,
        kind="absolute",
        horizon=100,
        dt_s=0.02,
        gripper="open_fraction",
    )


ALOHA = ActionSpec.of_parts({"left": part(), "right": part()})


def test_two_arms_of_six_joints_with_grippers_have_fourteen_columns() -> None:
    assert ALOHA.dimension == 14
    assert (ALOHA.columns("left"), ALOHA.columns("right")) == (slice(0, 7), slice(7, 14))
    assert ALOHA.of("right") == part()
    assert check_steps(ALOHA, [[0.0] * 14]).shape == (1, 14)
    with pytest.raises(SpecError, match=r"the spec says \(H, 14\)"):
        check_steps(ALOHA, [[0.0] * 7])


def test_a_spec_of_one_arm_is_that_of_its_only_part() -> None:
    one = part()
    assert one.of("") is one
    assert one.columns("") == slice(0, 7)
    assert "parts" not in one.model_dump()
    with pytest.raises(SpecError, match="has no columns for part 'left'"):
        one.of("left")


def test_it_survives_the_wire() -> None:
    spec = ModelSpec(name="aloha", action=ALOHA)
    assert ModelSpec.from_dict(spec.to_dict()) == spec
    assert spec.parts == ("left", "right")


@pytest.mark.parametrize("other", [{"horizon": 50}, {"dt_s": 0.05}])
def test_parts_have_the_same_steps(other: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="all parts of a chunk have the same"):
        ActionSpec.of_parts({"left": part(), "right": part().model_copy(update=other)})


def test_the_states_of_every_part_are_observed() -> None:
    seen = ObservationSpec(state=("joint", "gripper"))
    names = state_names(seen, ModelSpec(name="x", action=ALOHA).parts)
    assert list(names) == ["left/joint", "left/gripper", "right/joint", "right/gripper"]
    assert names["right/gripper"] == ("right", "gripper")
