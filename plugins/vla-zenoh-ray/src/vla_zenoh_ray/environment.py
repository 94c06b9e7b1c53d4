"""Packages that the worker in front needs besides Ray: those of the model, whose spec it reads."""

from __future__ import annotations

from collections.abc import Mapping

from vla_zenoh.policy.loader import find_model

MODEL = "model"


def dependencies(options: Mapping[str, str]) -> list[str]:
    """Requirements of the model that `options` name; none without it."""
    given = dict(options)
    name = given.pop(MODEL, "")
    return list(find_model(name).for_options(given).dependencies) if name else []
