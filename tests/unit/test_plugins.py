"""Plug-ins of a third party: those of docs/how-to/plugins.md, and broken ones."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from driver_report import Report
from foreign_packages import install, write_page

from vla_zenoh import plugins
from vla_zenoh.errors import PluginError, ProfileError
from vla_zenoh.lab.doctor.plugins import installed_plugins, robot_driver
from vla_zenoh.lab.profile.check import check_profile
from vla_zenoh.profile import load_profile, read_profile, to_yaml
from vla_zenoh.robots.python_driver import PythonDriver
from vla_zenoh.types.records import JointReference

BROKEN = """\
[project]
name = "broken-robot"
version = "1.0"
[project.entry-points."vla_zenoh.robots"]
absent = "no_such_module:PLUGIN"
wrong = "json:dumps"
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """With the files of the page; its packages are installed."""
    write_page(tmp_path)
    before = set(sys.modules)
    for project in tmp_path.glob("*/pyproject.toml"):
        monkeypatch.syspath_prepend(str(project.parent))
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("acme_"):
            del sys.modules[name]


@pytest.fixture
def broken(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package beside, neither of whose robots can be imported."""
    package = folder / "broken"
    package.mkdir()
    (package / "pyproject.toml").write_text(BROKEN, "utf-8")
    install(package / "pyproject.toml")
    monkeypatch.syspath_prepend(str(package))
    return folder


def edited(folder: Path, before: str, after: str) -> str:
    """The profile of the page with a change."""
    text = (folder / "acme.yaml").read_text("utf-8")
    assert before in text
    path = folder / "edited.yaml"
    path.write_text(text.replace(before, after), "utf-8")
    return str(path)


# -- a robot ----------------------------------------------------------------------------------
def test_a_robot_of_a_package_goes_where_it_is_commanded(folder: Path) -> None:
    profile = load_profile(str(folder / "acme.yaml"))
    driver = PythonDriver(profile)
    Report(driver)
    driver.connect()
    first = driver.read(0)
    assert first is not None
    wanted_rad = np.array(profile.robot.home_rad) + 0.1
    driver.move(JointReference(wanted_rad, np.zeros(7), np.zeros(7)), 0)
    second = driver.read(0)
    assert second is not None
    assert np.allclose(second.joints.position_rad - first.joints.position_rad, 0.1)


def test_its_options_are_checked_with_file_and_line_like_ours(folder: Path) -> None:
    with pytest.raises(ProfileError) as caught:
        load_profile(edited(folder, "{address: 10.0.0.7}", "{adress: 10.0.0.7, gain: 20.0}"))
    lines = str(caught.value).replace(f"{folder}/", "").splitlines()
    assert sorted(lines) == [
        "edited.yaml:3: acme.address: is missing",
        "edited.yaml:3: acme.adress: unknown key; did you mean 'address'? "
        "Known here: address, gain",
        "edited.yaml:3: acme.gain: must be at most 10 (given: 20.0)",
    ]


def test_its_section_may_not_be_missing_if_it_needs_an_option(folder: Path) -> None:
    with pytest.raises(ProfileError, match=r"acme: is missing: .* Give acme: \{address: \.\.\.\}"):
        load_profile(edited(folder, "acme: {address: 10.0.0.7}\n", ""))


def test_a_command_that_it_does_not_take_is_a_fault(folder: Path) -> None:
    with pytest.raises(ProfileError, match=r"robot.command: must be joint: robot.driver is acme"):
        load_profile(edited(folder, "command: joint", "command: pose"))


def test_a_profile_with_it_is_the_same_once_written_and_read(folder: Path) -> None:
    profile = load_profile(str(folder / "acme.yaml"))
    again = read_profile(to_yaml(profile), "again")
    assert again == profile
    assert again.driver_options == profile.driver_options
    assert again.driver_options.address == "10.0.0.7"


def test_its_profile_passes_the_check_and_the_doctor_asks_it(folder: Path) -> None:
    report = check_profile(str(folder / "acme.yaml"))
    assert report.errors == []
    (finding,) = robot_driver(load_profile(str(folder / "acme.yaml")), None)
    assert finding.found == "controller at 10.0.0.7"


# -- not installed ----------------------------------------------------------------------------
def test_a_computer_without_the_package_loads_the_profile_and_says_what_the_node_lacks(
    tmp_path: Path,
) -> None:
    write_page(tmp_path)
    path = str(tmp_path / "acme.yaml")
    assert load_profile(path).robot.node == "arm"
    (error,) = check_profile(path).errors
    assert "acme.yaml:2: robot.driver: no robot driver 'acme' is installed. Installed: " in error
    assert "docs/how-to/plugins.md" in error
    with pytest.raises(PluginError, match="no robot driver 'acme' is installed"):
        PythonDriver(load_profile(path))


def test_a_section_of_no_driver_stays_an_unknown_key(folder: Path) -> None:
    with pytest.raises(ProfileError, match=r"acne: unknown key; did you mean 'acme'\? Known here"):
        load_profile(edited(folder, "acme: {address", "acme: {address: x}\nacne: {address"))


# -- broken -----------------------------------------------------------------------------------
def test_a_package_that_cannot_be_imported_is_named_and_stops_no_other(broken: Path) -> None:
    assert load_profile(str(broken / "acme.yaml")).driver_options.address == "10.0.0.7"
    with pytest.raises(PluginError, match="'absent' of broken-robot cannot be imported: Mod"):
        plugins.load(plugins.ROBOTS, "absent")
    with pytest.raises(PluginError, match=r"json:dumps is of type function, wanted a vla_zenoh"):
        plugins.load(plugins.ROBOTS, "wrong")
    with pytest.raises(ProfileError, match=r"robot.driver: .*'absent' of broken-robot cannot be"):
        load_profile(edited(broken, "driver: acme", "driver: absent"))


def test_the_doctor_lists_all_and_says_why_one_is_broken(broken: Path) -> None:
    findings = [one for one in installed_plugins() if one.name == "plug-ins: robot drivers"]
    assert [one.level for one in findings] == ["ok", "warn", "warn"]
    assert "acme" in findings[0].found
    assert "absent" not in findings[0].found
    assert "no_such_module" in findings[1].found


def test_two_packages_with_one_name_are_told_apart_by_no_guess(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = tmp_path_factory.mktemp("other") / "pyproject.toml"
    project.write_text(BROKEN.replace("absent =", "acme ="), "utf-8")
    install(project)
    monkeypatch.syspath_prepend(str(project.parent))
    with pytest.raises(PluginError, match=r"both bring 'acme' of vla_zenoh.robots: uninstall one"):
        plugins.load(plugins.ROBOTS, "acme")


def test_a_check_that_fails_itself_is_a_fault_by_name(folder: Path) -> None:
    def fails(profile: object, options: object) -> list[plugins.Fault]:
        raise RuntimeError("oops")

    ((place, why),) = plugins.faults_of("acme", fails, None, None)
    assert place == ("robot", "driver")
    assert why == "the check of acme itself failed: RuntimeError: oops"
