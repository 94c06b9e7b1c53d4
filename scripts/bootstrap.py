"""Makes ./.venv with the package and everything it is tested with; needs only Python.

The work is done by uv: the one on PATH, else one put into ./.tools. Versions come from
constraints.txt. pip's settings of indexes, wheel folders and certificates (``PIP_*`` variables,
pip.conf) are passed on to uv.
"""

from __future__ import annotations

import configparser
import ctypes
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
TOOLS = ROOT / ".tools"
UV_IN_VENV = TOOLS / "venv" / "bin" / "uv"
UV_IN_FOLDER = TOOLS / "uv" / "bin" / "uv"
CONSTRAINTS = ROOT / "constraints.txt"
PLUGINS = sorted(path.parent for path in (ROOT / "plugins").glob("*/pyproject.toml"))
"""Packages that bring robots, benchmarks and commands; their extras are left to who needs them."""

LARGE = "vla-zenoh-view"
"""The plug-in whose library unpacks to 500 MB: only `EVERYTHING` has it."""
ALL = "all"
"""The extra with which the packages of ``plugins/`` come; a choice of other extras has none."""

OLDEST_PYTHON = (3, 11)
OLDEST_UV = (0, 8)

EVERYTHING = "all,dev"
DEMO = "brick,sim"
SIZES_GB = {EVERYTHING: 2.7, DEMO: 0.8}

OPENMP = "libgomp.so.1"
"""Pinocchio needs it and no wheel of ours brings it; a bare Debian has no package that does."""
OPENMP_CARRIER = "scikit-learn"
"""A wheel that has the library inside, from where it can be taken without root."""

PIP_TO_UV = {
    # pip's name: uv's variable, what stands between several values there
    "index-url": ("UV_DEFAULT_INDEX", " "),
    "extra-index-url": ("UV_INDEX", " "),
    "find-links": ("UV_FIND_LINKS", ","),
    "trusted-host": ("UV_INSECURE_HOST", " "),
    "no-index": ("UV_NO_INDEX", " "),
    "cert": ("SSL_CERT_FILE", " "),
    "timeout": ("UV_HTTP_TIMEOUT", " "),
}


def pip_settings(environ: Mapping[str, str]) -> dict[str, str]:
    """pip's settings: from its files, then its variables, by the long name of the option."""
    home = Path(environ.get("HOME", "/nonexistent"))
    files = [
        Path("/etc/pip.conf"),
        home / ".pip" / "pip.conf",
        Path(environ.get("XDG_CONFIG_HOME") or home / ".config") / "pip" / "pip.conf",
        Path(environ.get("PIP_CONFIG_FILE") or "/etc/pip.conf"),
    ]
    parser = configparser.RawConfigParser()
    parser.read(files)
    settings = {}
    for section in ("global", "install"):
        if parser.has_section(section):
            settings.update(parser.items(section))
    settings.update(
        (name[len("PIP_") :].lower().replace("_", "-"), value)
        for name, value in environ.items()
        if name.startswith("PIP_") and value
    )
    if "default-timeout" in settings:
        settings.setdefault("timeout", settings["default-timeout"])
    return settings


def uv_environment(environ: Mapping[str, str]) -> dict[str, str]:
    """`environ` with pip's settings as uv's variables; uv's own settings stay."""
    result = dict(environ)
    settings = pip_settings(environ)
    for option, (variable, separator) in PIP_TO_UV.items():
        values = settings.get(option, "").split()
        if option == "find-links":
            # pip ignores folders that do not exist, uv stops at them.
            values = [value for value in values if "://" in value or Path(value).is_dir()]
        if values:
            result.setdefault(variable, separator.join(values))
    if "extra-index-url" in settings:
        # As pip does: the best version of all indexes, not of the first that knows the name.
        result.setdefault("UV_INDEX_STRATEGY", "unsafe-best-match")
    result.setdefault("UV_PYTHON_DOWNLOADS", "never")
    return result


def fail(message: str) -> None:
    """Ends the program with a message."""
    sys.exit("setup: " + message)


def say(message: str) -> None:
    """One line of progress."""
    print("setup: " + message, flush=True)


def run(*command: object) -> None:
    """Runs a command; ends the program when it fails."""
    words = [str(word) for word in command]
    if subprocess.run(words, cwd=ROOT, env=uv_environment(os.environ), check=False).returncode:
        fail("this failed, see above: " + " ".join(words))


def missing_packages(has_uv: bool) -> list[str]:
    """Debian packages without which nothing will work here."""
    if not has_uv and not any(map(importlib.util.find_spec, ("ensurepip", "pip"))):
        return ["python3-venv"]
    return []


def loads(library: str) -> bool:
    """Whether the system has a shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def drop_headers(environment: Path) -> None:
    """Remove C++ headers of Boost and Pinocchio, 200 MB that only a compiler reads."""
    for packages in (environment / "lib").glob("python*/site-packages"):
        shutil.rmtree(packages / "cmeel.prefix" / "include", ignore_errors=True)


def bring_openmp(uv: Path, python: Path) -> None:
    """Puts the OpenMP library beside Pinocchio's own libraries, where those look for it."""
    if sys.platform != "linux" or loads(OPENMP):
        return
    code = "import sysconfig; print(sysconfig.get_path('platlib'))"
    packages = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True)
    place = Path(packages.stdout.strip()) / "cmeel.prefix" / "lib"
    if (place / OPENMP).exists() or not place.is_dir():
        return
    say(f"this system has no {OPENMP}; taking it from the wheel of {OPENMP_CARRIER}")
    with tempfile.TemporaryDirectory() as folder:
        target = ["--python", python, "--target", folder, "--no-deps"]
        run(uv, "--quiet", "pip", "install", *target, OPENMP_CARRIER)
        found = sorted(Path(folder).glob("*.libs/libgomp*.so*"))
        if not found:
            fail("no OpenMP library to be had. On Debian and Ubuntu: sudo apt install libgomp1")
        shutil.copy(found[0], place / OPENMP)


def works(uv: Path) -> bool:
    """Whether `uv` runs and is new enough."""
    try:
        done = subprocess.run([uv, "--version"], capture_output=True, text=True, check=False)
    except OSError:
        return False
    match = re.match(r"uv (\d+)\.(\d+)", done.stdout)
    return bool(match) and tuple(map(int, match.groups())) >= OLDEST_UV


def find_uv() -> Path | None:
    """uv on PATH, or the one put into ./.tools before."""
    on_path = shutil.which("uv")
    for known in ([Path(on_path)] if on_path else []) + [UV_IN_VENV, UV_IN_FOLDER]:
        if works(known):
            return known
    return None


def install_uv() -> Path:
    """Puts uv into ./.tools with the installer that this Python has."""
    install = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    install += ["--constraint", str(CONSTRAINTS), "uv"]
    say("installing uv into .tools")
    if importlib.util.find_spec("ensurepip"):
        run(sys.executable, "-m", "venv", "--clear", TOOLS / "venv")
        run(TOOLS / "venv" / "bin" / "python", *install)
        return UV_IN_VENV
    # Debian without python3-venv, but with python3-pip.
    folder = ["--root-user-action", "ignore", "--upgrade", "--target", TOOLS / "uv"]
    run(sys.executable, *install, *folder)
    return UV_IN_FOLDER


def plugins_of(extras: str) -> list[Path]:
    """Packages of ``plugins/`` that are installed with these extras."""
    if ALL not in extras.split(","):
        return []
    return [path for path in PLUGINS if extras == EVERYTHING or path.name != LARGE]


def make_venv(uv: Path) -> None:
    """An environment of this interpreter at ./.venv, unless a usable one is there."""
    code = f"import sys; sys.exit(sys.version_info[:2] != {tuple(sys.version_info[:2])!r})"
    try:
        if subprocess.run([VENV / "bin" / "python", "-c", code], check=False).returncode == 0:
            return
    except OSError:
        pass
    run(uv, "--quiet", "venv", "--clear", "--python", sys.executable, VENV)


def main() -> None:
    """Sets everything up, or says what is missing; the argument names the extras."""
    extras = sys.argv[1] if len(sys.argv) > 1 else EVERYTHING
    if sys.version_info < OLDEST_PYTHON:
        fail(
            "Python {}.{} or newer is needed, this is {}.{} ({}). "
            "Name another one: make setup PYTHON=python3.12".format(
                *OLDEST_PYTHON, *sys.version_info[:2], sys.executable
            )
        )
    uv = find_uv()
    missing = missing_packages(has_uv=uv is not None)
    if missing:
        packages = " ".join(missing)
        fail("a part of the system is missing. On Debian and Ubuntu: sudo apt install " + packages)
    uv = uv or install_uv()
    make_venv(uv)
    size = f" (once; {SIZES_GB[extras]} GB on disk)" if extras in SIZES_GB else ""
    say(f"installing the package with the extras {extras} into .venv{size}")
    quiet = [] if sys.stderr.isatty() else ["--quiet"]
    target = ["--python", VENV / "bin" / "python", "--constraint", CONSTRAINTS]
    packages = [f".[{extras}]", *map(str, plugins_of(extras))]
    editable = [word for package in packages for word in ("--editable", package)]
    run(uv, *quiet, "pip", "install", *target, *editable)
    bring_openmp(uv, VENV / "bin" / "python")
    if extras == DEMO:
        drop_headers(VENV)
    say("done; the command is .venv/bin/vla-zenoh")


if __name__ == "__main__":
    main()
