"""Commands that are imported when they are called: the first thing that every node waits for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any, NamedTuple

import typer
from typer.core import TyperGroup


class Part(NamedTuple):
    """One word of the command line.

    Args:
        panel: of the help, where it is shown.
        name: what is typed.
        where: ``module:name`` inside the package, of a function or of an app of several commands.
    """

    panel: str
    name: str
    where: str


class _Commands(Mapping[str, Any]):
    """Name -> command, made when first asked for."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self._parts = {part.name: part for part in parts}
        self._made: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._made:
            self._made[name] = _made(self._parts[name])
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)


def _made(part: Part) -> Any:
    module, _, name = part.where.partition(":")
    found = getattr(import_module(f"vla_zenoh.{module}"), name)
    around = typer.Typer(rich_markup_mode="rich", add_completion=False)
    around.callback()(lambda: None)  # makes it a group, whatever it holds
    if isinstance(found, typer.Typer):
        around.add_typer(found, name=part.name, rich_help_panel=part.panel)
    else:
        around.command(part.name, rich_help_panel=part.panel)(found)
    group = typer.main.get_command(around)
    assert isinstance(group, TyperGroup)
    return group.commands[part.name]


def commands_of(parts: Sequence[Part]) -> type[TyperGroup]:
    """A class for `typer.Typer` whose commands are `parts`, in this order."""

    class Group(TyperGroup):
        def __init__(self, **attributes: Any) -> None:
            super().__init__(**attributes)
            self.commands = _Commands(parts)  # pyright: ignore[reportAttributeAccessIssue]

    return Group
