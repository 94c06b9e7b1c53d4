"""Orders, wordings, episodes and their judge."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.errors import RecordError, ResourceError
from vla_zenoh.lab.tasks.episode import draw_episode, draw_stay
from vla_zenoh.lab.tasks.judge import LIMIT_S, TaskJudge
from vla_zenoh.lab.tasks.order import (
    COLOURS,
    DIRECTIONS,
    FAMILIES,
    HELD_OUT,
    NONSENSE,
    TRAINING,
    Order,
    brick,
    phrase,
)
from vla_zenoh.types import ObjectPoses

REST_M = 0.0096
OPEN_M, SHUT_M, HELD_M = 0.08, 0.0, 0.032
PERIOD_S = 0.1
PLACES = {
    "red": (0.40, -0.15),
    "blue": (0.55, -0.15),
    "green": (0.42, 0.05),
    "yellow": (0.58, 0.0),
    "box": (0.50, 0.24),
}


def objects(**moved: tuple[float, float, float]) -> ObjectPoses:
    """All objects on the table, those of `moved` elsewhere."""
    names, places = [], []
    for name, (x, y) in PLACES.items():
        names.append(name if name == "box" else brick(name))
        places.append(moved.get(name, (x, y, 0.0 if name == "box" else REST_M)))
    return ObjectPoses(tuple(names), np.array(places), np.tile([0.0, 0.0, 0.0, 1.0], (5, 1)))


def watch(judge: TaskJudge, scenes: list[tuple[ObjectPoses, float]], linger: int = 8):
    """Show scenes one after the other, the last for a while; gives the verdict."""
    for index, (scene, width_m) in enumerate(scenes + [scenes[-1]] * linger):
        verdict = judge.update(scene, width_m, index * PERIOD_S)
        if verdict is not None:
            return verdict
    return judge.end()


def moved(colour: str, dx: float, dy: float, z: float = REST_M) -> ObjectPoses:
    x, y = PLACES[colour]
    return objects(**{colour: (x + dx, y + dy, z)})


IN_BOX = objects(red=(0.51, 0.22, 0.0126))
IN_THE_AIR = moved("red", 0.0, 0.1, 0.12)
ON_GREEN = objects(red=(0.424, 0.053, 0.0288))
PUT, STACK = Order("put", "red"), Order("stack", "red", onto="green")
PUSH = Order("push", "red", direction="away")


def test_a_brick_let_go_of_in_the_box_is_a_success() -> None:
    verdict = watch(TaskJudge(PUT, objects()), [(IN_THE_AIR, HELD_M), (IN_BOX, OPEN_M)])
    assert verdict.success
    assert verdict.failure == ""


def test_a_brick_in_the_box_that_is_still_held_is_none_yet() -> None:
    verdict = watch(TaskJudge(PUT, objects()), [(IN_THE_AIR, HELD_M), (IN_BOX, HELD_M)])
    assert not verdict.success


def test_a_brick_on_the_other_is_a_success_and_one_beside_it_was_dropped() -> None:
    air = (IN_THE_AIR, HELD_M)
    assert watch(TaskJudge(STACK, objects()), [air, (ON_GREEN, OPEN_M)]).success
    beside = objects(red=(0.47, 0.05, REST_M))
    assert watch(TaskJudge(STACK, objects()), [air, (beside, OPEN_M)]).failure == "dropped"


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_push_counts_in_its_own_direction_only(direction: str) -> None:
    along = np.array(DIRECTIONS[direction]) * 0.07
    scene = moved("green", *along)
    for asked in DIRECTIONS:
        judge = TaskJudge(Order("push", "green", direction=asked), objects())
        assert watch(judge, [(scene, SHUT_M)]).success == (asked == direction)


@pytest.mark.parametrize(
    ("order", "scenes", "failure"),
    [
        (PUT, [(objects(blue=(0.55, -0.15, 0.1)), HELD_M)], "wrong_brick"),
        (PUT, [(moved("red", 0, 0, -0.3), OPEN_M)], "fell"),
        (PUT, [(IN_THE_AIR, HELD_M), (moved("red", 0, 0.1), OPEN_M)], "dropped"),
        (PUT, [(objects(), SHUT_M), (objects(), OPEN_M)], "missed_grasp"),
        (PUT, [(moved("red", 0.03, 0), OPEN_M)], "knocked"),
        (PUT, [(objects(), OPEN_M)], "not_moved"),
        (PUT, [(IN_THE_AIR, HELD_M)], "timeout"),
        (PUSH, [(moved("red", 0.02, 0), SHUT_M)], "off_course"),
        (PUSH, [(moved("red", 0.0, 0.08), SHUT_M)], "off_course"),
        (PUSH, [(objects(), SHUT_M)], "not_moved"),
        (Order("stay"), [(moved("red", 0.05, 0), OPEN_M)], "moved"),
    ],
)
def test_every_failure_has_its_name(order: Order, scenes: list, failure: str) -> None:
    verdict = watch(TaskJudge(order, objects()), scenes)
    assert (verdict.success, verdict.failure) == (False, failure)


def test_who_is_to_stay_succeeds_by_standing_still_until_the_end() -> None:
    home_m = np.array([0.43, 0.0, 0.16])
    judge = TaskJudge(Order("stay"), objects(), home_m)
    assert judge.update(objects(), OPEN_M, 0.0, home_m) is None
    assert judge.end().success
    judge.update(objects(), OPEN_M, 1.0, home_m + [0.0, 0.0, 0.05])
    judge.update(objects(), OPEN_M, 2.0, home_m)
    assert judge.end().failure == "moved"


def test_a_scene_without_bricks_is_refused_by_name() -> None:
    other = ObjectPoses(("brick", "box"), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))
    with pytest.raises(RecordError, match=r"red_brick.*scene 'bricks'"):
        TaskJudge(PUT, other)


@pytest.mark.parametrize(
    "parts",
    [
        {"family": "eat", "target": "red"},
        {"family": "put", "target": "purple"},
        {"family": "put", "target": "red", "onto": "blue"},
        {"family": "stack", "target": "red", "onto": "red"},
        {"family": "push", "target": "red"},
        {"family": "stay", "target": "red"},
    ],
)
def test_an_order_whose_parts_do_not_fit_is_refused(parts: dict[str, str]) -> None:
    with pytest.raises(RecordError):
        Order(**parts)


@given(st.integers(0, 1 << 30), st.sampled_from(FAMILIES), st.booleans())
def test_a_drawn_episode_is_possible_and_the_same_again(
    seed: int, family: str, held_out: bool
) -> None:
    episode = draw_episode(seed, objects(), family=family, held_out=held_out)
    assert episode == draw_episode(seed, objects(), family=family, held_out=held_out)
    assert episode.order.family == family
    assert episode.order.target in episode.prompt
    assert episode.order.onto in episode.prompt
    for way in (episode.order.onto, episode.order.target):
        assert "{" not in episode.prompt, way


def test_a_brick_is_not_to_be_pushed_into_another() -> None:
    blocked = objects(blue=(0.49, -0.15, REST_M))
    asked = {
        draw_episode(seed, blocked, family="push", target="red").order.direction
        for seed in range(60)
    }
    assert "away" not in asked
    assert "right" in asked


def test_a_layout_without_room_says_so() -> None:
    around = {
        "blue": (0.47, -0.15, REST_M),
        "green": (0.40, -0.08, REST_M),
        "yellow": (0.40, -0.22, REST_M),
    }
    with pytest.raises(ResourceError, match="use another seed"):
        draw_episode(0, objects(**around), family="push", target="red")


def test_wordings_that_are_held_out_are_not_in_training() -> None:
    for family in FAMILIES:
        assert not set(TRAINING[family]) & set(HELD_OUT[family])


def test_every_wording_says_what_it_has_to() -> None:
    needed = {"put": ("{x}",), "stack": ("{x}", "{y}"), "push": ("{x}", "{d}")}
    for wordings in (TRAINING, HELD_OUT):
        for family, parts in needed.items():
            for wording in wordings[family]:
                assert all(part in wording for part in parts), wording


def test_nonsense_names_its_order() -> None:
    for seed, sentence in enumerate(NONSENSE):
        episode = draw_stay(seed)
        assert (episode.order, episode.prompt) == (Order("stay"), sentence)


@given(st.integers(0, 1 << 30))
def test_what_is_said_differs_from_other_orders(choice: int) -> None:
    orders = [Order("put", x) for x in COLOURS]
    orders += [Order("push", "red", direction=d) for d in DIRECTIONS]
    assert len({phrase(order, choice) for order in orders}) == len(orders)


def test_time_is_long_enough_for_the_whole_way() -> None:
    assert LIMIT_S >= 20.0
