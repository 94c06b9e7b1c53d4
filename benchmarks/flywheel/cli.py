"""``python -m benchmarks flywheel``: demonstrations, data set, training, policy, tables.

Every step keeps a row, ``rows/STEP.json``, with its command, time and result, and is not done again
once it has one; one that was broken off goes on where it was.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.flywheel.cells import compare_cells, mean_action, statistics_differ
from vla_zenoh.cli.options import JsonOption
from vla_zenoh.errors import NodeError, ResourceError
from vla_zenoh.lab.cli.output import print_json

ROOT = Path(__file__).resolve().parents[2]
REQUIREMENTS = (
    "lerobot[training]==0.6.1",
    "metaworld==3.1.1",
    "packaging",
    "pin>=4",
    "example-robot-data>=6",
    "mcap>=1.2",
    "rosbags>=0.11",
    "ruckig>=0.15",
)
"""LeRobot's own extra for Meta-World pins another version of it, with another MuJoCo."""
PACKAGES = (".", *(f"plugins/vla-zenoh-{name}" for name in ("policy-servers", "benchmarks")))
PYTHON = "3.12"
CAMERA, SIZE = "front", 96
FIRST_UNSEEN = 1000
"""Demonstrations have the seeds from 0 on."""
BATCH = 10
"""Episodes of one call of ``lerobot-eval``, which does not resume."""
CHUNK, REPLAN = 80, 20
"""Steps that the policy plans, a second, and those of them that are carried out where it is on
time."""
DELAYS_MS = (0, 100, 200, 400)
WAYS = {
    "stand": ("--mode", "live"),
    "replace": ("--mode", "command", "--composition", "replace"),
    "blend": ("--mode", "command", "--composition", "blend"),
}
POLICY = {
    "type": "act",
    "device": "cpu",
    "push_to_hub": "false",
    "chunk_size": str(CHUNK),
    "n_action_steps": str(REPLAN),
    "dim_model": "128",
    "dim_feedforward": "512",
    "pretrained_backbone_weights": "null",
    "optimizer_lr": "1e-4",
    "optimizer_lr_backbone": "1e-4",
}
"""A small ACT, and nothing that LeRobot would fetch from a hub."""


@dataclass
class Flywheel:
    """A run of the flywheel in a folder."""

    folder: Path
    python: Path
    task: str
    demonstrations: int
    steps: int
    episodes: int
    delays_ms: Sequence[int]
    save_every: int
    train: Sequence[str]
    rows: dict[str, Any] = field(default_factory=dict)

    def row(self, name: str, do: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The row of a step, which is done if there is none yet."""
        file = self.folder / "rows" / f"{name}.json"
        if not file.exists():
            print(f"== {name}", file=sys.stderr, flush=True)
            began_s = time.monotonic()
            found = {"step": name, **do(), "seconds": round(time.monotonic() - began_s, 1)}
            file.parent.mkdir(parents=True, exist_ok=True)
            part = file.with_suffix(".part")
            part.write_text(json.dumps(found, indent=2) + "\n", "utf-8")
            part.replace(file)
        self.rows[name] = json.loads(file.read_text("utf-8"))
        return self.rows[name]

    # -- steps ------------------------------------------------------------------------------------
    def record(self) -> dict[str, Any]:
        words = self._bench("metaworld_expert", 0, self.demonstrations, "demonstrations")
        return self._run_bench([*words, "--record", CAMERA], "demonstrations")

    def export(self) -> dict[str, Any]:
        words = ["dataset", "export", str(self.folder / "demonstrations" / "recordings")]
        words += ["-o", str(self.dataset), "--camera", CAMERA, "--label", "success", "--force"]
        command = self._vla_zenoh([*words, "--state", "position+gripper_open", "--no-rotation"])
        info = json.loads((self.dataset / "meta" / "info.json").read_text("utf-8"))
        return {
            "command": command,
            "episodes": info["total_episodes"],
            "frames": info["total_frames"],
            "statistics_differ_by": statistics_differ(
                self.folder / "demonstrations" / "recordings", self.dataset
            ),
        }

    def training(self) -> dict[str, Any]:
        output = self.folder / "act"
        last = output / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
        if last.exists():
            words = ["--resume=true", f"--config_path={last}"]
        else:
            shutil.rmtree(output, ignore_errors=True)  # LeRobot rejects a folder that is there
            words = [f"--dataset.repo_id=local/{self.task}", f"--dataset.root={self.dataset}"]
            words += [f"--policy.{name}={value}" for name, value in POLICY.items()]
            words += [f"--output_dir={output}", "--env_eval_freq=0", "--batch_size=16"]
            words += ["--num_workers=1", "--log_freq=50", f"--save_freq={self.save_every}"]
        words += [f"--steps={self.steps}", *(f"--{each}" for each in self.train)]
        command = self._lerobot("lerobot-train", words)
        return {"command": command, "steps": self.steps}

    def policy(self, name: str, *more: str) -> dict[str, Any]:
        words = self._bench("lerobot", FIRST_UNSEEN, self.episodes, name)
        words += ["--set", f"checkpoint={self.folder / 'act'}", "--set", "device=cpu"]
        return self._run_bench([*words, "--replan", str(REPLAN), *more], name)

    def constant(self, name: str, action: Sequence[float]) -> dict[str, Any]:
        model = str(Path(__file__).with_name("constant.py"))
        words = self._bench(model, FIRST_UNSEEN, self.episodes, name)
        told = ",".join(f"{each:.9g}" for each in action)
        return self._run_bench([*words, "--set", f"action={told}"], name)

    def expert(self) -> dict[str, Any]:
        words = self._bench("metaworld_expert", FIRST_UNSEEN, self.episodes, "expert")
        return self._run_bench(words, "expert")

    def theirs(self) -> dict[str, Any]:
        """``lerobot-eval`` on the same seeds, `BATCH` at a time."""
        out, command, cells = self.folder / "lerobot-eval", "", list[dict[str, Any]]()
        policy = self.folder / "act" / "checkpoints" / "last" / "pretrained_model"
        for first in range(FIRST_UNSEEN, FIRST_UNSEEN + self.episodes, BATCH):
            count = min(BATCH, FIRST_UNSEEN + self.episodes - first)
            folder = out / str(first)
            words = [f"--policy.path={policy}", "--policy.device=cpu", f"--seed={first}"]
            words += ["--env.discover_packages_path=benchmarks.flywheel.lerobot_env"]
            words += ["--env.type=small_metaworld", f"--env.task={self.task}"]
            words += [f"--env.size={SIZE}", f"--env.journal={folder / 'cells.jsonl'}"]
            words += [f"--eval.n_episodes={count}", "--eval.batch_size=1"]
            words += ["--eval.use_async_envs=false", f"--output_dir={folder}"]
            words += ['--rename_map={"observation.image": "observation.images.front"}']
            if not (folder / "eval_info.json").exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
                self._lerobot("lerobot-eval", words)
            command = command or _shown(["lerobot-eval", *words])
            cells += _cells(folder)
        return {"command": command, "all": cells, "successes": sum(c["success"] for c in cells)}

    @property
    def dataset(self) -> Path:
        return self.folder / "dataset"

    # -- commands ---------------------------------------------------------------------------------
    def _bench(self, worker: str, first: int, count: int, name: str) -> list[str]:
        python = str(self.python)
        words = ["bench", "sim", "metaworld", "--suite", "lerobot", "--tasks", self.task]
        words += ["--benchmark-set", f"size={SIZE}", "--benchmark-set", "plain=yes"]
        words += ["--worker", worker, "--first", str(first), "-n", str(count), "--videos", "0"]
        words += ["--python", python, "--benchmark-python", python]
        return [*words, "-o", str(self.folder / name)]

    def _run_bench(self, words: Sequence[str], name: str) -> dict[str, Any]:
        command = self._vla_zenoh(words)
        result = json.loads((self.folder / name / "result.json").read_text("utf-8"))
        kept = ("episodes", "successes", "success_rate", "wilson_95", "steps_to_success_p50")
        cells = [
            {"seed": each["episode"], **{k: each[k] for k in ("success", "steps", "end")}}
            for each in result["all"]
        ]
        more = {k: result[k] for k in ("mode", "delay_ms", "composition", "versions")}
        return {"command": command, **{k: result[k] for k in kept}, **more, "all": cells}

    def _vla_zenoh(self, words: Sequence[str]) -> str:
        _call([sys.executable, "-m", "vla_zenoh", *words], {})
        return _shown(["vla-zenoh", *words])

    def _lerobot(self, program: str, words: Sequence[str]) -> str:
        offline = {"HF_HUB_OFFLINE": "1", "MUJOCO_GL": "egl", "PYTHONPATH": str(ROOT)}
        _call([str(self.python.with_name(program)), *words], offline)
        return _shown([program, *words])


def _cells(folder: Path) -> list[dict[str, Any]]:
    """Seed, success, steps and end of each episode of one call of ``lerobot-eval``."""
    info = json.loads((folder / "eval_info.json").read_text("utf-8"))
    lines = [json.loads(line) for line in (folder / "cells.jsonl").read_text("utf-8").splitlines()]
    ended = {each["seed"]: each for each in lines}
    per_task = info["per_task"][0]["metrics"]
    seeds = sorted(ended)
    return [
        {
            "seed": seed,
            "success": bool(done),
            "steps": ended[seed]["steps"],
            "end": ended[seed]["end"],
        }
        for seed, done in zip(seeds, per_task["successes"], strict=True)
    ]


def _call(command: Sequence[str], environ: dict[str, str]) -> None:
    # Its stdout is not ours: with --json that has the rows.
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **environ}, stdout=sys.stderr, check=False
    )
    if done.returncode:
        raise NodeError(f"{_shown(command)} ended with status {done.returncode}")


def _shown(command: Sequence[str]) -> str:
    return shlex.join(map(str, command))


def make_environment(folder: Path) -> Path:
    """Interpreter of an environment with LeRobot, Meta-World and vla-zenoh, made once by uv."""
    python = folder / "bin" / "python"
    if (folder / "ready").exists():
        return python
    uv = shutil.which("uv", path=f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}")
    if uv is None:
        raise ResourceError("there is no uv: pip install uv, or name an environment with --python")
    ours = [word for each in PACKAGES for word in ("-e", str(ROOT / each))]
    _call([uv, "venv", "--quiet", "--allow-existing", "--python", PYTHON, str(folder)], {})
    _call([uv, "pip", "install", "--quiet", "--python", str(python), *REQUIREMENTS, *ours], {})
    (folder / "ready").touch()
    return python


def flywheel(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder; goes on there.")],
    task: Annotated[str, typer.Option(help="Of Meta-World.")] = "drawer-open-v3",
    demonstrations: Annotated[int, typer.Option(help="Of the expert, seeds from 0.")] = 50,
    steps: Annotated[int, typer.Option(help="Of the training.")] = 12_000,
    episodes: Annotated[int, typer.Option(help="Unseen seeds, from 1000.")] = 50,
    delays: Annotated[str, typer.Option(help="Of an inference, ms; empty: none.")] = ",".join(
        map(str, DELAYS_MS)
    ),
    save_every: Annotated[int, typer.Option(help="Training steps between checkpoints.")] = 500,
    train: Annotated[
        list[str] | None, typer.Option("--train", help="name=value for lerobot-train; repeatable.")
    ] = None,
    python: Annotated[
        Path | None,
        typer.Option(help="Interpreter of a prepared environment; default: one is made."),
    ] = None,
    until: Annotated[str, typer.Option(help="Name of the last step.")] = "",
    as_json: JsonOption = False,
) -> None:
    """Train a policy on demonstrations of Meta-World's expert; measure it by LeRobot and by us."""
    folder = output.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    found = (python or make_environment(folder / "env")).absolute()
    waits = [int(each) for each in delays.split(",") if each]
    wheel = Flywheel(
        *(folder, found, task, demonstrations, steps, episodes, waits, save_every, train or ())
    )
    plan: dict[str, Callable[[], dict[str, Any]]] = {
        "demonstrations": wheel.record,
        "dataset": wheel.export,
        "training": wheel.training,
        "native": lambda: wheel.policy("native"),
        "lerobot-eval": wheel.theirs,
        "cells": lambda: compare_cells(
            wheel.rows["native"]["all"], wheel.rows["lerobot-eval"]["all"]
        ),
        "expert": wheel.expert,
        "zero": lambda: wheel.constant("zero", (0, 0, 0, 0)),
        "mean": lambda: wheel.constant("mean", mean_action(wheel.dataset)),
    }
    for delay_ms in waits:
        for way, words in WAYS.items():
            name = f"{way}-{delay_ms}ms"
            more = (*words, "--delay", str(delay_ms), "--set", f"horizon={CHUNK}")
            plan[name] = lambda name=name, more=more: wheel.policy(name, *more)
    if until and until not in plan:
        raise typer.BadParameter(f"--until: the steps are {', '.join(plan)}")
    for name, do in plan.items():
        wheel.row(name, do)
        if name == until:
            break
    if as_json:
        print_json(wheel.rows)
    else:
        _print(wheel.rows)


def _print(rows: dict[str, Any]) -> None:
    print("\n| step | done | of | s |\n|---|---|---|---|")
    for name, row in rows.items():
        of = len(row["all"]) if "all" in row else row.get("of", row.get("episodes", ""))
        done = row.get("successes", row.get("same", row.get("frames", "")))
        print(f"| {name} | {done} | {of} | {row['seconds']:g} |")
