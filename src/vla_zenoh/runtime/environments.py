"""Runs a model in an environment of its own, as its PEP 723 header asks.

Pins of different models cannot share one environment, so a model whose dependencies are missing
here is started again by uv, which makes (and keeps) an environment with the model's pins and this
package.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

from vla_zenoh import __version__
from vla_zenoh.errors import WorkerError, how_to_install
from vla_zenoh.plugins import (
    OURS,
    OWN_ENVIRONMENT_VARIABLE,
    how_to_repeat,
    in_own_environment,
    lacking_package,
)
from vla_zenoh.policy.loader import ModelFile
from vla_zenoh.runtime.process import die_with_parent


def run_in_own_environment(
    model: ModelFile,
    python: str | None,
    *,
    extra: str = "",
    packages: Sequence[str] = (),
    program: str = "vla_zenoh",
) -> None:
    """Replace this process by one in the right environment; returns if this one is right.

    Args:
        python: interpreter of a prepared environment, which must have this package and `extra`.
        extra: of this package, which the command needs besides the model's own packages.
        packages: more options of ``uv run`` that bring packages.

    Raises:
        WorkerError: another environment is needed and cannot be made.
        PluginError: it has a package of ``plugins/`` that is not installed here.
    """
    die_with_parent()  # before the model is constructed, which may take long or hang
    missing = model.missing()
    if in_own_environment():
        if missing:
            advice = lacking_package(missing) or "is the header right?"
            raise WorkerError(f"{model.path}: its environment lacks {', '.join(missing)}; {advice}")
        return
    if python is None and not missing:
        return
    if python is not None:
        _check_interpreter(python)
        command = [python]
    else:
        command = [*environment_command(model, extra=extra), *packages, "python"]
        print(
            f"preparing an environment for {model.name}: {', '.join(model.dependencies)} "
            "(the first time takes minutes, later ones seconds)",
            file=sys.stderr,  # on stdout `vla-zenoh check --json` writes its result
            flush=True,
        )
    os.environ[OWN_ENVIRONMENT_VARIABLE] = f"{model.name}={model.path}"
    os.execvp(command[0], [*command, "-m", program, *sys.argv[1:]])


def _check_interpreter(python: str) -> None:
    if shutil.which(python) is None:
        raise WorkerError(
            f"--python {python!r} is not a program: give the interpreter of an environment, as "
            "venv/bin/python"
        )
    look = "import importlib.util as u, sys; sys.exit(u.find_spec('vla_zenoh') is None)"
    try:
        absent = subprocess.run([python, "-c", look], capture_output=True).returncode
    except OSError as error:
        raise WorkerError(f"--python {python!r} cannot be run: {error.strerror}") from error
    if absent:
        raise WorkerError(
            f"--python {python!r} has no vla-zenoh; install it there: {how_to_install()}"
        )


def environment_command(
    model: ModelFile, more: Sequence[str] = (), *, extra: str = ""
) -> list[str]:
    """Command line that runs a command in the environment that the model's header asks for, with
    `more` packages and an `extra` of this one; uv makes it the first time and keeps it.

    Raises:
        WorkerError: there is no uv.
        PluginError: the header names a package of ``plugins/`` that is not installed here.
    """
    brought: list[str] = []
    for requirement in (*model.dependencies, *more):
        ours = requirement.startswith(OURS)
        brought += how_to_repeat(requirement) if ours else ["--with", requirement]
    beside = Path(sysconfig.get_path("scripts")) / "uv"
    uv = str(beside) if beside.is_file() else shutil.which("uv")
    if uv is None:
        raise WorkerError(
            f"model {model.name!r} needs {', '.join(model.dependencies)}. Install uv (pip install "
            "uv) and it gets an environment of its own, or name a prepared one with --python"
        )
    # Isolated, because uv would put the packages of a .venv in the working directory below.
    command = [uv, "run", "--no-project", "--isolated"]
    if not sys.stderr.isatty():  # a terminal gets its progress
        command.append("--quiet")
    if model.requires_python:
        command += ["--python", model.requires_python]
    command += brought
    # The package that is running now: the checkout, else the same version.
    extras = f"[{extra}]" if extra else ""
    checkout = Path(__file__).resolve().parents[3]
    if (checkout / "pyproject.toml").is_file() and (checkout / "src" / "vla_zenoh").is_dir():
        return [*command, "--with-editable", f"{checkout}{extras}"]
    return [*command, "--with", f"vla-zenoh{extras}=={__version__}"]
