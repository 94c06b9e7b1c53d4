"""Where a recording comes from: facts that a run can be repeated by."""

from __future__ import annotations

import datetime as dt

from vla_zenoh.errors import ProfileError
from vla_zenoh.lab.evaluation.activations import activations
from vla_zenoh.lab.evaluation.result import TASKS, TaskVerdict
from vla_zenoh.lab.policy_servers.model_options import shown
from vla_zenoh.lab.recording.run import Run
from vla_zenoh.lab.trial.verdict import FACT
from vla_zenoh.profile import Profile, read_profile


def provenance(run: Run) -> dict[str, str]:
    """Name and value of each known fact."""
    about, ended = run.file.about, run.file.ended or {}
    began = dt.datetime.fromtimestamp(run.began_ns / 1e9).astimezone()
    rates = dict.fromkeys(f"{entry.record.rate_hz:g}" for entry in run.tasks if entry.record.active)
    facts = {
        "recorded": f"{began:%Y-%m-%d %H:%M:%S %Z}, {run.seconds:.0f} s",
        "host": about.get("host", ""),
        "code": about.get("code") or about.get("version", ""),
        "command": about.get("command", ""),
        "robot": about["robot"],
        "profile": about.get("profile", ""),
        "model": _models(run),
        "rate": f"{', '.join(rates)} Hz" if rates else "",
        "seed": str(ended.get("seed", "")),
    }
    return {name: value for name, value in facts.items() if value}


def _models(run: Run) -> str:
    """Workers that the arm obeyed, with model and options."""
    try:
        profile = read_profile(run.file.profile_yaml, str(run.path))
    except ProfileError:
        profile = None
    workers = dict.fromkeys(worker for _, _, worker in activations(run))
    return "; ".join(_model(worker, profile) for worker in workers)


def _model(worker: str, profile: Profile | None) -> str:
    if profile is None:
        return worker
    model = profile.models.get(worker, worker)
    options = shown(profile.options.get(worker, {}))
    words = [model] if model != worker else []
    words += [f"{name}={value}" for name, value in options.items()]
    return f"{worker} ({', '.join(words)})" if words else worker


def verdicts(run: Run) -> list[TaskVerdict]:
    """Verdicts in the recording: of a demo's judge, or of the person of a trial."""
    ended = run.file.ended or {}
    out: list[TaskVerdict] = []
    tasks = ended.get(TASKS)
    for fact in tasks if isinstance(tasks, list) else ():
        if isinstance(fact, dict):
            said, success = str(fact.get("said", "")), fact.get("success")
            out.append(
                TaskVerdict(
                    str(fact.get("prompt", "")), success if type(success) is bool else None, said
                )
            )
    trial = ended.get(FACT)
    if isinstance(trial, dict) and "verdict" in trial:
        word, note = str(trial["verdict"]), str(trial.get("note", ""))
        prompt = str(trial.get("prompt", ""))
        success = None if word == "void" else word == "success"
        out.append(TaskVerdict(prompt, success, f"{word}: {note}" if note else word))
    return out
