"""Whose certificate people show at a computer that has those of several hosts."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import pytest
from vla_zenoh_secure.lab_certificates import LabCertificates

from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.security.roles import Identity, Role, identities_of, operator_identities
from vla_zenoh.security.store import local_role, operator_hosts

NOW = dt.datetime(2026, 3, 1, 12, tzinfo=dt.UTC)
HOSTS = {"robot": {"nodes": ["router", "sim", "command"]}, "gpu": {"nodes": ["worker"]}}
PEOPLE = {"desk": "operator", "wall": "viewer", "stage": "replay"}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> LabCertificates:
    """As `secure init` leaves it: certificates of robot and gpu, and those of three more."""
    store = LabCertificates(tmp_path_factory.mktemp("lab"))
    store.make_authority("test lab", NOW)
    lab = profile(store, PEOPLE)
    store.add([one for host in (*lab.hosts, *PEOPLE) for one in identities_of(lab, host)], NOW)
    store.add(operator_identities("attic", Role.OPERATOR), NOW)
    return store


def profile(store: LabCertificates, people: dict[str, str], host: str | None = None) -> Profile:
    security = {"folder": str(store.folder), "people": people, "host": host}
    endpoints = ["tls/10.0.0.2:7447"]
    session = {"listen": endpoints, "connect": endpoints, "security": security}
    return override(load_profile("panda_sim"), {"session": session, "hosts": HOSTS})


def only(store: LabCertificates, folder: Path, *hosts: str) -> LabCertificates:
    """A computer that has the folders of these alone."""
    folder.mkdir()
    for host in hosts:
        (folder / host).symlink_to(store.folder / host)
    return LabCertificates(folder)


def test_where_nobody_said_which_host_it_is_an_operator_goes_before_a_viewer(
    made: LabCertificates,
) -> None:
    assert operator_hosts(profile(made, {})) == ["robot", "gpu"]
    assert operator_hosts(profile(made, {"wall": "viewer"})) == ["robot", "gpu", "wall"]
    assert operator_hosts(profile(made, {"desk": "operator"})) == ["robot", "desk", "gpu"]


def test_whom_the_profile_does_not_name_and_who_plays_recordings_are_never_chosen(
    made: LabCertificates,
) -> None:
    found = operator_hosts(profile(made, PEOPLE))
    assert "attic" not in found
    assert "stage" not in found


def test_the_host_that_was_noted_goes_before_all_others_but_a_viewer_not_for_a_stop(
    made: LabCertificates, tmp_path: Path
) -> None:
    here = only(made, tmp_path / "here", "robot", "gpu", "desk")
    here.remember_host("gpu")
    lab = profile(here, {"desk": "operator"})
    assert operator_hosts(lab) == ["gpu", "robot", "desk"]
    assert operator_hosts(lab, stop=True) == ["robot", "desk", "gpu"]
    here.remember_host("desk")
    assert operator_hosts(lab, stop=True) == ["desk", "robot", "gpu"]


def test_who_says_which_host_it_is_is_obeyed_and_can_stop_as_anybody_here(
    made: LabCertificates,
) -> None:
    lab = profile(made, PEOPLE, host="wall")
    assert operator_hosts(lab) == ["wall"]
    assert operator_hosts(lab, stop=True) == ["robot", "desk", "wall", "gpu"]


def test_a_computer_with_one_folder_uses_that_also_when_its_profile_is_an_old_one(
    made: LabCertificates, tmp_path: Path
) -> None:
    attic = only(made, tmp_path / "attic", "attic")
    assert operator_hosts(profile(attic, {})) == ["attic"]


def test_without_certificates_there_is_nobody_to_choose(tmp_path: Path) -> None:
    assert operator_hosts(profile(LabCertificates(tmp_path), {})) == []
    assert operator_hosts(load_profile("panda_sim")) == []


@pytest.mark.parametrize(
    ("host", "role"), [("desk", Role.OPERATOR), ("gpu", Role.VIEWER), ("stage", Role.REPLAY)]
)
def test_what_people_here_may_do_is_told_by_their_certificate(
    made: LabCertificates, host: str, role: Role
) -> None:
    assert local_role(profile(made, PEOPLE, host=host)) is role


def test_where_nobody_knows_what_people_may_do_nothing_is_said(made: LabCertificates) -> None:
    assert local_role(profile(made, PEOPLE)) is None
    assert local_role(load_profile("panda_sim")) is None


def test_a_half_of_a_pair_is_none(made: LabCertificates, tmp_path: Path) -> None:
    folder = tmp_path / "half"
    store = LabCertificates(folder)
    store.make_authority("test lab", NOW)
    store.add([Identity(Role.OPERATOR, "operator", "robot")], NOW)
    store.add([Identity(Role.VIEWER, "viewer", "gpu")], NOW)
    store.files("robot", "operator").key.unlink()
    assert operator_hosts(profile(store, {})) == ["gpu"]
