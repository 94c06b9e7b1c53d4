"""Checks of software: Python, libraries, OpenGL, the robot description."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from importlib import metadata

from vla_zenoh.errors import MissingExtraError, NodeError, VlaZenohError, how_to_install
from vla_zenoh.lab.doctor.needs import HostFinding, Role, judged, nodes_on
from vla_zenoh.profile import Profile
from vla_zenoh.simulation.backend import RAYCAST, VARIABLE, Backend, choose_backend

LIMIT_S = 60

MODULES: Mapping[Role, Mapping[str, str]] = {
    # role: {module: distribution that brings it}
    "base": {
        "zenoh": "eclipse-zenoh",
        "msgspec": "msgspec",
        "numpy": "numpy",
        "simplejpeg": "simplejpeg",
        "pydantic": "pydantic",
        "yaml": "pyyaml",
    },
    "camera": {"cv2": "opencv-python-headless"},
    "control": {"pinocchio": "pin", "ruckig": "ruckig", "daqp": "daqp"},
    "sim": {"mujoco": "mujoco-core", "av": "av"},
}
PURPOSE: Mapping[Role, str] = {
    "base": "workers, programs that drive",
    "camera": "cameras",
    "control": "command node",
    "sim": "simulator",
}
VERSIONS: Mapping[str, tuple[tuple[int, ...], tuple[int, ...] | None]] = {
    # distribution: oldest that works, first that is not known to work
    "eclipse-zenoh": ((1, 10), (2,)),
    "numpy": ((1, 26), None),
    "mujoco-core": ((4,), (5,)),
    "pin": ((4,), None),
}
SYSTEM_PACKAGES = {
    # shared library a wheel did not bring: Debian and Ubuntu package
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libglib-2.0.so.0": "libglib2.0-0",
    "libgthread-2.0.so.0": "libglib2.0-0",
    "libgomp.so.1": "libgomp1",
    "libstdc++.so.6": "libstdc++6",
    "libxcb.so.1": "libxcb1",
}

# In an interpreter of its own, which a broken library may crash.
_PROBE = """
import importlib, json, sys
print(json.dumps(None), flush=True)
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
        error = None
    except BaseException as caught:
        error = f"{type(caught).__name__}: {caught}"
    print(json.dumps([name, error]), flush=True)
"""


def load_errors(modules: list[str]) -> dict[str, str]:
    """Module -> why it cannot be imported, found out in another process."""
    command = [sys.executable, "-c", _PROBE, *modules]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=LIMIT_S)
        output, end = done.stdout, f"the interpreter ended with status {done.returncode}"
    except subprocess.TimeoutExpired as error:
        output = error.stdout.decode() if isinstance(error.stdout, bytes) else error.stdout or ""
        end = f"not loaded within {LIMIT_S} s"
    seen = dict(pair for pair in map(json.loads, output.splitlines()) if pair)
    errors = {name: error for name, error in seen.items() if error is not None}
    for name in modules:
        if name not in seen:
            errors[name] = end
            break
    return errors


def version_fault(distribution: str, version: str) -> str:
    """Why `version` is not supported, empty: it is."""
    oldest, first_unknown = VERSIONS.get(distribution, ((), None))
    numbers = tuple(int(part) for part in re.findall(r"\d+", version)[:3])
    if numbers < oldest:
        return f"{distribution} {version} is too old"
    if first_unknown is not None and numbers >= first_unknown:
        return f"{distribution} {version} is too new"
    return ""


def libraries(role: Role, *, required: bool) -> HostFinding:
    """The libraries of a role are installed, load, and have a supported version."""
    name = f"libraries: {PURPOSE[role]}"
    level = "fail" if required else "warn"
    install = how_to_install("" if role == "base" else role)
    missing, wrong, versions = [], [], []
    for module, distribution in MODULES[role].items():
        try:
            version = metadata.version(distribution)
        except metadata.PackageNotFoundError:
            missing.append(module)
            continue
        versions.append(f"{distribution} {version}")
        wrong.append(version_fault(distribution, version))
    errors = load_errors([module for module in MODULES[role] if module not in missing])
    if missing:
        return HostFinding(name, level, f"not installed: {', '.join(missing)}", install)
    if errors:
        text = "; ".join(f"{module} does not load ({error})" for module, error in errors.items())
        packages = sorted({deb for so, deb in SYSTEM_PACKAGES.items() if so in text})
        if packages:
            return HostFinding(name, level, text, f"sudo apt install {' '.join(packages)}")
        return HostFinding(name, level, text, f"{install} --force-reinstall")
    text = "; ".join(fault for fault in wrong if fault) or ", ".join(versions)
    return judged(name, not any(wrong), text, f"{install} --upgrade", level)


NAME = "pictures"


def opengl(wanted: str | None = None) -> HostFinding:
    """The renderer of the simulator.

    Args:
        wanted: ``auto`` or a backend; None: from the environment.
    """
    try:
        return renderer_finding(choose_backend(wanted))
    except NodeError as error:
        advice = f"do what it says, or let the simulator choose: unset {VARIABLE}"
        return HostFinding(NAME, "fail", str(error), advice)


def renderer_finding(backend: Backend) -> HostFinding:
    if backend.name != RAYCAST:
        return HostFinding(NAME, "ok", f"drawn by OpenGL through {backend.name}")
    if not backend.reason:
        return HostFinding(NAME, "ok", "ray cast, as requested")
    return HostFinding(
        NAME,
        "warn",
        f"ray cast, which is slower: no OpenGL without a screen ({backend.reason})",
        f"sudo apt install {backend.install} (with an NVIDIA card also its driver's libnvidia-gl; "
        "in a container with one: NVIDIA_DRIVER_CAPABILITIES=all)",
    )


def robot(profile: Profile, host: str | None = None) -> Iterator[HostFinding]:
    """The robot description loads, with meshes and every name in the profile.

    Args:
        host: which of its hosts this computer is; None: all of them. Hosts without the command
            node have no finding.
    """
    if "command" not in nodes_on(profile, host):
        return
    try:
        from vla_zenoh.control.reachability import ReachabilityFilter

        ReachabilityFilter(profile)
    except (MissingExtraError, ImportError):
        return  # see `libraries`
    except (VlaZenohError, ValueError) as error:  # ValueError: Pinocchio's, of a malformed URDF
        advice = "vla-zenoh profile check"
        yield HostFinding("robot", "fail", f"{profile.robot.description}: {error}", advice)
        return
    joints = len(profile.robot.arm_joints)
    yield HostFinding("robot", "ok", f"{joints} joints, with collision shapes")
