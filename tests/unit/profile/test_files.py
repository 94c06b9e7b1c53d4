"""What another computer has to have of a profile: all of its files, each where it is looked for."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from vla_zenoh import resources
from vla_zenoh.profile import load_profile
from vla_zenoh.profile.files import FileUse, NeededFiles, needed_files
from vla_zenoh.profile.load import paths_in

MODEL = "class Lift: ...\n"
URDF = """\
<robot name="arm"><link name="a">
  <visual><geometry><mesh filename="package://arm_description/meshes/a.stl"/></geometry></visual>
  <collision><geometry><mesh scale="1 1 1" filename='hand.stl'/></geometry></collision>
  <collision><geometry><mesh filename="package://nowhere/b.stl"/></geometry></collision>
</link></robot>
"""
ARM = """\
extends: panda_sim
robot: {description: arm_description/urdf/arm.urdf, driver: ros2}
models: {lift: models/lift.py, twice: scripted}
workers: [scripted, lift, twice]
cameras:
  front: {source: "file:clips/run.mp4"}
  wrist: {source: "file:~/clips"}
  side: {source: "v4l2:/dev/video0"}
ros2:
  pose_command: {topic: /goal, type: my_msgs/msg/Goal}
  messages: {my_msgs/msg/Goal: msg/goal.msg, my_msgs/msg/Other: OTHER}
hosts: {here: {nodes: [ros2, worker, router, command, camera]}}
"""


def write(path: Path, text: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an arm of one's own, and a home with clips in it."""
    folder = tmp_path / "lab"
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    write(tmp_path / "home/clips/run.mp4")
    other = write(tmp_path / "opt/other.msg")
    write(folder / "arm.yaml", ARM.replace("OTHER", str(other)))
    write(folder / "models/lift.py", MODEL)
    write(folder / "arm_description/urdf/arm.urdf", URDF)
    for name in ("meshes/a.stl", "meshes/a.png", "urdf/hand.stl"):
        write(folder / "arm_description" / name)
    write(folder / "clips/run.mp4")
    write(folder / "msg/goal.msg")
    return folder


def test_everything_that_a_chain_of_profiles_names_is_found(lab: Path, tmp_path: Path) -> None:
    write(lab / "two.yaml", "extends: arm\nabout: two\n")
    write(lab / "two_secure.yaml", "extends: two\nabout: three\n")
    found = needed_files(str(lab / "two_secure.yaml"))
    assert found.profile == "two_secure.yaml"
    assert found.beside.base == lab
    assert set(found.beside.names) == {
        "two_secure.yaml",
        "two.yaml",
        "arm.yaml",
        "arm_description/urdf/arm.urdf",
        "arm_description/urdf/hand.stl",
        "arm_description/meshes",
        "models/lift.py",
        "clips/run.mp4",
        "msg/goal.msg",
    }
    assert found.home == FileUse(tmp_path / "home", ("clips",))
    assert found.whole == FileUse(Path("/"), (str(tmp_path / "opt/other.msg")[1:],))
    assert found.searched == ()
    assert found.missing == (f"1 of 3 meshes that {lab}/arm_description/urdf/arm.urdf names",)


def test_a_profile_whose_base_is_in_another_folder_keeps_the_way_to_it(
    lab: Path, tmp_path: Path
) -> None:
    mine = write(tmp_path / "here/mine.yaml", "extends: ../lab/arm.yaml\ncameras: {front: null}\n")
    found = needed_files(str(mine))
    assert found.beside.base == tmp_path
    assert found.profile == "here/mine.yaml"
    assert {"here/mine.yaml", "lab/arm.yaml", "lab/msg/goal.msg"} <= set(found.beside.names)
    # What was replaced is not needed.
    assert "lab/clips/run.mp4" not in found.beside.names


def test_a_copy_in_any_other_folder_is_the_same_profile(lab: Path, tmp_path: Path) -> None:
    mine = write(tmp_path / "here/mine.yaml", "extends: ../lab/arm.yaml\n")
    before, found = load_profile(str(mine)), needed_files(str(mine))
    there = tmp_path / "elsewhere"
    for name in found.beside.names:
        source, target = found.beside.base / name, there / name
        target.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if source.is_dir() else shutil.copy)(source, target)
    lab.rename(tmp_path / "gone")
    after = load_profile(str(there / found.profile))
    assert after.robot.description == str(there / "lab/arm_description/urdf/arm.urdf")
    assert resources.robot_urdf(after.robot.description).is_file()
    texts = [
        section[key].removeprefix(prefix).replace(str(there), str(tmp_path))
        for section, key, prefix in paths_in(after.model_dump())
    ]
    assert texts == [
        section[key].removeprefix(prefix) for section, key, prefix in paths_in(before.model_dump())
    ]


def test_what_is_found_by_its_name_is_told_with_the_folder_it_was_found_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "own"
    write(own / "profiles/base.yaml", "extends: panda_sim\narm: {file: ../arms/my.py}\n")
    write(own / "models/nod/model.py", MODEL)
    write(own / "sim/bench/scene.xml")
    write(own / "arms/my.py")
    monkeypatch.setenv("VLA_ZENOH_PATH", str(own))
    more = "extends: base\nworkers: [scripted, nod, gone]\nsim: {scene: bench}\n"
    mine = write(tmp_path / "mine.yaml", more)
    found = needed_files(str(mine))
    assert found.beside == FileUse(tmp_path, ("mine.yaml",))
    names = ("profiles/base.yaml", "arms/my.py", "sim/bench", "models/nod")
    assert found.searched == (FileUse(own, names),)
    assert found.missing == ("model gone",)


def test_what_the_package_ships_is_not_copied(tmp_path: Path) -> None:
    mine = write(tmp_path / "mine.yaml", "extends: panda_sim_two_hosts\n")
    nothing = FileUse(Path("/"), ())
    home = FileUse(Path.home(), ())
    assert needed_files(str(mine)) == NeededFiles(
        "mine.yaml", FileUse(tmp_path, ("mine.yaml",)), (), home, nothing, ()
    )


def test_a_file_that_is_not_here_is_told(lab: Path) -> None:
    (lab / "msg/goal.msg").unlink()
    found = needed_files(str(lab / "arm.yaml"))
    assert str(lab / "msg/goal.msg") in found.missing
    assert "msg/goal.msg" not in found.beside.names
