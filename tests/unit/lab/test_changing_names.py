"""``secure revoke``, ``retire`` and ``rename``: what they write, and what they refuse."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner
from vla_zenoh_secure.secure_profile import with_robot_name, without_operator

from vla_zenoh.errors import SecurityError
from vla_zenoh.profile import load_profile
from vla_zenoh.program.main import app
from vla_zenoh.security import certificates
from vla_zenoh.security.names import read_names

LAB = "panda_sim_two_hosts_secure.yaml"
runner = CliRunner()


@pytest.fixture
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The certificates of a lab with a model's host and a person's computer."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "keys"
    init = ("init", "--profile", "panda_sim_two_hosts", "--folder", str(folder))
    assert secure(*init, "--host", "robot").exit_code == 0
    assert secure("add", "desk", "--role", "operator", "--profile", LAB).exit_code == 0
    return folder


def secure(*words: str) -> Result:
    return runner.invoke(app, ["secure", *words])


def change(*words: str) -> dict[str, Any]:
    done = secure(*words, "--profile", LAB, "--wait", "0", "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def said(done: Result) -> str:
    return f"{done.output} {done.exception}"


def common_name(file: Path) -> str:
    return certificates.read(file.read_bytes()).common_name


def test_a_revoked_host_gets_certificates_of_a_new_name(keys: Path) -> None:
    before = (keys / "gpu" / "worker-scripted.key").read_bytes()
    answer = change("revoke", "gpu")
    assert answer["denied"] == ["viewer@gpu", "worker-scripted@gpu"]
    assert answer["in_force_after_s"] == {}
    assert common_name(keys / "gpu" / "worker-scripted.pem") == "worker-scripted@gpu+2"
    assert (keys / "gpu" / "worker-scripted.key").read_bytes() != before
    assert common_name(keys / "desk" / "operator.pem") == "operator@desk"
    # Every host's folder has the names, and the revoked one is to be copied whole.
    assert read_names(keys) == read_names(keys / "robot") == read_names(keys / "gpu")
    assert any(line.startswith(f"scp -rp {keys}/gpu gpu:") for line in answer["copy"])
    shown = secure("show", "--profile", LAB, "--json")
    assert shown.exit_code == 0, shown.output
    assert change("revoke", "gpu")["denied"] == ["viewer@gpu+2", "worker-scripted@gpu+2"]
    assert common_name(keys / "gpu" / "worker-scripted.pem") == "worker-scripted@gpu+3"


def test_the_old_certificates_of_a_revoked_host_are_shown_as_what_they_are(keys: Path) -> None:
    old = (keys / "gpu" / "viewer.pem").read_bytes()
    change("revoke", "gpu")
    (keys / "gpu" / "viewer.pem").write_bytes(old)
    shown = secure("show", "--profile", LAB)
    assert shown.exit_code == 1
    assert "is about 'viewer@gpu', and 'viewer@gpu+2' has the rights" in shown.output


def test_a_lower_role_takes_the_old_keys_with_it(keys: Path) -> None:
    secure("add", "desk", "--role", "viewer", "--profile", LAB)
    change("revoke", "desk")
    assert [path.name for path in sorted((keys / "desk").iterdir())] == [
        "ca.pem",
        "names.json",
        "viewer.key",
        "viewer.pem",
    ]


def test_a_new_host_gets_the_name_that_is_in_force(keys: Path) -> None:
    change("retire", "desk")
    assert not (keys / "desk").exists()
    security = load_profile(LAB).session.security
    assert security is not None
    assert security.people == {}
    assert secure("add", "desk", "--role", "operator", "--profile", LAB).exit_code == 0
    assert common_name(keys / "desk" / "operator.pem") == "operator@desk+2"
    assert read_names(keys / "desk") == read_names(keys)


def test_where_the_router_is_elsewhere_its_names_are_copied_first(keys: Path) -> None:
    (keys / ".this_host").write_text("desk\n")
    done = secure("revoke", "gpu", "--profile", LAB, "--wait", "0")
    lines = done.output.splitlines()
    first = lines.index(f"  scp {keys}/robot/names.json robot:{keys}/robot/")
    assert first < lines.index(f"  scp -rp {keys}/gpu gpu:{keys}/")


def test_who_has_a_router_s_key_can_still_pose_as_it(keys: Path) -> None:
    done = secure("revoke", "robot", "--profile", LAB, "--wait", "0")
    assert done.exit_code == 0, done.output
    assert "who has its key can still pose as it" in done.output
    assert "can still pose" not in secure("revoke", "gpu", "--profile", LAB, "--wait", "0").output


def test_a_robot_is_renamed_in_its_profile(keys: Path) -> None:
    answer = change("rename", "panda", "left")
    assert load_profile(LAB).robot.name == "left"
    assert read_names(keys / "robot").robots == {"panda": "left"}
    assert f"scp {LAB} gpu:" in answer["copy"]
    assert f"scp {LAB} desk:" in answer["copy"]
    change("rename", "left", "right")
    assert load_profile(LAB).robot.name == "right"
    assert read_names(keys).robots == {"panda": "right", "left": "right"}


def test_a_robot_is_retired_by_its_name(keys: Path) -> None:
    done = secure("retire", "--robot", "panda", "--profile", LAB)
    assert done.exit_code == 0, done.output
    assert "Its hosts keep their certificates: gpu, robot." in done.output
    assert read_names(keys / "robot").robots == {"panda": None}
    assert "robot panda was retired: routers" in secure("show", "--profile", LAB).output


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("revoke gpi", "knows no host 'gpi'"),
        ("retire desc", "knows 'desc'; did you mean 'desk'?"),
        ("retire robot", "this computer is robot: retire it from another one"),
        ("retire", "name a host, or a robot with --robot"),
        ("retire desk --robot panda", "name a host, or a robot with --robot"),
        ("retire --robot ur5e", "the robot of profile panda_sim_two_hosts_secure is panda, not"),
        ("rename ur5e left", "is panda, not ur5e: give the profile of the one you mean"),
        ("rename panda panda", "the robot is called panda already"),
        ("rename panda a/b", "cannot be part of a key"),
    ],
)
def test_what_makes_no_sense_is_refused_and_changes_nothing(
    keys: Path, words: str, why: str
) -> None:
    before = Path(LAB).read_text()
    done = secure(*words.split(), "--profile", LAB, "--wait", "0")
    assert done.exit_code != 0
    assert why in " ".join(said(done).split())
    assert read_names(keys).revision == 0
    assert Path(LAB).read_text() == before


@pytest.mark.parametrize("words", ["revoke gpu", "retire desk", "rename panda left"])
def test_names_change_where_the_authority_is_and_nowhere_else(keys: Path, words: str) -> None:
    (keys / "ca.key").rename(keys.parent / "elsewhere.key")
    before = Path(LAB).read_text(), sorted(keys.rglob("*"))
    done = secure(*words.split(), "--profile", LAB, "--wait", "0")
    assert done.exit_code == 1
    assert "certificates are made on the computer where" in said(done)
    assert (Path(LAB).read_text(), sorted(keys.rglob("*"))) == before
    assert not list(Path().glob("*.part*"))


@pytest.mark.parametrize("words", ["revoke here", "retire here", "rename panda left"])
def test_a_profile_without_certificates_has_none_to_change(words: str) -> None:
    done = secure(*words.split(), "--profile", "panda_sim")
    assert done.exit_code == 1
    assert "is not secured: run `vla-zenoh secure init` first" in done.output


# -- the text of the profile ------------------------------------------------------------------
@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("a: 1\n", "a: 1\nrobot:\n  name: left\n"),
        ("robot:\n  name: panda  # ours\na: 1\n", "robot:\n  name: left\na: 1\n"),
        ("robot:\n  # the\n  driver: sim\n", "robot:\n  name: left\n  # the\n  driver: sim\n"),
        ("robot:\n\n  driver: sim\n  name: b\n", "robot:\n\n  driver: sim\n  name: left\n"),
        (
            "robot:\n  driver: sim\nb:\n  name: c\n",
            "robot:\n  name: left\n  driver: sim\nb:\n  name: c\n",
        ),
    ],
)
def test_the_name_of_the_robot_is_written_where_it_belongs(text: str, wanted: str) -> None:
    assert with_robot_name(text, "left") == wanted


def test_a_robot_in_one_line_is_left_to_a_person() -> None:
    with pytest.raises(SecurityError, match="Write by hand:\nrobot:\n  name: left"):
        with_robot_name("robot: {driver: sim}\n", "left")


def test_people_leave_the_profile_one_by_one() -> None:
    text = "session:\n  security:\n    people:\n      desk: operator\n      wall: viewer\nrest: 1\n"
    one = without_operator(text, "desk")
    assert one == text.replace("      desk: operator\n", "")
    assert without_operator(one, "wall") == "session:\n  security:\n    people: {}\nrest: 1\n"
    assert without_operator(text, "attic") == text
