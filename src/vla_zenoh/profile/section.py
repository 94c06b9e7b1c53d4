"""What all sections of a profile are made of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from vla_zenoh import keys
from vla_zenoh.errors import ProfileError
from vla_zenoh.types import MAX_TEXT

Place = tuple[str, ...]


class Section(BaseModel):
    """A part of a profile: frozen, unknown keys refused, finite numbers only.

    Strict, so that neither ``"5"`` nor ``true`` is a number. Lists become tuples.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class Misfit(ValueError):
    """Values that are right each for itself and do not fit each other.

    Args:
        faults: (place below the section that raises this, sentence).
    """

    def __init__(self, faults: Sequence[tuple[Place, str]]) -> None:
        self.faults = tuple(faults)
        super().__init__("; ".join(f"{'.'.join(place)} {why}" for place, why in faults))


def refuse(faults: Sequence[tuple[Place, str]]) -> None:
    """Raise `Misfit` where there are faults."""
    if faults:
        raise Misfit(faults)


def _key_part(value: str) -> str:
    try:
        return keys.key_chunk(value, "name")
    except ProfileError as error:
        raise ValueError(str(error)) from error


def _differ(values: tuple[Any, ...]) -> tuple[Any, ...]:
    twice = sorted({str(value) for value in values if values.count(value) > 1})
    if twice:
        raise ValueError(f"{', '.join(twice)}: given more than once")
    return values


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] >= pair[1]:
        raise ValueError(f"[{pair[0]:g}, {pair[1]:g}] is empty: give [smallest, largest]")
    return pair


Name = Annotated[str, AfterValidator(_key_part)]
Text = Annotated[str, Field(max_length=MAX_TEXT)]
Word = Annotated[str, Field(min_length=1, max_length=512)]
Names = Annotated[tuple[Name, ...], Field(strict=False, max_length=64), AfterValidator(_differ)]
Words = Annotated[tuple[Word, ...], Field(strict=False, max_length=64), AfterValidator(_differ)]
Range = Annotated[tuple[float, float], Field(strict=False), AfterValidator(_ordered)]
Distinct = AfterValidator(_differ)
