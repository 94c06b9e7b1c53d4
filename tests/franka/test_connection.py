"""An arm that does not answer."""

from __future__ import annotations

from pathlib import Path

import pytest
from vla_zenoh_franka.check import fci_arm

from vla_zenoh.errors import NodeError
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.robots.python_driver import PythonDriver

NOBODY = "127.0.0.9"


@pytest.fixture
def profile(tmp_path: Path) -> Profile:
    path = tmp_path / "lab.yaml"
    path.write_text(f"extends: fr3\nfranka: {{address: {NOBODY}, realtime: ignore}}\n")
    return load_profile(str(path))


def test_the_node_ends_with_what_to_look_at(profile: Profile) -> None:
    with pytest.raises(NodeError, match=r"franka: connect: 127\.0\.0\.9: .*is FCI activated"):
        PythonDriver(profile).connect()


def test_the_check_says_so(profile: Profile) -> None:
    (finding,) = fci_arm(profile, profile.driver_options)
    assert (finding.name, finding.level) == ("connection", "fail")
    assert NOBODY in finding.found
