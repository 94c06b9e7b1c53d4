"""Which nodes a host starts, and how."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_zenoh.errors import ProfileError
from vla_zenoh.nodes.launch import START_ORDER, node_commands
from vla_zenoh.nodes.supervisor import STOP_ORDER
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.profile.schema import NODE_KINDS

FILE = Path("mine.yaml")
OTHERS = (Path("left.yaml"), Path("right.yaml"))


def words_of(profile: Profile, host: str, kind: str, *also: Path) -> tuple[str, ...]:
    """The command line of the only node of a kind."""
    found = node_commands(profile, host, FILE, also_files=also)
    (words,) = [each.arguments for each in found if each.kind == kind]
    return words


def test_every_kind_of_node_has_its_turn_to_start_and_to_end() -> None:
    assert sorted(START_ORDER) == sorted(NODE_KINDS)
    assert sorted(kind for kinds, _ in STOP_ORDER for kind in kinds) == sorted(NODE_KINDS)


def test_the_router_is_told_of_every_robot_it_serves() -> None:
    words = words_of(load_profile("panda_sim_lab"), "robot", "router", *OTHERS)
    assert words[-4:] == ("--also", "left.yaml", "--also", "right.yaml")


def test_no_other_node_is_told_of_other_robots() -> None:
    profile = load_profile("panda_sim_lab")
    alone, among = (node_commands(profile, "robot", FILE, also_files=f) for f in ((), OTHERS))
    assert [c for c in among if c.kind != "router"] == [c for c in alone if c.kind != "router"]


def test_a_host_without_a_router_cannot_serve_other_robots_and_says_who_can() -> None:
    with pytest.raises(ProfileError, match=r"'gpu'.*no router.*; robot does"):
        node_commands(load_profile("panda_sim_lab"), "gpu", FILE, also_files=OTHERS)


def test_a_dry_run_is_for_the_command_node_alone() -> None:
    profile = load_profile("panda_sim")
    wet, dry = (node_commands(profile, "here", FILE, dry_run=dry) for dry in (False, True))
    for before, after in zip(wet, dry, strict=True):
        more = ("--dry-run",) if after.kind == "command" else ()
        assert after.arguments == (*before.arguments, *more)


def test_a_dry_run_where_nothing_commands_is_refused() -> None:
    with pytest.raises(ProfileError, match=r"'gpu'.*no command node"):
        node_commands(load_profile("panda_sim_lab"), "gpu", FILE, dry_run=True)
