"""Tests against others' packages: skipped where their environments are missing."""

from __future__ import annotations

import os

import pytest
from physicalai_rig import VARIABLE


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.parent.name == "rivals":
            item.add_marker(pytest.mark.rivals)
            item.add_marker(pytest.mark.realtime)
            if VARIABLE not in os.environ:
                item.add_marker(pytest.mark.skip(reason="needs make test-rivals"))
