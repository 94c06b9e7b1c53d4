"""Finds or builds a zenoh-bridge-ros2dds for the tests, and prints its path.

The one on PATH is used if there is one. Otherwise the program of tests/ros2_bridge/ is built: the
plugin's crate with a small main. It is built once and kept in the user's cache folder, and rebuilt
only when its sources change. Needs only Python, like the other scripts here; and, to build, Rust
(1.95 is tried), CMake, a C compiler and libclang.
"""

from __future__ import annotations

import ctypes.util
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NoReturn

PROGRAM = "zenoh-bridge-ros2dds"
PLUGIN = "zenoh-plugin-ros2dds"
SOURCES = Path(__file__).resolve().parent.parent / "tests" / "ros2_bridge"

LIBCLANG_PLACES = (
    "/usr/lib/llvm-*/lib/libclang.so*",
    "/usr/lib/llvm-*/lib/libclang-[0-9]*.so*",
    "/usr/lib/*/libclang-[0-9]*.so*",
    "/usr/lib64/libclang.so*",
)


def cache_folder() -> Path:
    """Folder of builds: one for each version of the sources."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    text = b"".join((SOURCES / name).read_bytes() for name in ("Cargo.toml", "src/main.rs"))
    return base / "vla-zenoh" / "ros2-bridge" / hashlib.sha256(text).hexdigest()[:16]


def find_bridge() -> Path | None:
    """The bridge on PATH, or the one built before."""
    on_path = shutil.which(PROGRAM)
    if on_path:
        return Path(on_path)
    built = cache_folder() / PROGRAM
    return built if built.is_file() else None


def has_libclang() -> bool:
    """Whether bindgen, which makes the bindings to Cyclone DDS, will find its library."""
    if os.environ.get("LIBCLANG_PATH") or ctypes.util.find_library("clang"):
        return True
    return any(list(Path("/").glob(place.lstrip("/"))) for place in LIBCLANG_PLACES)


def missing() -> dict[str, str]:
    """Missing build requirement -> package that brings it on Debian."""
    lacking = {}
    if shutil.which("cmake") is None:
        lacking["cmake"] = "cmake"
    if not any(map(shutil.which, ("cc", "gcc", "clang"))):
        lacking["a C compiler"] = "gcc libc6-dev"
    if not has_libclang():
        lacking["libclang"] = "libclang-dev"
    if shutil.which("cargo") is None:
        lacking["cargo 1.85 or newer"] = "cargo"
    return lacking


def say(message: str) -> None:
    """One line of progress."""
    print("ros2-bridge: " + message, flush=True)


def fail(message: str) -> NoReturn:
    """Ends the program with a message."""
    sys.exit("ros2-bridge: " + message)


def run(*command: object, folder: Path) -> str:
    """Output of a command; ends the program when it fails."""
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=folder, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        fail("this failed, see above: " + " ".join(words))
    return done.stdout


def lock_as_the_plugin_does(folder: Path) -> None:
    """Take the plugin's own versions of its dependencies, which its crate brings along.

    Without them every build would take the newest ones of that day.
    """
    described = json.loads(run("cargo", "metadata", "--format-version", "1", folder=folder))
    manifest = next(p["manifest_path"] for p in described["packages"] if p["name"] == PLUGIN)
    shutil.copy(Path(manifest).parent / "Cargo.lock", folder / "Cargo.lock")


def build() -> Path:
    """Build the bridge and put it into the cache folder."""
    lacking = missing()
    if lacking:
        fail(
            f"to build {PROGRAM} these are missing: {', '.join(lacking)}. On Debian and Ubuntu: "
            f"sudo apt install {' '.join(lacking.values())}. Or put a {PROGRAM} on PATH"
        )
    target = cache_folder()
    target.mkdir(parents=True, exist_ok=True)
    say(f"building {PROGRAM} into {target} (once; some five minutes on two processors)")
    with tempfile.TemporaryDirectory(dir=target, prefix="build-") as name:
        folder = Path(name)
        shutil.copytree(SOURCES, folder, dirs_exist_ok=True)
        lock_as_the_plugin_does(folder)
        run("cargo", "build", "--release", "--target-dir", folder / "target", folder=folder)
        # A rename within one folder: a build that is interrupted leaves no half of a program.
        (folder / "target" / "release" / PROGRAM).rename(target / PROGRAM)
    return target / PROGRAM


def main() -> None:
    """Build unless there is one, and print where it is.

    ``--path``: print the path of the one that is there, alone. ``--packages``: what Debian lacks
    for building one.
    """
    found = find_bridge()
    if sys.argv[1:] == ["--path"]:
        print(found or fail(f"there is no {PROGRAM} here: make ros2-bridge"))
        return
    if sys.argv[1:] == ["--packages"]:
        print("" if found else " ".join(missing().values()))
        return
    say(f"the bridge is {found or build()}")


if __name__ == "__main__":
    main()
