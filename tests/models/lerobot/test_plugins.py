"""Plug-ins for LeRobot of all kinds work here as they are installed: packages found by name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("lerobot", reason="needs LeRobot's environment: make test-models")
import tiny_act
from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig
from test_lerobot import ACTION_OPTIONS
from vla_zenoh_lerobot.arm import LeRobotArm

from vla_zenoh.errors import NodeError, WorkerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile, override

pytestmark = pytest.mark.models

CONFIG = """
from dataclasses import dataclass
from lerobot.{where} import {base}

@{base}.register_subclass("made_{kind}")
@dataclass
class Made{name}Config({base}):
    {fields}
"""
ROBOT = """
from lerobot.robots import Robot

class MadeRobot(Robot):
    config_class = MadeRobotConfig
    name = "made_robot"

    def __init__(self, config):
        raise RuntimeError(f"a plug-in's robot at {config.address}")

MadeRobot.__abstractmethods__ = frozenset()
"""
POLICY_CONFIG = """
from dataclasses import dataclass
from lerobot.configs import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig

@PreTrainedConfig.register_subclass("made_act")
@dataclass
class MadeActConfig(ACTConfig):
    pass
"""
POLICY = """
from lerobot.policies.act.modeling_act import ACTPolicy
from .configuration_made_act import MadeActConfig

class MadeActPolicy(ACTPolicy):
    config_class = MadeActConfig
    name = "made_act"
"""


def install(site: Path, package: str, **files: str) -> None:
    """What an installer leaves: a package, and its metadata beside it."""
    folder, about = site / package, site / f"{package}-1.0.dist-info"
    folder.mkdir(parents=True)
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with a plug-in of each kind."""
    site = tmp_path_factory.mktemp("site")
    robot = CONFIG.format(
        where="robots", base="RobotConfig", kind="robot", name="Robot", fields="address: str = 'x'"
    )
    install(site, "lerobot_robot_made", __init__=robot + ROBOT)
    for where, base, kind, name in (
        ("cameras", "CameraConfig", "camera", "Camera"),
        ("teleoperators", "TeleoperatorConfig", "teleoperator", "Teleoperator"),
    ):
        text = CONFIG.format(
            where=where, base=base, kind=kind, name=name, fields="made: bool = True"
        )
        install(site, f"lerobot_{kind}_made", __init__=text)
    install(
        site,
        "lerobot_policy_made_act",
        __init__="from .configuration_made_act import MadeActConfig\n",
        configuration_made_act=POLICY_CONFIG,
        modeling_made_act=POLICY,
    )
    return site


def test_a_policy_of_a_plug_in_is_loaded_and_infers(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(site))
    tiny_act.write(tmp_path / "made")
    config = tmp_path / "made" / "config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"type": "made_act"}))
    model = find_model("lerobot")
    policy = make_policy(model, {"checkpoint": str(config.parent), **ACTION_OPTIONS})
    policy.load()  # pyright: ignore[reportAttributeAccessIssue]
    assert type(policy.policy).__name__ == "MadeActPolicy"  # pyright: ignore
    answer = policy.infer(example_observation(policy.spec))
    assert len(answer.steps) == tiny_act.STEPS


def test_robots_cameras_and_teleoperators_of_plug_ins_are_known(
    site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(site))
    profile = override(load_profile("so101_lerobot"), {"lerobot": {"robot": "made_robot"}})
    with pytest.raises(NodeError, match="a plug-in's robot at x"):
        LeRobotArm(profile, profile.driver_options).connect()
    for kind, base in (
        ("robot", RobotConfig),
        ("camera", CameraConfig),
        ("teleoperator", TeleoperatorConfig),
    ):
        assert base.get_choice_class(f"made_{kind}").__name__.startswith("Made")


def test_a_type_that_nothing_brings_says_that_a_plug_in_would(tmp_path: Path) -> None:
    tiny_act.write(tmp_path / "made")
    config = tmp_path / "made" / "config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"type": "absent"}))
    policy = make_policy(
        find_model("lerobot"), {"checkpoint": str(config.parent), **ACTION_OPTIONS}
    )
    with pytest.raises(WorkerError, match=r"lerobot_policy_absent .* --python"):
        policy.load()  # pyright: ignore[reportAttributeAccessIssue]
