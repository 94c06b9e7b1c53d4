"""The guide of the page: recording a number of episodes in turn."""

from __future__ import annotations

import pytest
from vla_zenoh_web.episode_guide import EpisodeGuide

from vla_zenoh.errors import NodeError


def begun(wanted: int = 2) -> EpisodeGuide:
    guide = EpisodeGuide()
    guide.begin(wanted)
    return guide


def take(guide: EpisodeGuide) -> None:
    guide.take()
    guide.observe("brick", by_hand=False)
    guide.observe("", by_hand=False)


def test_takes_go_on_until_enough_count_and_then_become_a_data_set() -> None:
    guide = begun(2)
    take(guide)
    guide.judge("success")
    assert guide.step == "scene"
    take(guide)
    guide.judge("failure")
    assert guide.step == "export"
    guide.exported("data/: 2 episodes")
    assert guide.described()["text"] == "data/: 2 episodes"
    guide.begin(5)
    assert (guide.step, guide.kept) == ("scene", 0)


def test_a_take_of_a_model_ends_when_the_button_is_let_go() -> None:
    guide = begun()
    guide.take()
    guide.observe("", by_hand=False)  # not pressed yet
    assert guide.step == "take"
    guide.observe("brick", by_hand=False)
    assert guide.step == "take"
    guide.observe("", by_hand=False)
    assert guide.step == "judge"
    assert guide.worker == "brick"


def test_by_hand_a_person_says_when_the_take_ends() -> None:
    guide = begun()
    guide.take()
    for obeyed in ("teleop", "", "teleop", ""):
        guide.observe(obeyed, by_hand=True)
        assert guide.step == "take"
    guide.end()
    assert guide.step == "judge"


def test_a_void_take_is_repeated() -> None:
    guide = begun(1)
    take(guide)
    guide.judge("void")
    assert guide.step == "scene"
    assert guide.described()["text"].startswith("Episode 1 of 1:")
    assert guide.described()["void"] == 1


def test_a_take_that_ended_by_mistake_goes_on() -> None:
    guide = begun()
    take(guide)
    guide.take()
    assert guide.step == "take"
    assert guide.worker == "brick"


def test_fewer_takes_make_a_data_set_but_none_do_not() -> None:
    guide = begun(10)
    with pytest.raises(NodeError, match="no take counts yet"):
        guide.finish()
    take(guide)
    guide.judge("success")
    guide.finish()
    assert guide.step == "export"


def test_what_has_no_place_in_a_step_is_rejected_with_what_has() -> None:
    guide = begun()
    with pytest.raises(NodeError, match="now: scene, take, finish, cancel"):
        guide.judge("success")
    take(guide)
    with pytest.raises(NodeError, match="now: again, judge, cancel"):
        guide.begin(3)
    guide.cancel()
    assert guide.step == "idle"


@pytest.mark.parametrize("step", ["scene", "take", "judge", "export", "done"])
def test_every_step_says_what_to_do(step: str) -> None:
    guide = begun(1)
    ways = {
        "scene": lambda: None,
        "take": guide.take,
        "judge": lambda: take(guide),
        "export": lambda: (take(guide), guide.judge("success")),
        "done": lambda: (take(guide), guide.judge("success"), guide.exported("made")),
    }
    ways[step]()
    assert guide.step == step
    assert guide.described()["text"]
