"""The steps in execution reach a model over every wire, and mean there what they mean here."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from vla_zenoh_policy_servers.action_semantics import read_action_semantics
from vla_zenoh_serve import openpi_server
from vla_zenoh_serve.policy_server import PolicyServer
from vla_zenoh_serve.served_policy import make_served_policy

from vla_zenoh.errors import PeerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.policy.inference import Committed, rest_of
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile

JOINTS = tuple(f"joint{n}" for n in range(1, 8))
POSE = {"action": "delta", "anchor": "goal", "relative_to": "previous", "controller": "none"}
MEANINGS = {
    "rpy": POSE | {"rotation": "rpy", "position_scale_m": "0.05", "rotation_scale_rad": "0.5"},
    "wxyz": {"action": "absolute", "rotation": "quat_wxyz"},
    "xyzw": {"action": "absolute", "rotation": "quat_xyzw"},
    "degrees": {"action": "joint_position", "joint_scale_rad": "0.0174533"},
}
REST = {"gripper": "open_fraction", "gripper_open": "high", "dt_s": "0.1", "horizon": "8"}


class Remembers:
    """A model that takes the steps in execution and answers with them."""

    def __init__(self, *, takes: bool = True) -> None:
        self.spec = ModelSpec(
            name="remembers",
            observation=ObservationSpec(
                cameras=(CameraSpec(camera="front"),), state=("pose", "gripper"), prompt=True
            ),
            action=ActionSpec(horizon=8, dt_s=0.1, rotation="rpy", gripper="absolute_m"),
        )
        if takes:
            self.takes_committed = True
        self.told: list[Any] = []

    def infer(self, observation: Observation, **given: Any) -> ActionSteps:
        self.told.append(given)
        return ActionSteps(np.zeros((8, 7), np.float32))


@contextmanager
def served(model: Remembers) -> Iterator[Any]:
    """An adapter that asks a server of the model."""
    offer = make_served_policy(model, "", load_profile("panda_sim"))
    server = PolicyServer(offer, "127.0.0.1", 0)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    options = {"url": f"ws://127.0.0.1:{server.port}", "preset": "own", "timeout_s": "20"}
    options |= POSE | {"horizon": "8", "rotation": "rpy"}
    adapter: Any = make_policy(find_model("openpi"), options)
    try:
        yield adapter
    finally:
        adapter.close()
        server.stop()
        thread.join()


def prefix() -> Committed:
    steps = np.random.default_rng(1).uniform(-0.01, 0.01, (5, 7)).astype(np.float32)
    return Committed(steps, 3)


def test_prefix_and_delay_reach_a_served_model_as_the_worker_had_them() -> None:
    model = Remembers()
    with served(model) as adapter:
        seen = example_observation(adapter.spec)
        adapter.infer(seen, committed=None)
        adapter.infer(seen, committed=prefix())
    assert model.told[0] == {"committed": None}
    np.testing.assert_allclose(model.told[1]["committed"].steps, prefix().steps, atol=1e-7)
    assert model.told[1]["committed"].frozen == 3


def test_a_served_model_that_takes_no_prefix_is_asked_without_it() -> None:
    model = Remembers(takes=False)
    with served(model) as adapter:
        adapter.infer(example_observation(adapter.spec), committed=prefix())
    assert model.told == [{}]


@pytest.mark.parametrize(
    "wrong",
    [
        7,
        {"steps": np.zeros((5, 7), np.float32)},
        {"steps": np.zeros((5, 6), np.float32), "frozen": 1},
        {"steps": np.zeros((9, 7), np.float32), "frozen": 1},
        {"steps": np.zeros((0, 7), np.float32), "frozen": 0},
        {"steps": np.full((5, 7), np.nan, np.float32), "frozen": 1},
        {"steps": np.zeros((5, 7), np.float32), "frozen": 6},
        {"steps": np.zeros((5, 7), np.float32), "frozen": True},
        {"steps": np.zeros((5, 7), np.int64), "frozen": 1},
    ],
)
def test_a_prefix_of_another_form_is_rejected_with_what_is_wanted(wrong: Any) -> None:
    with pytest.raises(PeerError, match=r"vla_zenoh_committed .* wanted"):
        openpi_server.read_committed({"vla_zenoh_committed": wrong}, Remembers().spec.action)


@pytest.mark.parametrize("name", MEANINGS)
def test_the_prefix_in_the_policy_s_own_numbers_means_the_same_steps(name: str) -> None:
    meaning = read_action_semantics({**MEANINGS[name], **REST}, joints=JOINTS)
    rows = np.random.default_rng(2).uniform(-1.0, 1.0, (6, sum(meaning.parts().values())))
    if "xyz" in name:
        rows[:, 3:7] /= np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
    np.testing.assert_allclose(meaning.rows(meaning.steps(rows)), rows, atol=1e-12)


@given(st.sampled_from(["absolute", "delta"]), st.floats(1.0, 6.9))
def test_joints_that_are_left_lie_on_the_path_that_is_carried_out(kind: Any, had: float) -> None:
    spec = ActionSpec(
        horizon=8, dt_s=0.1, space="joint", joints=JOINTS, kind=kind, gripper="absolute_m"
    )
    steps = np.random.default_rng(3).uniform(-2.0, 2.0, (8, 8)).astype(np.float32)
    path = steps[:, :7] if kind == "absolute" else np.cumsum(steps[:, :7], axis=0)
    path = np.concatenate([np.zeros((1, 7)), path])
    left = rest_of(spec, steps, had)[:, :7]
    at = had + np.arange(len(left) + 1)
    wanted = np.stack([np.interp(at, np.arange(9), column) for column in path.T], axis=1)
    reached = left if kind == "absolute" else wanted[0] + np.cumsum(left, axis=0)
    np.testing.assert_allclose(reached, wanted[1:], atol=0.03)  # within ALIGNED of a step's end
