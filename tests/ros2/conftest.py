"""What the tests with a real bridge share, and why they are skipped where it is missing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from rig import Lab

# Imports of what needs cyclonedds stand inside: the tests say by themselves why they are skipped.


@pytest.fixture(scope="session")
def bridge_program() -> Path:
    """The bridge, or the reason why this test is skipped."""
    from bridge import load_script

    program = load_script().find_bridge()
    if program is None:
        pytest.skip("no zenoh-bridge-ros2dds: neither on PATH nor built (make ros2-bridge)")
    return program


@pytest.fixture(scope="module")
def shared_lab(tmp_path_factory: pytest.TempPathFactory, bridge_program: Path) -> Iterator[Lab]:
    """One lab for all tests of a file; take `lab` instead, which begins in order."""
    from rig import running_lab

    with running_lab(tmp_path_factory.mktemp("lab"), bridge_program) as lab:
        lab.chain.activate_when_ready()
        yield lab


@pytest.fixture
def lab(shared_lab: Lab) -> Lab:
    """The file's lab: inactive, the arm stands, nothing recorded, no event unread."""
    shared_lab.settle()
    return shared_lab
