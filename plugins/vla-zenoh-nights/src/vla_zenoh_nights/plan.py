"""Plan of an unattended trial: tasks, models, resets, judge and rules for its end. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, time, timedelta, tzinfo
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from vla_zenoh_trial.plan import TrialPlan
from vla_zenoh_trial.verdict import EpisodeVerdict

from vla_zenoh.errors import ProfileError, RecordError, describe_faults, in_words
from vla_zenoh.lab.tasks.order import Order
from vla_zenoh.profile.load import read_yaml

CONTACT_WORDS = ("contact", "does not follow", "too near to a bound")
"""In the reason of an end that the policy caused; all other losses are of the nodes, and void."""

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
Count = Annotated[int, Field(ge=1, le=10_000)]
Seconds = Annotated[float, Field(gt=0, le=3600)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class UnattendedTask(_Part):
    """A task that every worker does `episodes` times.

    Args:
        order: goal for the simulator's judge, as `vla_zenoh.lab.tasks.order.Order`.
    """

    name: Name
    prompt: Annotated[str, Field(min_length=1, max_length=1000)]
    episodes: Count
    seconds: Seconds = 60.0
    order: Order | None = None


class Reset(_Part):
    """What is done before each episode: exactly one of the three.

    Args:
        simulator: reset it; the layout has the plan's seed plus the number of the setup.
        primitive: ``home``; needs the node ``primitives``.
        worker: a policy that sets the scene up, with `prompt`, for at most `seconds`.
    """

    simulator: bool = False
    primitive: Annotated[str, Field(pattern="^(home)?$")] = ""
    worker: str = ""
    prompt: str = ""
    seconds: Seconds = 60.0

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.simulator + bool(self.primitive) + bool(self.worker) != 1:
            raise ValueError("give one of simulator: true, primitive: home, worker: NAME")
        if bool(self.worker) != bool(self.prompt):
            raise ValueError("worker and prompt belong together")
        return self


class JudgeChoice(_Part):
    """Who says whether an episode succeeded: exactly one of the three.

    Args:
        simulator: true poses of the objects; every task needs an `order`.
        file: Python file with ``judge(episode)``, beside the plan.
        url: OpenAI-compatible endpoint (``.../v1/chat/completions``) that is asked with pictures.
        question: for it; ``{prompt}`` is replaced.
    """

    simulator: bool = False
    file: str = ""
    url: str = ""
    model: str = ""
    question: str = (
        "The pictures show a robot from the beginning to the end of an episode. Its task: "
        "{prompt}. Is the task done in the last picture? Answer yes or no, then why."
    )

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.simulator + bool(self.file) + bool(self.url) != 1:
            raise ValueError("give one of simulator: true, file: FILE.py, url: URL")
        if self.url and not self.url.startswith(("http://", "https://")):
            raise ValueError("url begins with http:// or https://")
        return self


class StopRules(_Part):
    """When an unattended trial stops; each counts from its last start after a stop.

    Args:
        contacts: episodes that ended by contact or a blocked arm.
        refusals: episodes whose activation was rejected to the end.
        at: local time of day, ``HH:MM``.
    """

    contacts: Count | None = 3
    refusals: Count | None = 3
    failures_in_a_row: Count | None = None
    voids_in_a_row: Count = 20
    at: time | None = None

    def reason(self, since: Sequence[EpisodeVerdict]) -> str:
        """Why to stop after these episodes; empty: go on."""
        contacts = sum(is_contact(each) for each in since)
        refusals = sum(each.end == "refused" for each in since)
        judged = [each.verdict for each in since if each.verdict != "void"]
        for name, count in (
            ("contacts", contacts),
            ("refusals", refusals),
            ("failures_in_a_row", _at_end(judged, "failure")),
            ("voids_in_a_row", _at_end([each.verdict for each in since], "void")),
        ):
            most = getattr(self, name)
            if most is not None and count >= most:
                return f"{name}: {count}"
        return ""

    def deadline(self, began_s: float, zone: tzinfo | None = None) -> float | None:
        """The next `at` after a start, as Unix time; None: there is none."""
        if self.at is None:
            return None
        began = datetime.fromtimestamp(began_s, UTC).astimezone(zone)
        end = began.replace(hour=self.at.hour, minute=self.at.minute, second=0, microsecond=0)
        return (end if end > began else end + timedelta(days=1)).timestamp()


class UnattendedPlan(_Part):
    """Every worker does every task, in layouts and an order drawn from the seed.

    Args:
        webhook: is sent JSON at start, trouble and end; empty: none is sent.
    """

    workers: tuple[str, ...]
    tasks: Annotated[tuple[UnattendedTask, ...], Field(min_length=1, max_length=1000)]
    reset: Reset
    judge: JudgeChoice
    stop: StopRules = StopRules()
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    webhook: Annotated[str, Field(pattern="^(https?://.+)?$")] = ""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        names = [each.name.lower() for each in self.tasks]
        if len(set(names)) < len(names):
            raise ValueError("two tasks have one name")
        missing = [each.name for each in self.tasks if each.order is None]
        if self.judge.simulator and missing:
            raise ValueError(f"the simulator's judge needs order in task {', '.join(missing)}")
        for task in self.tasks:
            self.trial(task, "robot")
        return self

    def trial(self, task: UnattendedTask, robot: str) -> TrialPlan:
        """The plan of one task's trial."""
        setups = ("",) * task.episodes
        return TrialPlan(robot, self.workers, task.prompt, setups, task.seconds, self.seed, False)


def is_contact(episode: EpisodeVerdict) -> bool:
    """Whether contact, a blocked arm or a bound ended it."""
    return episode.end == "lost" and episode.verdict != "void" and is_contact_loss(episode.why)


def is_contact_loss(why: str) -> bool:
    """Whether this reason of the command node is contact, a blocked arm or a bound."""
    return any(word in why for word in CONTACT_WORDS)


def read_plan(path: Path) -> UnattendedPlan:
    """Read a plan (YAML).

    Raises:
        RecordError: it cannot be read, or a value is not allowed; names it.
    """
    try:
        data, _ = read_yaml(path.read_bytes(), str(path))
    except (OSError, ProfileError) as error:
        raise RecordError(in_words(error)) from error
    return checked_plan(data, str(path))


def checked_plan(data: Any, where: str) -> UnattendedPlan:
    """A plan of plain data. Raises RecordError: a value is not allowed; names it."""
    try:
        return UnattendedPlan.model_validate(data)
    except ValidationError as error:
        raise RecordError(f"{where}: {describe_faults(error, 'plan')}") from error


def _at_end(verdicts: Sequence[str], kind: str) -> int:
    count = 0
    while count < len(verdicts) and verdicts[-1 - count] == kind:
        count += 1
    return count
