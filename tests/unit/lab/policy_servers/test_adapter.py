"""What every adapter does with a wire that fails: drop it, say why, try again, never read on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from model_wires import openpi
from vla_zenoh_policy_servers.adapter import FIRST_S, LONGEST_S, Adapter

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.lab.check.examples import example_observation

STEP = [[0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]
SOON_S = 0.05


class Wired(Adapter):
    """An adapter whose wire is a function, and whose time goes on when it is told to."""

    name, presets = "wired", openpi.PRESETS
    lost = (ConnectionError,)

    def __init__(self, answer: Callable[[], Any], **options: str) -> None:
        self.now_s, self.wire, self.wrong = 0.0, answer, list[str]()
        self.connections, self.begun = 0, list[bool]()
        self._open = False
        super().__init__(
            "the wire",
            "libero",
            options,
            timeout_s="1",
            profile="panda_sim",
            clock_s=lambda: self.now_s,
        )

    def _connect(self) -> list[str]:
        self.connections += not self._open
        self._open = True
        return self.wrong

    def _ask(self, fields: dict[str, Any], *, begins: bool) -> Any:
        self.begun.append(begins)
        return self.wire()

    def close(self) -> None:
        super().close()
        self._open = False

    def ask(self) -> np.ndarray[Any, Any]:
        return np.asarray(self.infer(example_observation(self.spec)).steps)

    def waits_s(self) -> float:
        """How long no question is put after a failure."""
        begun_s, asked = self.now_s, len(self.begun)
        while len(self.begun) == asked and not self.wrong:
            with pytest.raises(PeerError):
                self.ask()
            self.now_s += SOON_S
        return self.now_s - begun_s


def raising(error: Exception) -> Callable[[], Any]:
    def answer() -> Any:
        raise error

    return answer


def test_one_connection_serves_many_questions_and_each_episode_begins_once() -> None:
    adapter = Wired(lambda: STEP)
    for _ in range(3):
        adapter.ask()
    adapter.reset()
    adapter.ask()
    assert adapter.connections == 1
    assert adapter.begun == [True, False, False, True]


@pytest.mark.parametrize(
    ("error", "reason", "why"),
    [
        (TimeoutError(), "peer_timeout", "the wire did not answer within 1 s"),
        (ConnectionResetError("reset"), "peer_gone", "no connection to the wire: reset"),
        (ConnectionError(), "peer_gone", "no connection to the wire: ConnectionError"),
        (PeerError("peer_error", "no such task"), "peer_error", "no such task"),
    ],
)
def test_a_fault_is_named_and_its_connection_is_never_used_again(
    error: Exception, reason: str, why: str
) -> None:
    adapter = Wired(raising(error))
    with pytest.raises(PeerError, match=why) as raised:
        adapter.ask()
    assert raised.value.reason == reason
    with pytest.raises(PeerError, match="the wire was lost; retrying in"):
        adapter.ask()
    adapter.wire, adapter.now_s = (lambda: STEP), FIRST_S
    assert adapter.ask().shape == (1, 7)
    assert adapter.connections == 2
    assert adapter.begun == [True, True]


def test_a_mistake_of_the_adapter_itself_leaves_no_answer_on_the_wire_either() -> None:
    adapter = Wired(raising(KeyError("action")))
    with pytest.raises(KeyError):
        adapter.ask()
    adapter.wire, adapter.now_s = (lambda: STEP), FIRST_S
    adapter.ask()
    assert adapter.connections == 2


def test_a_server_that_answers_is_asked_again_soon_and_a_silent_one_ever_less_often() -> None:
    refusing = Wired(raising(PeerError("peer_error", "no")))
    silent = Wired(raising(TimeoutError()))
    refused_s = [refusing.waits_s() for _ in range(6)]
    silent_s = [round(silent.waits_s(), 3) for _ in range(6)]
    assert max(refused_s) <= FIRST_S + 2 * SOON_S
    assert silent_s == sorted(silent_s)
    assert silent_s[-1] == pytest.approx(LONGEST_S, abs=2 * SOON_S)


def test_what_does_not_fit_is_named_and_nothing_is_asked() -> None:
    adapter = Wired(lambda: STEP)
    adapter.wrong = ["it gives 8 columns", "its gripper is another"]
    with pytest.raises(
        PeerError, match="does not match: it gives 8 columns; its gripper"
    ) as raised:
        adapter.ask()
    assert raised.value.reason == "peer_mismatch"
    assert adapter.begun == []


def test_joints_are_refused_where_an_adapter_does_not_read_them() -> None:
    told = {"action": "joint_position", "joint_scale_rad": "1"}
    with pytest.raises(SpecError, match="joints are not read by this adapter"):
        Wired(lambda: STEP, **told, gripper="none", dt_s="0.1")
