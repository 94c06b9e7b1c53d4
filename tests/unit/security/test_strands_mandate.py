"""The mesh of strands-robots: who may move our arm, by which message."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from strands_lab import MAKE, WALL_S, Lab
from vla_zenoh_strands import wire
from vla_zenoh_strands.identity import Authorities, Identity
from vla_zenoh_strands.mandate import MAX_AGE_S, SILENT_S, Mandate
from vla_zenoh_strands.wire import RefusalError

from vla_zenoh.errors import CodecError, SecurityError

NOW_S = 100.0
US, BOSS, RIVAL = "panda", "boss", "rival"
ORDER = {"action": "start", "instruction": "lift", "duration": 5.0, "policy_provider": "vla_zenoh"}


def order(sender: str = BOSS, *, sent_s: float = WALL_S, **changes: Any) -> dict[str, Any]:
    command = {key: value for key, value in (ORDER | changes).items() if value is not None}
    return {
        "sender_id": sender,
        "target_id": US,
        "turn_id": "a1",
        "command": command,
        "timestamp": sent_s,
    }


def command(body: dict[str, Any]) -> wire.Command:
    return wire.decode_command(json.dumps(body).encode())


def presence(peer: str = BOSS) -> dict[str, Any]:
    return {"robot_id": peer, "timestamp": WALL_S}


@pytest.fixture
def mandate() -> Mandate:
    found = Mandate(US, frozenset((BOSS, RIVAL)))
    for peer in (BOSS, RIVAL):
        found.hear(presence(peer), WALL_S, NOW_S)
    return found


def refused(mandate: Mandate, body: dict[str, Any], now_s: float = NOW_S) -> str:
    with pytest.raises(RefusalError) as caught:
        mandate.judge(command(body), WALL_S, now_s)
    return caught.value.reason


def test_a_named_peer_is_obeyed_for_its_time(mandate: Mandate) -> None:
    found = mandate.judge(command(order()), WALL_S, NOW_S)
    assert (found.prompt, found.duration_s, found.worker) == ("lift", 5.0, "")
    mandate.begin(found, NOW_S + 1.0)
    mandate.hear(presence(), WALL_S, NOW_S + 5.9)
    assert mandate.over(NOW_S + 5.9) == ""
    assert mandate.over(NOW_S + 6.0) == "completed"


def test_a_commander_that_is_silent_loses_the_arm(mandate: Mandate) -> None:
    mandate.begin(mandate.judge(command(order()), WALL_S, NOW_S), NOW_S)
    assert mandate.over(NOW_S + SILENT_S - 0.01) == ""
    mandate.hear(presence(RIVAL), WALL_S, NOW_S + SILENT_S)
    assert mandate.over(NOW_S + SILENT_S) == "silent"


def test_nobody_is_obeyed_unless_named(mandate: Mandate) -> None:
    assert refused(mandate, order("stranger")) == "not_obeyed"
    assert refused(Mandate(US, frozenset()), order()) == "not_obeyed"


def test_one_commander_at_a_time(mandate: Mandate) -> None:
    mandate.judge(command(order()), WALL_S, NOW_S)
    assert refused(mandate, order(RIVAL)) == "busy"
    mandate.end()
    mandate.judge(command(order(RIVAL)), WALL_S, NOW_S)


def test_an_order_is_carried_out_once(mandate: Mandate) -> None:
    mandate.judge(command(order()), WALL_S, NOW_S)
    mandate.end()
    assert refused(mandate, order()) == "replayed"


@pytest.mark.parametrize("late_s", [-MAX_AGE_S - 0.1, MAX_AGE_S + 0.1])
def test_an_order_of_another_time_is_refused(mandate: Mandate, late_s: float) -> None:
    assert refused(mandate, order(sent_s=WALL_S - late_s)) == "stale"


def test_an_order_without_a_time_is_refused(mandate: Mandate) -> None:
    assert refused(mandate, order() | {"timestamp": "now"}) == "stale"


def test_an_order_of_a_peer_that_is_not_heard_is_refused(mandate: Mandate) -> None:
    assert refused(mandate, order(), NOW_S + SILENT_S) == "unheard"


def test_an_order_for_another_robot_is_refused(mandate: Mandate) -> None:
    assert refused(mandate, order() | {"target_id": "other"}) == "not_for_us"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"pretrained_name_or_path": "lerobot/smolvla_base"}, "unsupported"),
        ({"target_joints": {"j1": 3.0}}, "unsupported"),
        ({"policy_host": "gpu.example"}, "unsupported"),
        ({"policy_provider": None}, "invalid"),
        ({"instruction": "  "}, "invalid"),
        ({"duration": 0.0}, "invalid"),
        ({"duration": 60.1}, "invalid"),
        ({"duration": True}, "invalid"),
    ],
)
def test_what_is_not_done_here_is_refused_by_name(
    mandate: Mandate, changes: dict[str, Any], reason: str
) -> None:
    assert refused(mandate, order(**changes)) == reason
    assert mandate.commander == ""


def test_a_worker_is_chosen_by_its_name(mandate: Mandate) -> None:
    assert mandate.judge(command(order(policy_provider="brick")), WALL_S, NOW_S).worker == "brick"


@pytest.mark.parametrize(
    "payload",
    [
        b"\xff",
        b"[]",
        b'{"command": "stop"}',
        b'{"command": {"action": 3}}',
        b'{"sender_id": "**", "command": {}}',
        b'{"turn_id": "a/b", "command": {}}',
        b'{"command": {"duration": NaN}}',
        b"[" * 100_000,
    ],
)
def test_what_is_no_command_is_refused(payload: bytes) -> None:
    with pytest.raises(CodecError):
        wire.decode_command(payload)


# -- certificates -----------------------------------------------------------------------------
@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path)


@pytest.fixture
def signed(lab: Lab) -> Mandate:
    """A mandate that believes certificates only."""
    found = Mandate(US, frozenset((BOSS,)), Authorities.read(str(lab.authority)))
    found.hear(lab.peer(BOSS).sign(presence(), WALL_S), WALL_S, NOW_S)
    return found


@pytest.mark.parametrize("kind", MAKE)
def test_an_order_with_its_certificate_is_obeyed(signed: Mandate, lab: Lab, kind: str) -> None:
    body = lab.peer(BOSS, kind).sign(order(), WALL_S)
    assert signed.judge(command(body), WALL_S, NOW_S).prompt == "lift"


def test_an_order_without_a_certificate_is_refused(signed: Mandate) -> None:
    assert refused(signed, order()) == "unsigned"


def test_an_order_that_was_changed_is_refused(signed: Mandate, lab: Lab) -> None:
    body = lab.peer(BOSS).sign(order(), WALL_S)
    body["command"]["instruction"] = "throw"
    assert refused(signed, body) == "unsigned"


def test_a_certificate_of_somebody_else_is_refused(
    signed: Mandate, lab: Lab, tmp_path: Path
) -> None:
    assert refused(signed, lab.peer("guest").sign(order(), WALL_S)) == "unsigned"
    foreign = Lab(tmp_path, "foreign").peer(BOSS)
    assert refused(signed, foreign.sign(order(), WALL_S)) == "unsigned"


def test_a_signature_of_another_time_is_refused(signed: Mandate, lab: Lab) -> None:
    assert refused(signed, lab.peer(BOSS).sign(order(), WALL_S - 61.0)) == "unsigned"
    assert refused(signed, lab.peer(BOSS).sign(order(), WALL_S + 6.0)) == "unsigned"


def test_a_signed_order_is_carried_out_once_under_any_turn(signed: Mandate, lab: Lab) -> None:
    body = lab.peer(BOSS).sign(order(), WALL_S)
    signed.judge(command(body), WALL_S, NOW_S)
    signed.end()
    assert refused(signed, body) == "replayed"


def test_an_unsigned_presence_does_not_keep_an_order_alive(signed: Mandate, lab: Lab) -> None:
    signed.begin(signed.judge(command(lab.peer(BOSS).sign(order(), WALL_S)), WALL_S, NOW_S), NOW_S)
    with pytest.raises(RefusalError):
        signed.hear(presence(), WALL_S, NOW_S + SILENT_S)
    assert signed.over(NOW_S + SILENT_S) == "silent"


@pytest.mark.parametrize("field", ["alg", "cert", "t", "nonce", "sig", "v"])
@pytest.mark.parametrize("value", [None, 7, "junk", [], {}])
def test_a_signature_that_is_junk_is_refused(
    signed: Mandate, lab: Lab, field: str, value: Any
) -> None:
    body = lab.peer(BOSS).sign(order(), WALL_S)
    body["sig"][field] = value
    assert refused(signed, body) == "unsigned"


def test_a_key_of_another_certificate_is_noticed(lab: Lab) -> None:
    certificate, _ = lab.files(BOSS)
    _, key = lab.files(US)
    with pytest.raises(SecurityError, match="not the key"):
        Identity.read(str(certificate), str(key))
