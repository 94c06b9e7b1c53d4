"""Tests against others' packages: skipped where their environments are missing."""

from __future__ import annotations

import os

import franka_node_rig
import physicalai_rig
import pytest
import r2c_rig
import ray_rig
import strands_rig
import trossen_rig

NEEDS = {
    "test_physicalai": physicalai_rig.VARIABLE,
    "test_franka_node": franka_node_rig.VARIABLE,
    "test_r2c": r2c_rig.VARIABLE,
    "test_strands": strands_rig.VARIABLE,
    "test_inspect": "INSPECT_PYTHON",
    "test_ray_serve": ray_rig.VARIABLE,
    "test_trossen": trossen_rig.VARIABLE,
}
"""Beginning of a file's name -> environment variable."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.parent.name != "rivals":
            continue
        item.add_marker(pytest.mark.rivals)
        item.add_marker(pytest.mark.realtime)
        (needed,) = (name for file, name in NEEDS.items() if item.path.name.startswith(file))
        if needed not in os.environ:
            item.add_marker(pytest.mark.skip(reason="needs make test-rivals"))
