"""python -m benchmarks openvla."""

from __future__ import annotations

import importlib
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text
from vla_zenoh_benchmarks.result_file import ResultOptions, write_json

from vla_zenoh.cli.options import model_options, options
from vla_zenoh.errors import WorkerError
from vla_zenoh.policy.loader import find_model, import_model, make_policy, module_name
from vla_zenoh.policy.options import one_of
from vla_zenoh.runtime.environments import run_in_own_environment

NAME = "openvla"
DTYPES = ("bfloat16", "float16", "float32")


@options
def openvla(
    output: ResultOptions,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Option of the worker as name=value; checkpoint=DIR."),
    ] = None,
    full_size: Annotated[
        bool,
        typer.Option("--full-size", help="Random weights of the published size, 15 GB in bfloat16"),
    ] = False,
    rounds: Annotated[int, typer.Option("--rounds", min=1, max=1000)] = 20,
    python: Annotated[
        str | None, typer.Option("--python", help="Interpreter of a prepared environment.")
    ] = None,
) -> None:
    """Measure OpenVLA: time and memory of each stage, beside transformers' own generation.

    Runs in OpenVLA's environment, without robot, camera or Zenoh.
    """
    chosen = model_options(settings or [])
    if full_size == ("checkpoint" in chosen):
        raise typer.BadParameter("give either --set checkpoint=DIR or --full-size")
    model = find_model(NAME)
    run_in_own_environment(model, python, program="benchmarks")
    import_model(model)
    with output.open() as file:
        report = _full_size(rounds, chosen) if full_size else _loaded(rounds, chosen)
        write_json(file, report)
    memory = ", ".join(f"{part} {mb:.0f} MB" for part, mb in report["memory_mb"].items())
    same = ("yes", "") if report["same_tokens"] else ("no", "bold")
    agree = Text.assemble("both ways gave the same tokens: ", same)
    output.show(report, _table(report), f"memory: {memory}", agree)


def _part(name: str) -> Any:
    return importlib.import_module(f"{module_name(NAME)}.{name}")


def _full_size(rounds: int, options: dict[str, str]) -> dict[str, Any]:
    torch = importlib.import_module("torch")
    unknown = sorted(set(options) - {"device", "dtype", "quantise"})
    if unknown:
        raise WorkerError(f"--full-size takes device, dtype and quantise, not {unknown[0]!r}")
    device = options.get("device") or ("cuda" if torch.cuda.is_available() else "cpu")
    measure = _part("measure")
    network = measure.random_network(
        measure.full_size(),
        device=device,
        dtype=getattr(torch, one_of("dtype", options.get("dtype", "bfloat16"), DTYPES)),
        kind=one_of("quantise", options.get("quantise", "none"), ("none", "int8", "nf4")),
    )
    return measure.measure(network, "published size, random weights", rounds).to_dict()


def _loaded(rounds: int, options: dict[str, str]) -> dict[str, Any]:
    policy: Any = make_policy(find_model(NAME), options)
    policy.load()
    return _part("measure").measure(policy.network, options["checkpoint"], rounds).to_dict()


def _table(report: dict[str, Any]) -> Table:
    table = Table(
        title=(
            f"OpenVLA, {report['what']}, {report['parameters'] / 1e9:.3g} billion parameters\n"
            f"{report['device']}, {report['dtype']}, torch {report['torch']}, "
            f"transformers {report['transformers']}"
        )
    )
    table.add_column("stage")
    for column in ("times", "p50 ms", "p95 ms"):
        table.add_column(column, justify="right")
    for stage in report["stages"]:
        if stage["name"] == "action":
            table.add_section()
        name = {
            "action": "all from vision on, this worker",
            "generate": "the same by transformers' generate, as published",
        }.get(stage["name"], stage["name"])
        numbers = (f"{stage['p50_ms']:.1f}", f"{stage['p95_ms']:.1f}")
        table.add_row(name, str(stage["times"]), *numbers)
    return table
