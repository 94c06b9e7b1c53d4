"""Tests against franka-sim: skipped where its environment or franky is missing."""

from __future__ import annotations

import importlib.util
import os

import pytest
from franka_rig import VARIABLE


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    missing = VARIABLE not in os.environ or importlib.util.find_spec("franky") is None
    for item in items:
        if item.path.parent.name == "franka":
            item.add_marker(pytest.mark.franka)
            item.add_marker(pytest.mark.realtime)
            if missing:
                item.add_marker(pytest.mark.skip(reason="needs make test-franka"))
