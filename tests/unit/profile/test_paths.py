"""Files that a profile names are beside it, from wherever it is loaded."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_zenoh.profile import load_profile

ARM = """\
extends: panda_sim
robot: {description: arm/arm.urdf, driver: ros2}
cameras:
  front: {source: "file:clips/run.mp4"}
  wrist: {source: "file:~/clips"}
  side: {source: "v4l2:/dev/video0"}
ros2:
  pose_command: {topic: /goal, type: my_msgs/msg/Goal}
  messages: {my_msgs/msg/Goal: goal.msg, my_msgs/msg/Other: /opt/other.msg}
hosts: {here: {nodes: [ros2]}}
"""


def test_paths_of_a_profile_are_those_beside_the_file_that_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab, here = tmp_path / "lab", tmp_path / "here"
    lab.mkdir()
    here.mkdir()
    (lab / "arm.yaml").write_text(ARM)
    (here / "mine.yaml").write_text("extends: ../lab/arm.yaml\nname: mine\n")
    monkeypatch.chdir(here)
    profile = load_profile("mine.yaml")
    assert profile.robot.description == str(lab / "arm/arm.urdf")
    sources = {name: camera.source for name, camera in profile.cameras.items()}
    assert sources == {
        "front": f"file:{lab / 'clips/run.mp4'}",
        "wrist": "file:~/clips",
        "side": "v4l2:/dev/video0",
    }
    assert profile.ros2 is not None
    assert profile.ros2.messages == {
        "my_msgs/msg/Goal": str(lab / "goal.msg"),
        "my_msgs/msg/Other": "/opt/other.msg",
    }


def test_models_are_beside_the_profile_that_names_them_and_names_stay_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = tmp_path / "lab"
    lab.mkdir()
    (lab / "lab.yaml").write_text(
        "extends: panda_sim\nworkers: [scripted, lift, big, home, still]\n"
        "models: {lift: lift.py, big: ./big, home: ~/home.py, still: scripted}\n"
    )
    (tmp_path / "mine.yaml").write_text("extends: lab/lab.yaml\nmodels: {lift: own/lift.py}\n")
    monkeypatch.chdir(tmp_path)
    models = {"lift": f"{lab}/lift.py", "big": f"{lab}/big", "home": "~/home.py"}
    assert load_profile("lab/lab.yaml").models == {**models, "still": "scripted"}
    own = {**models, "lift": f"{tmp_path}/own/lift.py", "still": "scripted"}
    assert load_profile("mine.yaml").models == own


def test_a_model_that_is_inherited_can_be_taken_away(tmp_path: Path) -> None:
    (tmp_path / "lab.yaml").write_text(
        "extends: panda_sim\nworkers: [scripted, lift]\nmodels: {lift: lift.py}\n"
    )
    mine = tmp_path / "mine.yaml"
    mine.write_text("extends: lab\nworkers: [scripted]\nmodels: {lift: null}\n")
    assert load_profile(str(mine)).models == {}


def test_the_robots_of_the_package_stay_what_they_are() -> None:
    assert load_profile("panda_sim").robot.description == "shipped:panda.urdf"
