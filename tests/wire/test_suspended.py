"""A command node whose computer was suspended: it does not go on as if no time had passed."""

from __future__ import annotations

import re
import threading
from typing import Any

import pytest
from camera_rig import routed_session, until

from vla_zenoh.bus import clock
from vla_zenoh.nodes.command.node import CommandNode
from vla_zenoh.profile import load_profile

pytestmark = pytest.mark.long

ASLEEP_NS = 3_600_000_000_000


def test_after_the_computer_was_suspended_the_activation_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asleep_ns = [0]
    monkeypatch.setattr(clock, "suspended_ns", lambda: asleep_ns[0])
    with routed_session() as session:
        node = CommandNode(load_profile("panda_sim"), session)
        step, lost = node.commander.step, list[str]()

        def heard(inputs: Any, *rest: int) -> Any:
            lost.extend(str(each.value) for each in inputs.settings if each.name == "lose")
            return step(inputs, *rest)

        monkeypatch.setattr(node.commander, "step", heard)

        def sleep() -> bool:
            asleep_ns[0] += ASLEEP_NS  # and again, as nobody says when the loop has begun
            found = [re.search(r"stood still for ([\d.]+) s", why) for why in lost]
            return any(match and float(match[1]) * 1e9 >= ASLEEP_NS for match in found)

        stop = threading.Event()
        thread = threading.Thread(target=node.run, args=(stop,))
        thread.start()
        try:
            until("it is lost", sleep)
        finally:
            stop.set()
            thread.join(10.0)
        assert not thread.is_alive()
