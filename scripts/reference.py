"""Writes docs/reference/ from the code: profile fields, keys, commands, counters.

python scripts/reference.py            # write
python scripts/reference.py --check    # exit status 1 where a page differs from the code
"""

from __future__ import annotations

import argparse
import ast
import inspect
import json
import re
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from typer.main import get_command
from vla_zenoh_franka.check import BY_FCI, JOINTS

import vla_zenoh
from vla_zenoh.keys import KEY_PATHS
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.lab.recording.record_types import RECORDS
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.profile.section import Section
from vla_zenoh.program.main import app, examples
from vla_zenoh.security.roles import OWN, TABLE
from vla_zenoh.types import Cause, ClockReply, Header
from vla_zenoh.types.form import bound_text, form_of
from vla_zenoh.types.form import described as in_words

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "reference"
SOURCE = Path(vla_zenoh.__file__).parent
MADE = "<!-- Made by scripts/reference.py from the code: do not edit. -->\n\n"


# -- profile ------------------------------------------------------------------------------------
def described(kind: type) -> dict[str, str]:
    """Field -> text, from the ``Args:`` of a docstring."""
    text = inspect.cleandoc(kind.__doc__ or "")
    _, _, arguments = text.partition("Args:\n")
    found: dict[str, str] = {}
    name = ""
    for line in arguments.splitlines():
        start = re.match(r"    (\w+): ?(.*)", line)
        if start:
            name = start[1]
            found[name] = start[2]
        elif name and line.startswith("        "):
            found[name] += " " + line.strip()
        elif line.strip():
            break
    return found


def first_paragraph(kind: Any) -> str:
    """First paragraph of a docstring, as one line."""
    text = inspect.cleandoc(kind.__doc__ or "")
    return " ".join(text.partition("\n\n")[0].split())


def type_text(kind: Any, paths: dict[type[BaseModel], str]) -> str:
    """A type as a person writes it in YAML."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        return type_text(arguments[0], paths)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(type_text(one, paths) for one in arguments if one is not type(None))
    if origin is typing.Literal:
        return " \\| ".join(f"`{one}`" for one in arguments)
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return f"list of {type_text(arguments[0], paths)}"
        return "[" + ", ".join(type_text(one, paths) for one in arguments) + "]"
    if origin is dict:
        return f"map to {type_text(arguments[1], paths)}"
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return f"[section](#{anchor(paths[kind])})"
    names = {float: "number", int: "integer", str: "text", bool: "true or false"}
    return names.get(kind, getattr(kind, "__name__", str(kind)))


def sections_of(kind: type[BaseModel]) -> dict[type[BaseModel], str]:
    """Section -> its path in the file, of all sections inside `kind`."""

    def inner(one: Any, path: str) -> Iterator[tuple[type[BaseModel], str]]:
        if isinstance(one, type) and issubclass(one, BaseModel):
            yield one, path
        if typing.get_origin(one) is dict:
            path = f"{path}.NAME"
        for argument in typing.get_args(one):
            yield from inner(argument, path)

    paths: dict[type[BaseModel], str] = {}
    waiting = [(kind, "")]
    while waiting:
        section, path = waiting.pop(0)
        if section not in paths:
            paths[section] = path
            inside: list[tuple[type[BaseModel], str]] = []
            for name, annotation in keys_here(section).items():
                inside += inner(annotation, f"{path}.{name}".lstrip("."))
            waiting[:0] = inside
    return paths


def keys_here(section: type[BaseModel]) -> Mapping[str, Any]:
    """Keys of a section -> types; of the profile also the sections of installed robot drivers."""
    if issubclass(section, Section):
        return section.keys_here()
    return {name: field.annotation for name, field in section.model_fields.items()}


def anchor(path: str) -> str:
    """Of a section's heading."""
    return path.lower().replace(".", "-").replace("_", "-") or "the-profile"


def default_text(field: FieldInfo) -> str:
    """Default of a field, as text."""
    if field.is_required():
        return "**required**"
    value = field.default if field.default is not PydanticUndefined else field.default_factory
    if isinstance(value, BaseModel) or callable(value):
        return ""
    if isinstance(value, str):
        return f"`{value}`" if value else ""
    if isinstance(value, tuple):
        return "`[" + ", ".join(str(one) for one in value) + "]`"
    return "" if value is None else f"`{str(value).lower() if isinstance(value, bool) else value}`"


def bounds_text(field: FieldInfo) -> str:
    """The range a number must be in."""
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    found = []
    for item in field.metadata:
        found += [
            f"{s} {bound_text(getattr(item, n))}" for n, s in signs.items() if hasattr(item, n)
        ]
    return ", ".join(found)


def profile_page() -> str:
    """Every section and field of a profile."""
    out = ["# Profile fields", MADE.strip()]
    out.append(
        "A profile is one YAML file. `vla-zenoh profile show NAME` prints one with all defaults, "
        "`vla-zenoh profile check FILE` finds what is wrong in it."
    )
    paths = sections_of(Profile)
    for section, path in paths.items():
        title = f"`{path}`" if path else "The profile"
        out.append(f"## {title} {{#{anchor(path)}}}\n\n{first_paragraph(section)}")
        texts: dict[str, str] = {}
        for base in reversed(section.__mro__):
            texts |= described(base)
        rows = ["| field | type | default | |", "|---|---|---|---|"]
        for name, field in section.model_fields.items():
            bounds = bounds_text(field)
            kind = type_text(field.annotation, paths) + (f", {bounds}" if bounds else "")
            text = texts.get(name, "").replace("|", "\\|")
            rows.append(f"| `{name}` | {kind} | {default_text(field)} | {text} |")
        for name in sorted(keys_here(section).keys() - section.model_fields.keys()):
            kind = type_text(keys_here(section)[name], paths)
            rows.append(f"| `{name}` | {kind} | | options of the driver `{name}` |")
        out.append("\n".join(rows))
    return "\n\n".join(out) + "\n"


# -- keys ---------------------------------------------------------------------------------------
def keys_page() -> str:
    """Every key, who may write it and who may read it."""
    out = ["# Keys", MADE.strip()]
    out.append(
        "All keys of a robot begin with `<root>/<robot>/`; the root is `vla` unless the profile "
        "says otherwise. Roles are those of certificates ([security](../how-to/security.md)); "
        "without certificates they are not checked."
    )
    rows = ["| key | payload | published by | read by |", "|---|---|---|---|"]
    for member, allowed in sorted(TABLE.items()):
        path = KEY_PATHS[member]
        text = path.path.replace("{", "<").replace("}", ">")
        writers = sorted({r.value for act in allowed if act in OWN for r in allowed[act]})
        readers = sorted({r.value for act in allowed if act not in OWN for r in allowed[act]})
        about = path.payload.replace("|", "\\|")
        rows.append(f"| `{text}` | {about} | {', '.join(writers)} | {', '.join(readers)} |")
    return "\n\n".join([*out, "\n".join(rows)]) + "\n"


# -- records ------------------------------------------------------------------------------------
def records_page() -> str:
    """Every record that travels, its fields with their limits, and what they mean."""
    out = ["# Records", MADE.strip()]
    out.append(
        "Each is a msgpack map with these names; [The wire](wire.md) says how it travels. A field "
        "with a default may be left out. Poses are those of the tool centre point (TCP) in the "
        "robot's base frame, quaternions are x, y, z, w; a twist is linear m/s, then angular "
        "rad/s, a wrench N, then Nm, along the base frame's axes at the TCP. Times end in `_ns`: "
        "nanoseconds since the Unix epoch. `wire/records.schema.json` is the same as a JSON "
        "Schema. A `ModelSpec` is described in [Models](../how-to/models.md)."
    )
    for kind in (Header, ClockReply, Cause, *RECORDS):
        if kind is ModelSpec:
            continue
        text, _, arguments = inspect.cleandoc(kind.__doc__ or "").partition("\n\nArgs:\n")
        meanings = field_meanings(arguments)
        rows = ["| field | on the wire | default | meaning |", "|---|---|---|---|"]
        for field in msgspec.inspect.type_info(form_of(kind).struct).fields:
            empty = field.default_factory is not msgspec.NODEFAULT
            given = "{}" if empty else "" if field.required else json.dumps(field.default)
            meaning = meanings.get(field.name, "")
            rows.append(f"| `{field.name}` | {in_words(field.type)} | {given} | {meaning} |")
        out += [f"## {kind.__name__}", text, "\n".join(rows)]
    return "\n\n".join(out) + "\n"


def field_meanings(arguments: str) -> dict[str, str]:
    """Field -> text of the lines below ``Args:``, where several fields may share one."""
    found: dict[str, str] = {}
    names: list[str] = []
    for line in arguments.splitlines():
        start = re.match(r"    (\w+(?:, \w+)*): ?(.*)", line)
        if start:
            names = start[1].split(", ")
            found |= dict.fromkeys(names, start[2])
        else:
            found |= {name: f"{found[name]} {line.strip()}" for name in names}
    return found


# -- commands -----------------------------------------------------------------------------------
VARIABLES = {
    "VLA_ZENOH_PROFILE": "the profile of every command that names none, as `--profile`; not of "
    "`demo` and `bench`, which simulate a robot of their own",
    "VLA_ZENOH_CONNECT": "where the router is, as `--connect`: `tcp/10.0.0.2:7447`",
    "VLA_ZENOH_LISTEN": "where the router of `up` and `node router` listens, as `--listen`",
    "VLA_ZENOH_HOST": "which host of the profile this computer is, as `--host`; see "
    "[Security](../how-to/security.md)",
    "VLA_ZENOH_PATH": "folders with `profiles/`, `models/` and `sim/` of your own, separated "
    "by `:`; their contents are found by name: `vla-zenoh up ur5`",
    "VLA_ZENOH_RENDERER": "`egl` or `raycast`, where `sim.renderer` is `auto`",
    "VLA_ZENOH_API_KEY": "of `serve policy`, as `--api-key`",
}


def commands_of(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    """A command and those under it."""
    if hasattr(command, "commands"):
        for name in command.commands:
            found = command.commands[name]
            if not found.hidden:
                yield from commands_of(found, f"{path} {name}")
    else:
        yield path, command


def option_row(parameter: Any) -> str:
    """One option or argument."""
    if parameter.param_type_name == "option":
        names = ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))
        text = parameter.help or ""
        default = parameter.default
    else:
        names, text, default = f"`{(parameter.name or '').upper()}`", "", None
        text = getattr(parameter, "help", None) or ""
    shown = "" if default in (None, (), [], False, "") or callable(default) else f"`{default}`"
    text = " ".join(text.split()).replace("|", "\\|")
    return f"| {names} | {shown} | {text} |"


def cli_page() -> str:
    """Every command with its options."""
    out = ["# Commands", MADE.strip()]
    for path, command in commands_of(get_command(app), "vla-zenoh"):
        help_text = inspect.cleandoc(command.help or "").replace("\b\n", "")
        out.append(f"## {path.removeprefix('vla-zenoh ')}\n\n{help_text}")
        shown = [p for p in command.params if p.name != "help" and not getattr(p, "hidden", False)]
        if shown:
            rows = ["| option | default | |", "|---|---|---|", *map(option_row, shown)]
            out.append("\n".join(rows))
        wanted = path.split()
        found = [text for words, text in examples() if words[: len(wanted)] == wanted]
        out.append("```sh\n" + "\n".join(found) + "\n```")
    rows = ["| variable | sets |", "|---|---|"]
    rows += [f"| `{name}` | {text} |" for name, text in VARIABLES.items()]
    out += ["## Environment variables", "\n".join(rows)]
    return "\n\n".join(out) + "\n"


# -- counters -----------------------------------------------------------------------------------
REASONS = {
    "before_activation": "chunk: its observation is older than the activation",
    "busy": "primitive: another one runs; ROS 2: too many requests at once",
    "cameras": "`seen`: more cameras than a model may have",
    "clock_step": "the wall clock was set",
    "cycle": "ROS: a transform that puts a frame above its own parent",
    "deleted": "a Zenoh `delete` on a key that takes puts",
    "device_lost": "teleop: the gamepad or SpaceMouse is gone",
    "encoding": "ROS image: an encoding that is not supported",
    "expired": "chunk: all of its steps are in the past",
    "foreign": "written by another source than the one that is followed",
    "foreign_camera": "status of a camera by a node that does not serve it",
    "foreign_scene": "`sim/scene` of another source",
    "foreign_spec": "spec by another source than the worker's",
    "foreign_status": "status by another source than the node's",
    "frame": "ROS: an unknown frame",
    "frozen": "ROS joint state: the time stamp does not advance",
    "future": "chunk: its observation is from the future",
    "holder": "more deadman tokens than are kept",
    "invalid": "NaN, or a value that the record does not allow",
    "joint_limit": "chunk: a joint target that is far outside its range",
    "malformed": "the payload does not decode",
    "meaning": "chunk: numbers that its spec does not allow",
    "middleware": "gripper command: no bridge carries a goal to the middleware of its action",
    "more_workers": "more workers than are kept",
    "no_attachment": "rmw_zenoh: no attachment",
    "no_gripper": "gripper command for an arm without a gripper",
    "no_header": "no header in the attachment",
    "not_measured": "chunk: it begins at the measured pose or joints, unknown shortly before",
    "out_of_order": "older than the one before",
    "outlived": "gripper command from before a stop",
    "oversize": "larger than the limit of its kind",
    "overtaken": "chunk: a newer one arrived before it was planned",
    "partial": "ROS joint state: some joints are missing",
    "peer_error": "the policy server answered with an error",
    "peer_gone": "the policy server closed the connection",
    "peer_mismatch": "the policy server is not what the options say",
    "peer_reply": "the policy server's answer does not decode",
    "peer_request": "the observation lacks what the policy server asks for",
    "peer_timeout": "the policy server did not answer in time",
    "replayed": "a sequence number that was received before",
    "reset_refused": "`sim/reset` that cannot be executed",
    "robot_silent": "gripper command while no state of the robot is heard",
    "robot_failed": "the robot's Python class raised",
    "schema": "another version of the wire",
    "seen": "what the model saw cannot be published",
    "shape": "wrong number of values",
    "simulation_fault": "the simulation became unstable",
    "spec_mismatch": "chunk: another spec than the one agreed at activation",
    "stale": "older than the limit of its kind",
    "step_m": "chunk: a delta of the TCP, or of a joint that slides, that is far too large",
    "step_rad": "chunk: a joint further than any turns, or a delta that is far too large",
    "superseded": "chunk: a newer one is in force",
    "too_many": "ROS: more frames than are kept",
    "too_many_models": "camera: more image sizes requested than are made",
    "truncated": "fewer bytes than the size says",
    "unencodable": "a record that cannot be encoded",
    "unknown_worker": "chunk of a worker that is not chosen",
    "workspace": "chunk: no goal of it is inside the workspace box",
}
COUNTERS = {
    "CAMERA.bad": "times a check began to reject its images",
    "CAMERA.broken": "images that could not be decoded",
    "CAMERA.depth": "depth images published",
    "CAMERA.jpeg": "JPEG images published",
    "CAMERA.losses": "times the camera was lost",
    "CAMERA.raw": "raw images published",
    "CAMERA.resized": "images resized for a model",
    "arm.commands_given": "set-points given to the Python class",
    "arm.missed_ticks": "ticks of the robot node that were skipped",
    "arm.stalls": "times the robot node stood still",
    "sim.missed_ticks": "ticks of the robot node that were skipped",
    "sim.stalls": "times the robot node stood still",
    "arm.stream_silences": "times the command stream fell silent",
    "command.chunks_dropped": "chunks dropped because more arrived than are kept",
    "command.gripper_timeouts": "gripper commands that the gripper did not execute in time",
    "command.latch_failed": "times the latch file could not be written",
    "command.missed_ticks": "ticks of the command node that were skipped",
    "command.smoothing_failures": "ticks without a plan of Ruckig, each an event `no_trajectory`",
    "dropped": "recorder: samples that were not written",
    "short_streams": "times too few of the samples that were sent arrived, see `net.short`",
    "lost": "rolling record: messages that were sent and never reached it",
    "missed": "rolling record: samples that came while the disk took none",
    "gripper_bounded": "gripper commands that were bounded",
    "ros2.commands_sent": "set-points sent to ROS 2",
    "ros2.efforts_missing": "joint states without efforts",
    "ros2.gripper_cancelled": "gripper goals cancelled",
    "ros2.gripper_goals": "gripper goals sent",
    "ros2.gripper_timeouts": "gripper goals given up",
    "ros2.missed_ticks": "ticks of the robot node that were skipped",
    "ros2.stalls": "times the robot node stood still",
    "ros2.stream_silences": "times the command stream fell silent",
    "ros2.unstamped": "joint states without a time stamp",
    "samples": "recorder, replay: samples written or published",
    "unknown_fields": "fields of records that this version does not know, ignored",
    "sim.overruns": "ticks of the simulator that were late, and stepped the world further",
    "sim.resets": "resets of the scene",
    "sim.stream_silences": "times the command stream fell silent",
    "sim.time_given_up_ms": "time in which the simulated world stood still: its process paused",
    "sim.torque_saturated": "control periods in which a torque limit acted",
}
REJECTING = {
    "refuse",
    "_refuse",
    "reject",
    "_reject",
    "CodecError",
    "PeerError",
    "Rejection",
}


def counted_in_code() -> tuple[set[str], set[str]]:
    """Reasons of rejections, and names of other counters, that are written in the code."""
    reasons, counters = set(), set()
    source = [path for path in SOURCE.rglob("*.py") if "cli" not in path.relative_to(SOURCE).parts]
    for name in ("diagnose", "policy-servers", "rolling", "ros2", "serve", "teleop"):
        source += (ROOT / "plugins" / f"vla-zenoh-{name}").rglob("*.py")
    for path in (*source, *(ROOT / "models").glob("*/wire.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and node.args:
                called = node.func
                name = called.attr if isinstance(called, ast.Attribute) else ast.unparse(called)
                first = node.args[0]
                if name in REJECTING and isinstance(first, ast.Constant):
                    reasons.add(str(first.value))
            if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Attribute):
                if node.value.attr == "counts" and path.name == "camera_publisher.py":
                    counters.add(f"CAMERA.{ast.literal_eval(node.slice)}")
                if node.value.attr.lstrip("_") != "counters":
                    continue
                if isinstance(node.slice, ast.Constant):
                    counters.add(str(node.slice.value))
                elif isinstance(node.slice, ast.JoinedStr):  # node.name before the last part
                    last = ast.unparse(node.slice).rpartition(".")[2].rstrip("'")
                    described = {name for name in COUNTERS if name.endswith(f".{last}")}
                    if not described and "reason" not in last:
                        sys.exit(f"scripts/reference.py: not described: {ast.unparse(node.slice)}")
                    counters |= described
    counters |= {f"CAMERA.{stream}" for stream in ("raw", "jpeg", "depth")}
    reasons |= {name.removeprefix("refused.") for name in counters if "refused." in name}
    return reasons, {name for name in counters if "refused." not in name}


def counters_page() -> str:
    """Every counter of a status, and every reason of a rejection."""
    reasons, counters = counted_in_code()
    for found, table in ((reasons, REASONS), (counters, COUNTERS)):
        if found != table.keys():
            missing, surplus = sorted(found - table.keys()), sorted(table.keys() - found)
            sys.exit(f"scripts/reference.py: not described: {missing}; not in the code: {surplus}")
    out = ["# Counters", MADE.strip()]
    out.append(
        "`vla-zenoh status --json` shows all counters of every node, the table of `vla-zenoh "
        "status` only those of rejected messages; record `NodeStatus`, field `counters`. They only "
        "grow while a node lives."
    )
    rows = ["| counter | counts |", "|---|---|"]
    rows += [f"| `{name}` | {text} |" for name, text in sorted(COUNTERS.items())]
    out.append("\n".join(rows))
    out.append(
        "## Rejected messages\n\n`refused.<reason>` counts messages that were rejected. Of chunks "
        "`superseded`, `before_activation`, `unknown_worker` and `overtaken` belong to normal "
        "operation: the command node counts them as `skipped.<reason>`. On a robot node `pose_`, "
        "`joint_` or `gripper_` stands before the reason of a command."
    )
    rows = ["| reason | why |", "|---|---|"]
    rows += [f"| `{name}` | {text} |" for name, text in sorted(REASONS.items())]
    out.append("\n".join(rows))
    return "\n\n".join(out) + "\n"


# -- limits of Franka arms ----------------------------------------------------------------------
FRANKA = "fr3", "panda_fci"


def franka_limits(profile: Profile) -> Iterator[tuple[str, str, str]]:
    """Each limit of an arm: its name, what Franka publishes, and what the profile allows."""
    published, ours = BY_FCI[profile.driver_options.fci], make_kinematics(profile)
    for index in range(JOINTS):
        yield (
            f"range of joint {index + 1}, rad",
            f"{published.lower_rad[index]:g} ... {published.upper_rad[index]:g}",
            f"{ours.lower_rad[index]:g} ... {ours.upper_rad[index]:g}",
        )
    for name in ("velocity_rad_s", "acceleration_rad_s2", "jerk_rad_s3"):
        allowed = profile.limits.joint.of(name, JOINTS)
        for index, bound in enumerate(getattr(published, name)):
            what = f"{name.split('_')[0]} of joint {index + 1}, {_unit(name)}"
            yield what, f"{bound:g}", f"{allowed[index]:g}"
    for section in ("translation", "rotation"):
        given = getattr(profile.limits, section)
        for bound, (name, value) in zip(getattr(published, section), given, strict=True):
            what = f"{name.split('_')[0]} of the TCP's {section}, {_unit(name)}"
            yield what, f"{bound:g}", f"{value:g}"


def franka_limits_page() -> str:
    """What Franka publishes beside what the profiles allow."""
    fr3, panda = (list(franka_limits(load_profile(name))) for name in FRANKA)
    out = ["# Limits of Franka arms", MADE.strip()]
    out.append(
        'What Franka publishes ("Robot and interface specifications" of the documentation of '
        "the Franka Control Interface), and what the profiles `fr3` and `panda_fci` allow. An arm "
        "whose commands come late brakes at up to twice the profile's limits, and the profile's "
        "limits of the TCP are per axis: what comes out stays below Franka's. Where the FR3 "
        "allows a joint less speed near an end of its range, braking at the profile's limits "
        "stays below that, too (`tests/unit/robots/test_franka_flange.py` checks all of it)."
    )
    head = ["limit", "FR3, published", "`fr3`", "Panda, published", "`panda_fci`"]
    rows = [[*row, *more[1:]] for row, more in zip(fr3, panda, strict=True)]
    cells = [head, ["---"] * len(head), *rows]
    out.append("\n".join(f"| {' | '.join(row)} |" for row in cells))
    return "\n\n".join(out) + "\n"


def _unit(name: str) -> str:
    return {
        "velocity_rad_s": "rad/s",
        "acceleration_rad_s2": "rad/s²",
        "jerk_rad_s3": "rad/s³",
        "velocity_m_s": "m/s",
        "acceleration_m_s2": "m/s²",
        "jerk_m_s3": "m/s³",
    }[name]


PAGE_OF = {
    "profile.md": profile_page,
    "keys.md": keys_page,
    "records.md": records_page,
    "cli.md": cli_page,
    "counters.md": counters_page,
    "franka-limits.md": franka_limits_page,
}


def main() -> None:
    """Write the pages, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    options = parser.parse_args()
    stale = []
    for name, make in PAGE_OF.items():
        path, text = PAGES / name, make()
        if options.check:
            if not path.is_file() or path.read_text("utf-8") != text:
                stale.append(str(path.relative_to(ROOT)))
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")
    if stale:
        sys.exit(f"differ from the code: {', '.join(stale)}; run python scripts/reference.py")


if __name__ == "__main__":
    main()
