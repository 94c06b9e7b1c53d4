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
from vla_zenoh_benchmarks.cli_compare import B_IS_WORSE

from benchmarks.flywheel.cells import (
    compare_cells,
    led_frames,
    losses,
    mean_action,
    statistics_differ,
)
from benchmarks.flywheel.figures import write_figures
from vla_zenoh.cli.options import JsonOption
from vla_zenoh.errors import NodeError, ResourceError
from vla_zenoh.lab.cli.output import print_json

ROOT = Path(__file__).resolve().parents[2]
REQUIREMENTS = (
    "lerobot[training]==0.6.1",
    "metaworld==3.1.1",
    "packaging",
    "pin>=4",
    "mcap>=1.2",
    "rosbags>=0.11",
    "ruckig>=0.15",
)
"""LeRobot's own extra for Meta-World pins another version of it, with another MuJoCo."""
PACKAGES = (".", *(f"plugins/vla-zenoh-{name}" for name in ("policy-servers", "benchmarks")))
PYTHON = "3.12"
CAMERA, SIZE = "front", 96
EXPERT = "metaworld_expert"
FIRST_UNSEEN, FIRST_CORRECTED = 1000, 2000
"""Demonstrations have the seeds from 0 on."""
BATCH = 10
"""Episodes of one call of ``lerobot-eval``, which does not resume."""
CHUNK, REPLAN = 80, 20
"""Steps that the policy plans, a second, and those of them that are carried out where it is on
time."""
DELAYS_MS = (0, 100, 200, 400)
ACT, LAST = "act", "checkpoints/last/pretrained_model"
CORRECTED, LONGER, CORRECTED_DATA = "corrected-act", "longer-act", "corrected-dataset"
CELL = ("success", "steps", "end", "taken_over_at")
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
    "use_vae": "false",
    "optimizer_lr": "1e-4",
    "optimizer_lr_backbone": "1e-4",
}
"""A small ACT, and nothing that LeRobot would fetch from a hub.

The expert's motion is a function of what it sees: there is no style that a VAE would tell apart,
and its encoder is half the time of a step.
"""


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
    corrections: int
    more_steps: int
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
            part.write_text(self._anywhere(json.dumps(found, indent=2)) + "\n", "utf-8")
            part.replace(file)
        self.rows[name] = json.loads(file.read_text("utf-8"))
        return self.rows[name]

    # -- steps ------------------------------------------------------------------------------------
    def record(self) -> dict[str, Any]:
        words = self._bench(EXPERT, 0, self.demonstrations, "demonstrations")
        return self._run_bench([*words, "--record", CAMERA], "demonstrations")

    def export(self) -> dict[str, Any]:
        recordings = self.folder / "demonstrations" / "recordings"
        found = self._export(self.dataset)
        return {**found, "statistics_differ_by": statistics_differ(recordings, self.dataset)}

    def _export(self, dataset: Path, more: Sequence[Path] = ()) -> dict[str, Any]:
        """A data set of all demonstrations, and of `more` recordings."""
        words = ["dataset", "export", str(self.folder / "demonstrations" / "recordings")]
        words += [*map(str, more), "-o", str(dataset), "--camera", CAMERA, "--label", "success"]
        # What the policy did before the expert took over is no example (HG-DAgger: Kelly et al.,
        # ICRA 2019).
        words += ["--worker", EXPERT, "--state", "position+gripper_open", "--no-rotation"]
        words += ["--force"]
        command = self._vla_zenoh(words)
        info = json.loads((dataset / "meta" / "info.json").read_text("utf-8"))
        counts = {"episodes": info["total_episodes"], "frames": info["total_frames"]}
        return {"command": command, **counts, "led_by_the_expert": led_frames(dataset)}

    def training(self) -> dict[str, Any]:
        policy = [f"--policy.{name}={value}" for name, value in POLICY.items()]
        return self._train(ACT, self.dataset, policy, self.steps)

    def train_on(self, name: str, dataset: Path) -> dict[str, Any]:
        """Go on with the trained policy on a data set, with a new optimizer."""
        policy = [f"--policy.path={self.folder / ACT / LAST}", "--policy.push_to_hub=false"]
        return self._train(name, dataset, policy, self.more_steps)

    def _train(self, name: str, dataset: Path, policy: Sequence[str], steps: int) -> dict[str, Any]:
        output = self.folder / name
        if (output / LAST / "train_config.json").exists():
            words = ["--resume=true", f"--config_path={output / LAST / 'train_config.json'}"]
        else:
            shutil.rmtree(output, ignore_errors=True)  # LeRobot rejects a folder that is there
            words = [f"--dataset.repo_id=local/{self.task}", f"--dataset.root={dataset}", *policy]
            # On two cores a process that decodes pictures costs more than it brings.
            words += [f"--output_dir={output}", "--env_eval_freq=0", "--batch_size=8"]
            words += ["--num_workers=0", "--log_freq=50", f"--save_freq={self.save_every}"]
        words += [f"--steps={steps}", *(f"--{each}" for each in self.train)]
        log = self.folder / f"{name}.log"
        command = self._lerobot("lerobot-train", words, log)
        return {"command": command, "steps": steps, "l1_by_epoch": losses(log)}

    def policy(self, name: str, *more: str, checkpoint: str = ACT) -> dict[str, Any]:
        return self._policy(name, FIRST_UNSEEN, self.episodes, checkpoint, more)

    def _policy(
        self, name: str, first: int, count: int, checkpoint: str, more: Sequence[str]
    ) -> dict[str, Any]:
        words = self._bench("lerobot", first, count, name)
        words += ["--set", f"checkpoint={self.folder / checkpoint}", "--set", "device=cpu"]
        return self._run_bench([*words, "--replan", str(REPLAN), *more], name)

    def takeover(self) -> dict[str, Any]:
        """The expert corrects the policy on seeds that neither training nor evaluation has."""
        more = ("--takeover", EXPERT, "--record", CAMERA)
        return self._policy("takeover", FIRST_CORRECTED, self.corrections, ACT, more)

    def corrected_dataset(self) -> dict[str, Any]:
        """The demonstrations, and the episodes that were taken over."""
        taken = [
            self.folder / "takeover" / "recordings" / f"lerobot.{self.task}.{each['seed']}.mcap"
            for each in self.rows["takeover"]["all"]
            if "taken_over_at" in each
        ]
        return self._export(self.folder / CORRECTED_DATA, taken)

    def cells(self, ours: str, theirs: str) -> dict[str, Any]:
        """Both evaluations of one policy, seed by seed."""
        return compare_cells(self.rows[ours]["all"], self.rows[theirs]["all"])

    def compare(self, before: str, after: str) -> dict[str, Any]:
        """Both on the same seeds."""
        words = ["compare", str(self.folder / before), str(self.folder / after), "--json"]
        told = subprocess.run(
            [sys.executable, "-m", "vla_zenoh", *words], capture_output=True, text=True, check=False
        )
        if told.returncode not in (0, B_IS_WORSE):
            raise NodeError(f"{_shown(words)}: {told.stderr.strip()}")
        return {"command": _shown(["vla-zenoh", *words]), **json.loads(told.stdout)}

    def constant(self, name: str, action: Sequence[float]) -> dict[str, Any]:
        model = str(Path(__file__).with_name("constant.py"))
        words = self._bench(model, FIRST_UNSEEN, self.episodes, name)
        told = ",".join(f"{each:.9g}" for each in action)
        return self._run_bench([*words, "--set", f"action={told}"], name)

    def expert(self) -> dict[str, Any]:
        words = self._bench(EXPERT, FIRST_UNSEEN, self.episodes, "expert")
        return self._run_bench(words, "expert")

    def theirs(self, name: str, checkpoint: str) -> dict[str, Any]:
        """``lerobot-eval`` on the same seeds, `BATCH` at a time."""
        out, command, cells = self.folder / name, "", list[dict[str, Any]]()
        policy = self.folder / checkpoint / LAST
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
            {"seed": each["episode"], **{k: each[k] for k in CELL if each[k] is not None}}
            for each in result["all"]
        ]
        more = {k: result[k] for k in ("mode", "delay_ms", "composition", "versions")}
        return {"command": command, **{k: result[k] for k in kept}, **more, "all": cells}

    def _vla_zenoh(self, words: Sequence[str]) -> str:
        _call([sys.executable, "-m", "vla_zenoh", *words], {})
        return _shown(["vla-zenoh", *words])

    def _lerobot(self, program: str, words: Sequence[str], log: Path | None = None) -> str:
        offline = {"HF_HUB_OFFLINE": "1", "MUJOCO_GL": "egl", "PYTHONPATH": str(ROOT)}
        _call([str(self.python.with_name(program)), *words], offline, log)
        return _shown([program, *words])

    def _anywhere(self, text: str) -> str:
        """A text without this computer's folders."""
        text = text.replace(str(self.python), "PYTHON").replace(str(self.folder), "OUTPUT")
        return text.replace(f"{ROOT}/", "")


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


def _call(command: Sequence[str], environ: dict[str, str], log: Path | None = None) -> None:
    """Run a command, whose output goes to stderr, and into `log` as well.

    Raises:
        NodeError: it ended with another status than 0.
    """
    own = {"cwd": ROOT, "env": {**os.environ, **environ}}
    if log is None:  # its stdout is not ours: with --json that has the rows
        status = subprocess.run(command, stdout=sys.stderr, check=False, **own).returncode
    else:
        with (
            log.open("ab") as file,
            subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **own
            ) as process,
        ):
            assert process.stdout is not None
            while told := os.read(process.stdout.fileno(), 65536):
                file.write(told)
                sys.stderr.buffer.write(told)
                sys.stderr.flush()
        status = process.returncode
    if status:
        raise NodeError(f"{_shown(command)} ended with status {status}")


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
    steps: Annotated[int, typer.Option(help="Of the training.")] = 6000,
    episodes: Annotated[int, typer.Option(help="Unseen seeds, from 1000.")] = 50,
    delays: Annotated[str, typer.Option(help="Of an inference, ms; empty: none.")] = ",".join(
        map(str, DELAYS_MS)
    ),
    save_every: Annotated[int, typer.Option(help="Training steps between checkpoints.")] = 500,
    train: Annotated[
        list[str] | None, typer.Option("--train", help="name=value for lerobot-train; repeatable.")
    ] = None,
    corrections: Annotated[
        int, typer.Option(help="Seeds from 2000 that the expert watches, and takes over.")
    ] = 50,
    more_steps: Annotated[
        int, typer.Option(help="Of the training after the expert's corrections.")
    ] = 3000,
    python: Annotated[
        Path | None,
        typer.Option(help="Interpreter of a prepared environment; default: one is made."),
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for figures of what was done, as SVG and PDF.")
    ] = None,
    until: Annotated[str, typer.Option(help="Name of the last step.")] = "",
    as_json: JsonOption = False,
) -> None:
    """Train a policy on demonstrations of Meta-World's expert; measure it by LeRobot and by us."""
    folder = output.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    found = (python or make_environment(folder / "env")).absolute()
    waits = [int(each) for each in delays.split(",") if each]
    sizes = (demonstrations, steps, episodes, waits, save_every, train or ())
    wheel = Flywheel(folder, found, task, *sizes, corrections, more_steps)
    plan: dict[str, Callable[[], dict[str, Any]]] = {
        "demonstrations": wheel.record,
        "dataset": wheel.export,
        "training": wheel.training,
        "native": lambda: wheel.policy("native"),
        "lerobot-eval": lambda: wheel.theirs("lerobot-eval", ACT),
        "cells": lambda: wheel.cells("native", "lerobot-eval"),
        "expert": wheel.expert,
        "zero": lambda: wheel.constant("zero", (0, 0, 0, 0)),
        "mean": lambda: wheel.constant("mean", mean_action(wheel.dataset)),
        "takeover": wheel.takeover,
        "corrected-dataset": wheel.corrected_dataset,
        "corrected-training": lambda: wheel.train_on(CORRECTED, wheel.folder / CORRECTED_DATA),
        "longer-training": lambda: wheel.train_on(LONGER, wheel.dataset),
        "corrected": lambda: wheel.policy("corrected", checkpoint=CORRECTED),
        "longer": lambda: wheel.policy("longer", checkpoint=LONGER),
        "native-to-corrected": lambda: wheel.compare("native", "corrected"),
        "longer-to-corrected": lambda: wheel.compare("longer", "corrected"),
        "corrected-lerobot-eval": lambda: wheel.theirs("corrected-lerobot-eval", CORRECTED),
        "corrected-cells": lambda: wheel.cells("corrected", "corrected-lerobot-eval"),
    }
    for delay_ms in waits:
        for way, words in WAYS.items():
            name = f"{way}-{delay_ms}ms"
            more = (*words, "--delay", str(delay_ms), "--set", f"horizon={CHUNK}")
            plan[name] = lambda name=name, more=more: wheel.policy(
                name, *more, checkpoint=CORRECTED
            )
    if until and until not in plan:
        raise typer.BadParameter(f"--until: the steps are {', '.join(plan)}")
    for name, do in plan.items():
        wheel.row(name, do)
        if name == until:
            break
    for file in write_figures(pictures, wheel.rows) if pictures is not None else ():
        print(file, file=sys.stderr)
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
