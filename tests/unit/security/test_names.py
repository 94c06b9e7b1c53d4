"""Names that changed: who has rights after a certificate was revoked, and what makes no sense."""

from __future__ import annotations

from pathlib import Path

import pytest
from access_check import Passage, allows
from vla_zenoh_secure.lab_certificates import next_generation, renamed

from vla_zenoh.errors import SecurityError
from vla_zenoh.profile import load_profile
from vla_zenoh.security.names import NAMES, UNCHANGED, Names, read_names
from vla_zenoh.security.roles import access_control


def test_the_old_name_of_a_revoked_host_has_no_right_and_the_new_one_all_of_them() -> None:
    lab = load_profile("panda_sim_two_hosts")
    chunk = Passage("ingress", "put", lab.keys.delta("scripted"))
    rules = access_control([lab])
    assert allows(rules, "worker-scripted@gpu", chunk)
    assert not allows(rules, "worker-scripted@gpu+2", chunk)
    rules = access_control([lab], next_generation(UNCHANGED, "gpu"))
    assert not allows(rules, "worker-scripted@gpu", chunk)
    assert allows(rules, "worker-scripted@gpu+2", chunk)
    # Others keep their names.
    assert allows(rules, "command@robot", Passage("ingress", "put", lab.keys.command_pose))


def test_names_without_a_file_are_unchanged(tmp_path: Path) -> None:
    assert read_names(tmp_path) == Names()
    assert Names().current("operator@desk") == "operator@desk"


@pytest.mark.parametrize("text", ['{"revision": 1, "gener', "[]", '{"generations": {"gpu": "b"}}'])
def test_a_file_that_is_none_of_ours_makes_no_name_valid(tmp_path: Path, text: str) -> None:
    (tmp_path / NAMES).write_text(text)
    with pytest.raises(SecurityError, match=r"names\.json cannot be read: .* Copy it from"):
        read_names(tmp_path)


def test_a_host_that_is_revoked_again_never_gets_an_older_name() -> None:
    names = next_generation(next_generation(UNCHANGED, "gpu"), "gpu")
    assert names.current("worker-scripted@gpu") == "worker-scripted@gpu+3"
    assert names.revision == 2


def test_a_robot_that_is_renamed_twice_goes_by_its_last_name_alone() -> None:
    names = renamed(renamed(UNCHANGED, "panda", "left"), "left", "right")
    assert names.robots == {"panda": "right", "left": "right"}
    # And back: the name is in use again.
    assert renamed(names, "right", "panda").robots == {"left": "panda", "right": "panda"}


def test_a_robot_that_was_renamed_and_retired_has_neither_name() -> None:
    names = renamed(renamed(UNCHANGED, "panda", "left"), "left", None)
    assert names.robots == {"panda": None, "left": None}
