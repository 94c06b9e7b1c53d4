"""Makes a Python environment with ROS 2's own rclpy on Fast DDS, for the tests.

    .venv/bin/python scripts/ros2_environment.py jazzy kilted
    .venv/bin/python scripts/ros2_environment.py --path jazzy      # its Python, if it is there

ROS 2's wheels are for Python 3.11. tests/ros2/ros_side/DISTRIBUTION.txt has their versions. The
interfaces that no wheel has are built with the wheels' own rosidl: those of the package
plugins/vla-zenoh-ros2 (its folder ``text``) and tests/ros2/ros_side/interfaces. An environment is
kept in the user's cache folder, as the bridge is, and made anew only when one of these files
changes. Needs CMake, a C++ compiler and Python's headers; ``--packages`` prints what Debian lacks
of them.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path

from bootstrap import uv_environment

ROOT = Path(__file__).resolve().parent.parent
TESTS = ROOT / "tests" / "ros2" / "ros_side"
CMAKE = TESTS / "interfaces" / "CMakeLists.txt"
OWN_TEXT = ROOT / "plugins" / "vla-zenoh-ros2" / "src" / "vla_zenoh_ros2" / "text"
PACKAGES = {
    "tf2_msgs": (TESTS / "interfaces", ("geometry_msgs",)),
    "franka_msgs": (OWN_TEXT, ("action_msgs",)),
    "multi_mode_control_msgs": (OWN_TEXT, ("geometry_msgs",)),
}
"""ROS package -> folder it is in, and the packages whose types it uses."""
MANIFEST = """\
<?xml version="1.0"?>
<package format="3">
  <name>{name}</name>
  <version>0.0.0</version>
  <description>Interfaces for tests</description>
  <maintainer email="nobody@example.com">nobody</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  {needs}
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""
DISTRIBUTIONS = ("jazzy", "kilted")
BUILDERS_PYTHON = "/opt/python/cp311-cp311"
"""The wheels' CMake files name the Python they were built with."""


def sources(distribution: str) -> list[Path]:
    """The files an environment is made of."""
    interfaces = [
        path
        for package, (folder, _) in PACKAGES.items()
        for path in sorted((folder / package).rglob("*.*"))
    ]
    return [TESTS / f"{distribution}.txt", CMAKE, *interfaces]


def cache_folder(distribution: str) -> Path:
    """Folder of a distribution's environment."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    text = b"".join(path.read_bytes() for path in sources(distribution))
    digest = hashlib.sha256(text).hexdigest()[:16]
    return base / "vla-zenoh" / f"ros2-{distribution}" / digest


def python_of(distribution: str) -> Path | None:
    """The environment's Python, once it is complete."""
    folder = cache_folder(distribution)
    return folder / "bin" / "python" if (folder / ".complete").is_file() else None


def run(environ: Mapping[str, str], *command: object) -> None:
    """Run a command, quietly if it succeeds; ends the program when it fails."""
    words = [str(word) for word in command]
    done = subprocess.run(
        words, env=environ, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"{done.stdout}\nros2-environment: this failed, see above: {' '.join(words)}")


def make(distribution: str) -> Path:
    """Make an environment in the cache folder; its Python."""
    folder = cache_folder(distribution)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (folder.parent / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another checkout may be at it
        found = python_of(distribution)
        if found:
            return found
        print(f"ros2-environment: {distribution} into {folder} (once; two minutes)", flush=True)
        shutil.rmtree(folder, ignore_errors=True)
        environ = uv_environment(os.environ)
        uv = Path(sysconfig.get_path("scripts")) / "uv"
        python = folder / "bin" / "python"
        pins = TESTS / f"{distribution}.txt"
        run(environ, uv, "venv", "--quiet", "--python", "3.11", folder)
        run(environ, uv, "pip", "install", "--quiet", "--python", python, "-r", pins)
        name_our_python(folder)
        for package in PACKAGES:
            build(folder, package)
        run(os.environ, python, "-c", f"import rclpy, {', '.join(PACKAGES)}")
        (folder / ".complete").touch()
    return python


def name_our_python(folder: Path) -> None:
    """Let CMake look into this environment, and not where the wheels were built."""
    ask = "import sysconfig; print(sysconfig.get_path('include'))"
    words = [str(folder / "bin" / "python"), "-c", ask]
    headers = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()
    if not (Path(headers) / "Python.h").is_file():
        sys.exit(f"ros2-environment: no {headers}/Python.h. On Debian: apt install python3-dev")
    site = next(folder.glob("lib/python3*/site-packages"))
    for path in folder.glob("share/*/cmake/*.cmake"):
        text = path.read_text()
        if BUILDERS_PYTHON in text:
            path.unlink()  # uv shares files between environments
            text = text.replace(f"{BUILDERS_PYTHON}/include/python3.11", headers)
            text = text.replace(f"{BUILDERS_PYTHON}/lib/python3.11/site-packages", str(site))
            path.write_text(text)


def build(folder: Path, package: str) -> None:
    """Build a ROS package of interfaces into an environment."""
    place, needs = PACKAGES[package]
    scratch = folder / "build" / package
    shutil.copytree(place / package, scratch / "interfaces")
    shutil.copy(CMAKE, scratch)
    depends = "".join(f"<depend>{need}</depend>" for need in needs)
    (scratch / "package.xml").write_text(MANIFEST.format(name=package, needs=depends))
    environ = {
        **os.environ,
        "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
        "LD_LIBRARY_PATH": str(folder / "lib"),
        "AMENT_PREFIX_PATH": str(folder),
        # Otherwise each Python of the environment starts itself once more.
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
    }
    python = folder / "bin" / "python"
    settings = {
        "PACKAGE": package,
        "FOLDER": scratch / "interfaces",
        "NEEDS": ";".join(needs),
        "CMAKE_PREFIX_PATH": folder,
        "CMAKE_INSTALL_PREFIX": folder,
        "Python3_EXECUTABLE": python,
        "PYTHON_EXECUTABLE": python,
        "BUILD_TESTING": "OFF",
    }
    words = [f"-D{name}={value}" for name, value in settings.items()]
    run(environ, "cmake", "-S", scratch, "-B", scratch / "build", *words)
    jobs = os.cpu_count() or 1
    run(environ, "cmake", "--build", scratch / "build", "--target", "install", "-j", jobs)


def missing_packages() -> list[str]:
    """Debian packages without which an environment cannot be made here."""
    lacking = []
    if shutil.which("cmake") is None:
        lacking.append("cmake")
    if not any(map(shutil.which, ("c++", "g++", "clang++"))):
        lacking += ["g++", "make"]
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        lacking.append("python3-dev")
    return lacking


def main() -> None:
    """Make the environments that are named, unless they are there."""
    arguments = sys.argv[1:]
    if arguments == ["--packages"]:
        print(" ".join(missing_packages()))
        return
    options, chosen = set(arguments) & {"--path"}, [one for one in arguments if one != "--path"]
    unknown = [one for one in chosen if one not in DISTRIBUTIONS]
    if unknown or not chosen:
        sys.exit(f"usage: ros2_environment.py [--path] {' | '.join(DISTRIBUTIONS)} ...")
    for one in chosen:
        if options:
            print(python_of(one) or sys.exit(f"no environment of {one}: make test-ros2"))
        else:
            print(f"ros2-environment: {one} is {make(one)}")


if __name__ == "__main__":
    main()
