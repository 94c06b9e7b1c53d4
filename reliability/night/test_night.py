"""A short night: one episode of each task and model, nodes killed, and one power cut."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from night import Night, examine

pytestmark = pytest.mark.slow


def test_a_night_with_kills_and_a_power_cut_counts_every_episode_once(tmp_path: Path) -> None:
    night = Night(tmp_path / "night", 2, random.Random(1), kill_s=(6.0, 10.0))
    night.prepare()
    result, wrong = examine(night, night.run(600.0))
    assert not wrong, result
    assert result["killed"]["power"] == 1
    assert result["rates"] == {
        "rises": {"scripted": 1.0, "twin": 1.0},
        "stays_low": {"scripted": 0.0, "twin": 0.0},
    }
