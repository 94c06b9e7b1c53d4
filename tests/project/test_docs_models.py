"""The model and the adapter of the pages on models run, and their commands exist."""

from __future__ import annotations

import ast
import dataclasses
import itertools
import json
import re
import shlex
import socketserver
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from camera_rig import until
from model_wires import groot, openpi, openvla_rest, origami
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_policy_servers.action_semantics import ACTION_OPTIONS, read_action_semantics
from vla_zenoh_policy_servers.field_mapping import DEFAULTS, read_map
from vla_zenoh_policy_servers.state_vector import COORDINATES, PARTS, read_parts

from vla_zenoh.errors import PeerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import ActionSpec, CameraSpec, Observation, ObservationSpec
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.simulation.world import build_world

ROOT = Path(__file__).parents[2]
PAGES = ("models.md", "policy-servers.md", "evaluate.md")
TEXT = "\n".join((ROOT / "docs" / "how-to" / page).read_text("utf-8") for page in PAGES)
LINES = 10
STEP_M, SECONDS, RATE_HZ = 0.01, 1.0, 10.0
WAY_M = STEP_M * RATE_HZ * SECONDS
LAG_M, STILL_M = 0.04, 1e-3
PATIENCE_S = 10.0


def written(folder: Path, name: str, number: int) -> Path:
    """A block of Python, as the file that the text says."""
    path = folder / name
    path.write_text(re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)[number], "utf-8")
    return path


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return written(tmp_path, "lift.py", 0)


def test_the_model_is_ten_lines(model: Path) -> None:
    lines = [line for line in model.read_text().splitlines() if line and line[0] != "#"]
    assert len(lines) <= LINES


def height_m(loop: Lockstep) -> float:
    return float(loop.trace.position_m[-1][2])


def test_the_model_lifts_the_arm(model: Path) -> None:
    policy, profile = make_policy(find_model(str(model))), load_profile("panda_sim")
    loop = Lockstep(profile, build_world(profile), policy, steps=2)
    loop.put("rate", RATE_HZ)
    loop.put("prompt", "wait")
    loop.run(1.1)
    loop.put("active", True)
    loop.run(0.3)
    still_m = height_m(loop)
    assert still_m == pytest.approx(float(loop.trace.position_m[0][2]), abs=STILL_M)
    loop.put("prompt", "lift")
    loop.run(SECONDS)
    assert height_m(loop) - still_m == pytest.approx(WAY_M, abs=LAG_M)


def test_the_model_passes_the_check(model: Path) -> None:
    command = re.search(r"^    vla-zenoh (check lift\.py.*)$", TEXT, re.MULTILINE)
    assert command is not None
    done = subprocess.run(
        [sys.executable, "-m", "vla_zenoh", *command[1].split()],
        cwd=model.parent,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_model_with_weights_says_what_it_needs_and_which_options_it_takes(
    tmp_path: Path,
) -> None:
    model = find_model(str(written(tmp_path, "reach.py", 1)))
    assert [one.partition("=")[0] for one in model.dependencies] == ["numpy", "torch"]
    tree = ast.parse(model.path.read_text())
    (reach,) = [
        part for part in tree.body if isinstance(part, ast.ClassDef) and part.name == "Reach"
    ]
    makers = {part.name: part for part in reach.body if isinstance(part, ast.FunctionDef)}
    assert [one.arg for one in makers["__init__"].args.args] == ["self", "checkpoint", "device"]
    assert {"load", "infer"} < set(makers)


def test_every_preset_and_option_is_told() -> None:
    for presets in (openpi.PRESETS, groot.PRESETS, openvla_rest.PRESETS, origami.PRESETS):
        for preset in presets:
            assert f"`{preset}`" in TEXT, preset
    for option in (*DEFAULTS, "none"):
        assert f"`{option}`" in TEXT, option
    coordinates = {name for names in COORDINATES.values() for name in names}
    for part in set(PARTS) - coordinates - {"zero"}:
        assert f"`{part}`" in TEXT, part


def test_its_profiles_are_right_and_each_host_knows_what_it_runs(tmp_path: Path) -> None:
    blocks = re.findall(r"```yaml\n(# (\w+\.yaml).*?)```", TEXT, re.DOTALL)
    for block, name in blocks:
        (tmp_path / name).write_text(block, "utf-8")
    profiles = {name: load_profile(str(tmp_path / name)) for _, name in blocks}
    openvla = profiles["openvla.yaml"]
    assert openvla.options["openvla"]["unnorm_key"] == "bridge_orig"
    assert profiles["lift.yaml"].models["lift"] == str(tmp_path / "lift.py")
    assert profiles["reach.yaml"].models["reach"] == str(tmp_path / "reach.py")
    left, right = profiles["left.yaml"], profiles["right.yaml"]
    assert left.serves == right.serves
    assert left.session.connect == left.session.listen
    assert right.workers_of(right.hosts["gpu"]) == ("mine",)
    assert left.workers_of(left.hosts["gpu"]) == ("mine", "scripted")


@pytest.mark.parametrize(
    "model", ["openpi", "groot", "openvla_rest", "origami", "lerobot", "openvla"]
)
def test_every_argument_of_a_model_is_told(model: str) -> None:
    told = parameters(model)
    assert told
    assert [
        name for name in sorted(told) if f"`{name}`" not in TEXT and f" {name}=" not in TEXT
    ] == []


def test_all_that_a_model_is_given_and_may_ask_for_is_told() -> None:
    given = [field.name for field in dataclasses.fields(Observation)]
    asked = [*CameraSpec.model_fields, *ObservationSpec.model_fields, *ActionSpec.model_fields]
    assert [name for name in (*given, *asked) if f"`{name}`" not in TEXT] == []


class Up(socketserver.StreamRequestHandler):
    """Two steps up for a state and a text, until the text is another."""

    def handle(self) -> None:
        for line in self.rfile:
            asked = json.loads(line)
            assert len(asked["state"]) == 7
            assert isinstance(asked["first"], bool)
            if asked["text"] == "leave":
                return
            self.wfile.write(json.dumps({"steps": [[0, 0, STEP_M, 0, 0, 0, 0.04]] * 2}).encode())
            self.wfile.write(b"\n")


def test_the_adapter_asks_its_server_and_finds_it_again(tmp_path: Path) -> None:
    with socketserver.TCPServer(("127.0.0.1", 0), Up) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        options = {"port": str(server.server_address[1])}
        policy: Any = make_policy(find_model(str(written(tmp_path, "lines.py", 4))), options)

        def asked(prompt: str) -> Any:
            return policy.infer(example_observation(policy.spec, prompt=prompt)).steps

        assert asked("up")[:, 2].tolist() == [STEP_M, STEP_M]
        with pytest.raises(PeerError, match="no connection to") as raised:
            asked("leave")
        assert raised.value.reason == "peer_gone"
        with pytest.raises(PeerError, match="retrying in"):
            asked("up")
        until("it answers again", lambda: answers(asked), PATIENCE_S)
        policy.close()
        server.shutdown()


def answers(asked: Callable[[str], Any]) -> bool:
    try:
        return len(asked("up")) == 2
    except PeerError:
        return False


# -- command lines --------------------------------------------------------------------------------
OTHERS = ("lerobot", "openvla")
"""Models whose constructor reads a directory of weights."""


def command_lines() -> list[list[str]]:
    """Words of every command of the page, without brackets and comments."""
    text = re.sub(r"\\?\n {8,}", " ", TEXT)
    lines = re.findall(r"^ {4}(?:\w+=\S+ )*(vla-zenoh .*)$", text, re.MULTILINE)
    words = [shlex.split(line.replace("[", "").replace("]", ""), comments=True) for line in lines]
    return [part for line in words for part in split(line)]


def split(words: list[str]) -> list[list[str]]:
    """Commands that stand in one line with ; between them."""
    out: list[list[str]] = [[]]
    for word in words:
        out[-1].append(word.removesuffix(";"))
        if word.endswith(";"):
            out.append([])
    return out


def settings(words: list[str]) -> dict[str, str]:
    told = [after for word, after in itertools.pairwise(words) if word == "--set"]
    return dict(setting.split("=", 1) for setting in told)


def parameters(model: str) -> set[str]:
    """Options that the constructor of a shipped model names itself."""
    tree = ast.parse(find_model(model).path.read_text("utf-8"))
    (maker,) = [
        part
        for part in ast.walk(tree)
        if isinstance(part, ast.FunctionDef) and part.name == "__init__"
    ]
    return {argument.arg for argument in maker.args.args[1:]}


def told_to(*models: str) -> list[tuple[str, dict[str, str]]]:
    lines = [words for words in command_lines() if words[1] in ("worker", "check")]
    return [(line[2], settings(line)) for line in lines if line[2] in models]


def test_its_servers_can_be_asked_with_the_options_that_stand_there() -> None:
    lines = told_to("openpi", "groot", "openvla_rest", "origami")
    lines = [(model, told) for model, told in lines if "url" in told]
    assert {model for model, told in lines if told.get("preset") == "none"} == {
        "openpi",
        "groot",
        "openvla_rest",
    }
    for model, told in lines:
        policy = make_policy(find_model(model), told)
        assert policy.spec.observation.prompt


def test_its_checkpoints_are_told_what_they_need_to_be_told() -> None:
    lines = told_to(*OTHERS)
    assert len([model for model, _ in lines if model == "lerobot"]) >= 4
    assert len([model for model, _ in lines if model == "openvla"]) >= 6
    for model, told in lines:
        meaning = {name: value for name, value in told.items() if name in ACTION_OPTIONS}
        assert set(told) - set(meaning) <= parameters(model), (model, told)
        if model == "lerobot":
            assert read_action_semantics({"horizon": "1", **meaning}, joints=("one", "two"))
            assert read_parts(told["state"])
            read_map(told.get("map", ""))
