"""Plug-ins of a third party: those of docs/how-to/plugins.md, and broken ones."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import threading
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from driver_report import Report
from foreign_packages import install, write_page

from vla_zenoh import plugins, resources
from vla_zenoh.errors import NodeError, PluginError, ProfileError
from vla_zenoh.lab.check.examination import Examination
from vla_zenoh.lab.check.model_runner import ModelRunner
from vla_zenoh.lab.doctor.plugins import installed_plugins, robot_drivers
from vla_zenoh.lab.profile.check import check_profile
from vla_zenoh.nodes.camera.node import make_source
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile, read_profile, to_yaml
from vla_zenoh.program.main import COMMANDS
from vla_zenoh.robots.python_driver import PythonDriver
from vla_zenoh.types.records import JointReference

UV = Path(sys.executable).with_name("uv")
PATIENCE_S, RUNS = 20.0, 3
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
    monkeypatch.syspath_prepend(str(tmp_path / "acme"))
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("acme_lab"):
            del sys.modules[name]


def test_the_folder_of_the_package_is_called_as_the_build_expects(folder: Path) -> None:
    """By the name of the project hatchling finds what to ship."""
    project = tomllib.loads((folder / "acme" / "pyproject.toml").read_text())["project"]
    assert (folder / "acme" / project["name"].replace("-", "_") / "__init__.py").is_file()


@pytest.fixture
def broken(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package beside, neither of whose robots can be imported."""
    package = folder / "broken"
    package.mkdir()
    (package / "pyproject.toml").write_text(BROKEN, "utf-8")
    install(package / "pyproject.toml")
    monkeypatch.syspath_prepend(str(package))
    return folder


def started(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command where the packages of the page are installed."""
    path = os.pathsep.join([str(folder / "acme"), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, "-m", "vla_zenoh", *words],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )


def vla_zenoh(folder: Path, *words: str) -> str:
    """What a command prints there."""
    done = started(folder, *words)
    assert done.returncode == 0, done.stderr
    return done.stdout


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
    (finding,) = robot_drivers(load_profile(str(folder / "acme.yaml")), None)
    assert finding.found == "controller at 10.0.0.7"


# -- a camera, a model ------------------------------------------------------------------------
def test_a_camera_of_a_package_delivers_images_at_its_rate(folder: Path) -> None:
    camera = load_profile(str(folder / "acme.yaml")).cameras["front"]
    source = make_source(camera)
    source.open()
    grabbed_ns = [source.grab(threading.Event()) for _ in range(3)]
    image = source.retrieve()
    source.close()
    assert image is not None
    assert image.shape == (camera.height, camera.width, 3)
    assert all(ns is not None for ns in grabbed_ns)
    assert not camera.from_ros2


def test_what_a_camera_cannot_do_is_a_fault_like_ours(folder: Path) -> None:
    with pytest.raises(ProfileError, match=r"depth_unit_m: is set, and acme: measures no depth"):
        load_profile(edited(folder, '"acme:1234"', '"acme:1234", depth_unit_m: 0.001'))
    with pytest.raises(ProfileError, match=r"'acme:' is not a camera: write one of acme:SERIAL, "):
        load_profile(edited(folder, "acme:1234", "acme:"))
    load_profile(edited(folder, '"acme:1234"', '"acme:1234", flip: both'))


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("raise OSError('no bus')", "'acme:1234' cannot be made: OSError: no bus"),
        ("return object()", "'acme:1234': object is no vla_zenoh.nodes.camera.source.Source"),
    ],
)
def test_a_camera_that_cannot_be_made_is_named(folder: Path, body: str, said: str) -> None:
    file = folder / "acme" / "acme_lab" / "camera.py"
    file.write_text(f"def AcmeCamera(serial, profile):\n    {body}\n", "utf-8")
    with pytest.raises(NodeError) as caught:
        make_source(load_profile(str(folder / "acme.yaml")).cameras["front"])
    assert str(caught.value) == said


def test_a_check_of_a_camera_that_fails_itself_is_a_fault_by_name(folder: Path) -> None:
    file = folder / "acme" / "acme_lab" / "__init__.py"
    text = file.read_text("utf-8").replace("has_lens=True", "check=lambda text: 1 / 0")
    file.write_text(text, "utf-8")
    with pytest.raises(ProfileError, match=r"source: 'acme:1234' cannot be checked: .* of acme"):
        load_profile(str(folder / "acme.yaml"))


def test_a_driver_that_needs_an_environment_of_its_own_is_installed_there() -> None:
    words = plugins.how_to_repeat("vla-zenoh-lerobot")
    assert words[0] in ("--with", "--with-editable")
    assert "vla-zenoh-lerobot" in words[1]


def test_a_model_of_a_package_is_found_by_name_and_keeps_its_contract(folder: Path) -> None:
    model = find_model("acme_nod")
    assert model.name == "acme_nod"
    assert "acme_nod" in resources.names("models")
    profile = load_profile(str(folder / "acme.yaml"))
    report = Examination(
        make_policy(model), "acme_nod", ModelRunner(PATIENCE_S), profile=profile, runs=RUNS
    ).run()
    assert report.ok, report.findings


def test_a_benchmark_of_a_package_lists_its_tasks(folder: Path) -> None:
    about = json.loads(vla_zenoh(folder, "bench", "sim", "acme_tasks", "--list"))
    assert about["suites"] == ["reach"]
    assert [task["name"] for task in about["tasks"]] == ["up"]


# -- commands ---------------------------------------------------------------------------------
@pytest.mark.parametrize("words", [("acme",), ("robot", "acme")], ids=" ".join)
def test_a_command_of_a_package_runs_alone_or_in_a_group(
    folder: Path, words: tuple[str, ...]
) -> None:
    told = vla_zenoh(folder, *words, "--profile", str(folder / "acme.yaml"))
    assert told == f"{load_profile(str(folder / 'acme.yaml')).robot.name}\n"
    assert "Print the name of the robot." in vla_zenoh(folder, *words[:-1], "--help")


def test_a_package_may_have_a_group_of_its_own_and_replaces_no_command_of_ours(
    folder: Path,
) -> None:
    edit_commands(folder, '"stop" = "acme_lab.cli:name"\n"lab.one.two" = "acme_lab.cli:name"')
    asked = "--profile", str(folder / "acme.yaml")
    assert vla_zenoh(folder, "lab", "one", "two", *asked) == "panda\n"
    assert "Print the name" not in vla_zenoh(folder, "stop", "--help")


def test_a_command_that_cannot_be_imported_says_why_whatever_follows_it(folder: Path) -> None:
    edit_commands(folder, '"wave" = "acme_lab.no_such_module:wave"')
    for words in (["wave"], ["wave", "--help"], ["wave", "twice", "--hands=2"]):
        done = started(folder, *words)
        assert done.returncode == 1
        assert "'wave' of acme-lab cannot be imported" in done.stderr
    assert "wave" in vla_zenoh(folder, "--help")


def edit_commands(folder: Path, entries: str) -> None:
    """Let the package declare other commands."""
    project = folder / "acme" / "pyproject.toml"
    before, title, _ = project.read_text("utf-8").partition("vla_zenoh.commands")
    project.write_text(f'{before}{title}"]\n{entries}\n', "utf-8")
    install(project)


PROJECTS = [
    tomllib.loads(file.read_text("utf-8"))["project"]
    for file in (Path(__file__).parents[2] / "plugins").glob("*/pyproject.toml")
]


def test_a_package_that_needs_another_is_installed_with_it() -> None:
    names = {project["name"] for project in PROJECTS}
    needed = {
        project["name"]: names.intersection(project["dependencies"])
        for project in PROJECTS
        if names.intersection(project["dependencies"])
    }
    assert needed == {name: set(others) for name, others in plugins.NEEDED.items()}


def test_the_package_of_every_command_in_plugins_is_known() -> None:
    declared = {}
    for project in PROJECTS:
        commands = project.get("entry-points", {}).get(plugins.COMMANDS.name, {})
        declared |= dict.fromkeys(commands, project["name"])
    assert declared == plugins.PACKAGES
    first = {command.partition(".")[0] for command in declared}
    assert first <= {name for panel in COMMANDS.values() for name in panel}


def test_every_file_of_models_is_declared() -> None:
    files = [path for path in resources.shipped("models").iterdir() if path.name[0] not in "._"]
    assert {path.stem for path in files} == {
        name
        for name, entry in plugins.installed(plugins.MODELS).items()
        if entry.value.startswith("vla_zenoh.shipped")
    }


def test_an_installer_makes_the_packages_plug_ins_known(tmp_path: Path) -> None:
    write_page(tmp_path / "sources")
    for info in (tmp_path / "sources" / "acme").glob("*.dist-info"):
        shutil.rmtree(info)
    target = tmp_path / "installed"
    install_it = ["pip", "install", "--quiet", "--offline", "--no-deps"]
    done = subprocess.run(
        [UV, *install_it, "--target", target, tmp_path / "sources" / "acme"],
        capture_output=True,
        text=True,
        check=False,
    )
    if "hatchling" in done.stderr:
        pytest.skip("needs hatchling in the cache of uv, or an index")
    assert done.returncode == 0, done.stderr
    code = "from vla_zenoh.plugins import *; print([load(group, sorted(installed(group))[0])"
    code += " for group in GROUPS[:4]])"
    told = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(target)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "acme_lab" in told.stdout, told.stderr


# -- not installed ----------------------------------------------------------------------------
def test_a_computer_without_the_package_loads_the_profile_and_says_what_the_node_lacks(
    tmp_path: Path,
) -> None:
    write_page(tmp_path)
    path = str(tmp_path / "acme.yaml")
    assert load_profile(path).robot.node == "arm"
    errors = check_profile(path).errors
    for line, place, what in (
        (2, "robot.driver", "robot driver 'acme' is installed"),
        (4, "cameras.front.source", "camera source 'acme' is installed"),
        (5, "workers", "model called 'acme_nod'"),
    ):
        assert any(f"acme.yaml:{line}: {place}: no {what}" in error for error in errors), errors
    with pytest.raises(PluginError, match=r"no robot driver 'acme' .*docs/how-to/install\.md"):
        PythonDriver(load_profile(path))
    why = rf"no camera source 'acme' is installed.* into {re.escape(sys.prefix)}, the environment"
    with pytest.raises(PluginError, match=why):
        make_source(load_profile(path).cameras["front"])


def test_in_an_environment_of_its_own_a_model_reads_the_profile_and_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_page(tmp_path)
    model = tmp_path / "acme" / "acme_lab" / "nod.py"
    monkeypatch.setenv(plugins.OWN_ENVIRONMENT_VARIABLE, f"acme_nod={model}")
    path = tmp_path / "bare.yaml"
    path.write_text((tmp_path / "acme.yaml").read_text("utf-8").replace("acme: {", "other: {"))
    assert load_profile(str(path)).robot.driver == "acme"
    assert find_model("acme_nod").path == model


def test_a_section_of_no_driver_stays_an_unknown_key(folder: Path) -> None:
    with pytest.raises(ProfileError, match=r"acne: unknown key; did you mean 'acme'\? Known here"):
        load_profile(edited(folder, "acme: {address", "acme: {address: x}\nacne: {address"))


# -- broken -----------------------------------------------------------------------------------
def test_a_package_that_cannot_be_imported_is_named_and_stops_no_other(broken: Path) -> None:
    assert load_profile(str(broken / "acme.yaml")).driver_options.address == "10.0.0.7"
    with pytest.raises(PluginError, match="'absent' of broken-robot cannot be imported: Mod"):
        plugins.load(plugins.ROBOTS, "absent")
    with pytest.raises(PluginError, match=r"json:dumps is of type function, wanted a RobotPlugin"):
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
    with pytest.raises(PluginError, match=r"both bring the robot driver 'acme': uninstall one"):
        plugins.load(plugins.ROBOTS, "acme")
    assert load_profile("panda_sim").driver_options is None


def test_a_check_that_fails_itself_is_a_fault_by_name(folder: Path) -> None:
    def fails(profile: object, options: object) -> list[plugins.Fault]:
        raise RuntimeError("oops")

    ((place, why),) = plugins.faults_of("acme", fails, None, None)
    assert place == ("robot", "driver")
    assert why == "the check of acme itself failed: RuntimeError: oops"
