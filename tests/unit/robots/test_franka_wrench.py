"""The wrench of a Franka arm, which reports what it exerts, and zeros where it does not know."""

from __future__ import annotations

import numpy as np
import pytest
from vla_zenoh_franka.arm import external_wrench

from vla_zenoh.control.contact import Contact
from vla_zenoh.profile import ContactLimits
from vla_zenoh.types import Header, PoseState, Stamped

PRESSES_DOWN = (0.0, 0.0, -30.0, 0.5, 0.0, 0.0)
"""As the robot reports that it presses on a table."""
SINGULAR = (0.0,) * 6


def test_a_table_pushes_an_arm_upwards_that_presses_on_it() -> None:
    wrench = external_wrench(PRESSES_DOWN)
    assert wrench is not None
    assert wrench == pytest.approx([0.0, 0.0, 30.0, -0.5, 0.0, 0.0])


def test_near_a_singularity_the_force_is_lost_and_not_zero() -> None:
    contact = Contact(ContactLimits())
    for number, reported in enumerate([PRESSES_DOWN] * 20 + [SINGULAR]):
        stamp_ns = number * 5_000_000
        wrench = external_wrench(reported)
        pose = PoseState(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(6), wrench)
        contact.update_pose(Stamped(Header(stamp_ns, number, "arm-1"), pose, stamp_ns))
        if number == 0:
            contact.begin()
            assert not contact.lost
    assert "no longer measures contact_force" in contact.lost
