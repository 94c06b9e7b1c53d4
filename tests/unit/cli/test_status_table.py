"""The table of status on terminals of any width: a reason takes a few lines."""

from __future__ import annotations

import io

import pytest

from vla_zenoh.cli import status_table
from vla_zenoh.cli.output import Screen
from vla_zenoh.types import NodeStatus

WHY = "camera front is dark, " * 20 + "the end"
MOST_LINES = status_table.NARROW_LINES + 1


def lines(width: int) -> list[str]:
    command = NodeStatus(
        *("command", "inactive", "host", 1, 2),
        rates_hz={"state/pose": 250.0, "state/joints": 250.0},
        counters={"refused.late": 3},
        detail={"why": WHY, "prompt": "HARD: go up", "worker": "scripted", "rate_hz": 5.0},
    )
    nodes = {
        "command": (command, 0.1, True),
        "sim": (NodeStatus("sim", "ok", "h", 1, 2), 0.2, True),
    }
    screen = Screen(file=io.StringIO(), width=width, force_terminal=True, color_system=None)
    screen.print(status_table.render("panda", nodes, [], width=width))
    assert isinstance(screen.file, io.StringIO)
    return screen.file.getvalue().splitlines()


@pytest.mark.parametrize("width", [40, 60, 80, 99, 100, 120, 131])
def test_a_reason_takes_a_few_lines_on_a_narrow_terminal(width: int) -> None:
    shown = lines(width)
    assert any("command" in line and "inactive" in line for line in shown)
    assert sum("dark" in line for line in shown) <= MOST_LINES
    assert len(shown) <= 2 * MOST_LINES + 4
    assert "late 3" in "\n".join(shown)


def test_on_a_wide_terminal_it_is_a_table() -> None:
    assert any(line.split()[:3] == ["node", "state", "age"] for line in lines(160))


def test_a_simulator_that_is_too_slow_says_so_in_its_row() -> None:
    why = "slower than real time: x 0.70"
    sim = NodeStatus("sim", "running", "h", 1, 2, detail={"slow": why, "renderer": "egl"})
    screen = Screen(file=io.StringIO(), width=120, force_terminal=True, color_system=None)
    screen.print(status_table.render("panda", {"sim": (sim, 0.2, True)}, [], width=120))
    assert isinstance(screen.file, io.StringIO)
    assert why in screen.file.getvalue()
