"""A demo on a computer that is small or busy."""

from __future__ import annotations

import pytest

from vla_zenoh.lab.cli.demo_capacity import Capacity, idle_share, measure_capacity, small
from vla_zenoh.profile import load_profile


@pytest.mark.parametrize("name", ["panda_bricks", "so101_sim", "two_pandas_sim"])
def test_a_small_demo_has_smaller_and_fewer_pictures_of_the_same_shape(name: str) -> None:
    profile = load_profile(name)
    found = small(profile)
    assert found.cameras.keys() == profile.cameras.keys()
    for camera, before in profile.cameras.items():
        now = found.cameras[camera]
        assert (2 * now.width, 2 * now.height) == (before.width, before.height)
        assert now.rate_hz < before.rate_hz
        assert now.source == before.source
    assert found.timing.state_hz < profile.timing.state_hz
    assert found.timing.command_hz < profile.timing.command_hz


def test_a_computer_that_keeps_up_says_nothing() -> None:
    assert Capacity(8, 6.0).enough
    assert not Capacity(8, 6.0).said()


def test_one_that_does_not_says_what_gives_way_or_what_to_do() -> None:
    assert "1.9 of 2 cores" in Capacity(2, 1.9).said()
    assert "100 Hz" in Capacity(2, 1.9).said()
    assert "end other programs" in Capacity(2, 0.3).said()


def test_time_of_idle_and_of_low_priority_is_free() -> None:
    # user, nice, system, idle, iowait, irq, softirq, steal
    assert idle_share([0] * 8, [50, 10, 10, 20, 10, 0, 0, 0]) == pytest.approx(0.4)


def test_this_computer_is_measured() -> None:
    found = measure_capacity()
    assert 0.0 <= found.free <= found.cores
