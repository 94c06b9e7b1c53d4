"""Which worker a person means, which model it runs, and with what options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vla_zenoh.cli.options import model_options
from vla_zenoh.policy.loader import ModelFile, find_worker
from vla_zenoh.profile import Profile


@dataclass(frozen=True, slots=True)
class Chosen:
    """A worker that is to run.

    Args:
        name: what its keys are called by.
        model: what it runs.
        options: in force: those of the command line before those of the profile.
    """

    name: str
    model: ModelFile
    options: Mapping[str, str]


def chosen_worker(
    profile: Profile | None, word: str, given: Sequence[str], name: str | None = None
) -> Chosen:
    """What `word` on the command line means.

    Args:
        profile: whose workers and options count; None: there is none.
        word: a worker of the profile, the name of a model, or a path to one.
        given: options as ``name=value``.
        name: what the worker is called, in place of its own name.

    Raises:
        ResourceError: there is no such model.
        WorkerError: its header cannot be read.
        typer.BadParameter: an option is not of that form.
    """
    told = model_options(list(given))
    own, model = find_worker(word, profile.models if profile is not None else {})
    called = name or own
    usual = profile.options.get(called, {}) if profile is not None else {}
    return Chosen(called, model, {**usual, **told})
