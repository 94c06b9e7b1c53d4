"""Some rows of `make bench-faults`: every brake in time, and back without a person."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from netns.faults import catalogue
from netns.lab import needs_namespaces
from netns.stage import Stage, stage

pytestmark = [pytest.mark.netns, pytest.mark.slow, needs_namespaces, pytest.mark.timeout(300)]

FAULTS = {fault.name: fault for fault in catalogue()}


@pytest.fixture(scope="module")
def lab() -> Iterator[Stage]:
    with stage("lab") as built:
        yield built


@pytest.mark.parametrize("name", ["loss-2", "cut-0.5", "cut-5", "router-killed"])
def test_a_fault_of_the_network_breaks_no_promise(lab: Stage, name: str) -> None:
    row = lab.suffer(FAULTS[name])
    assert row.wrong == [], row


def test_an_arm_whose_link_is_dead_for_long_stands_until_a_person_activates_it(lab: Stage) -> None:
    row = lab.suffer(FAULTS["cut-5"])
    assert row.activated
    assert row.stood_s is not None


def test_every_fault_has_a_name_of_its_own() -> None:
    assert len(FAULTS) == len(list(catalogue()))
