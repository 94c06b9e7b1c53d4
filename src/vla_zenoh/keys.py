"""Every key expression of ours, with its payload. The only file with key text; keys of ROS 2 are
in `vla_zenoh_ros2.keys`.

A key is ``{root}/{robot}/...``: `Keys` makes the keys of one robot, `Kind` chooses the quality of
service. `KEY_PATHS` is the whole wire protocol. A robot of several parts has states and commands of
each: ``{root}/{robot}/{part}/state/pose``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

from vla_zenoh.errors import ProfileError

SCHEMA = 2
"""Version of the wire. Raise it when a record means something else than before, or lacks a field
that it had. Decoders ignore fields that they do not know, so a new field alone does not raise it:
an old node must do right without what it ignores."""

DEFAULT_ROOT = "vla"

MAX_CHUNK = 64
"""Characters between two slashes."""

ANY_PART = "*"

_CHUNK = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


class Kind(Enum):
    """Quality of service of a key, see bus/session.py."""

    FRAME = "frame"  # images: large, newest only, may be dropped
    STATE = "state"  # small, fast, newest only, may be dropped
    CONTROL = "control"  # small, real-time priority, express, may be dropped: a newer one follows
    ORDER = "order"  # small, real-time priority, express, must arrive
    TELEMETRY = "news"  # status and events


def key_chunk(name: str, what: str) -> str:
    """`name` if it can stand between two slashes of a key, else a `ProfileError`."""
    if len(name) > MAX_CHUNK or not _CHUNK.fullmatch(name):
        shown = name if len(name) <= MAX_CHUNK else f"{name[:MAX_CHUNK]}..."
        raise ProfileError(
            f"{what} {shown!r} cannot be part of a key: use letters, digits, '_', '-' and '.', "
            f"starting with a letter, digit or '_', at most {MAX_CHUNK} of them"
        )
    return name


class KeyPath:
    """A key of a robot, or with ``*`` an expression of several; `Keys` makes its text.

    `path` is below the robot, with parameters in braces; `payload` is what is published or asked.
    """

    def __init__(self, path: str, payload: str = "") -> None:
        self.path, self.payload = path, payload
        self.parameters = tuple(re.findall(r"{(\w+)}", path))

    def text(self, keys: Keys, *parts: str) -> str:
        """The whole key with `parts` in place of its parameters; they may be ``*``."""
        own = self.path.format(**dict(zip(self.parameters, parts, strict=True)))
        of_part = f"{keys.part}/" if keys.part and isinstance(self, _PartKey) else ""
        return f"{keys.root}/{keys.robot}/{of_part}{own}"


class _Key(KeyPath):
    def __get__(self, keys: Keys, owner: object = None) -> str:
        return self.text(keys)


class _PartKey(_Key):
    """A key that every part of a robot has."""


class _KeyOf(KeyPath):
    def __get__(self, keys: Keys, owner: object = None) -> Callable[..., str]:
        def named(*parts: str) -> str:
            checked = map(key_chunk, parts, [f"{name} name" for name in self.parameters])
            return self.text(keys, *checked)

        return named


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one robot.

    `root` stands before its name and may hold slashes; `part` is the one whose states and commands
    are meant, ``*`` any, empty of a robot with one part, which has no name.
    """

    robot: str
    root: str = DEFAULT_ROOT
    part: str = ""

    def __post_init__(self) -> None:
        key_chunk(self.robot, "robot name")
        if self.part not in ("", ANY_PART):
            key_chunk(self.part, "part name")
        for part in self.root.split("/"):
            key_chunk(part, "root")

    # -- streams of the robot side ------------------------------------------------------------
    camera_raw = _KeyOf(
        "camera/{camera}/raw",
        "Pixels, C-contiguous RGB uint8 (H, W, 3); published while there are subscribers.",
    )
    camera_jpeg = _KeyOf(
        "camera/{camera}/jpeg",
        "A plain JPEG file, encoding image/jpeg; published while there are subscribers.",
    )
    camera_depth = _KeyOf(
        "camera/{camera}/depth",
        "A PNG file of 16 bits; its encoding gives the metres of a count "
        "(``image/png;depth16;0.001``), 0 is not measured. Published while there are subscribers.",
    )
    camera_fitted = _KeyOf(
        "camera/{camera}/fitted/{form}",
        "A JPEG in the form a model's spec asks for (``224x224-pad``), made where the camera is.",
    )
    state_joint = _PartKey("state/joint", "`JointState`.")
    state_pose = _PartKey(
        "state/pose", "`PoseState`, with the stamp and seq of the `JointState` it belongs to."
    )
    state_gripper = _PartKey("state/gripper", "`GripperState`, with the same stamp and seq.")
    state_privileged = _Key(
        "state/privileged", "`PrivilegedState` of a simulated benchmark, for reference policies."
    )

    # -- settings: plain text, any client may put ---------------------------------------------
    held = _PartKey(
        "held",
        "What the gripper holds, a box at the TCP: its size in m along the axes of the TCP, and "
        "where its centre is (``0.04 0.04 0.12 at 0 0 0.02``, or without ``at``). Empty: nothing.",
    )
    prompt = _Key("prompt", "Plain UTF-8 text.")
    active = _Key(
        "active",
        "true / false, also 1/0, on/off. ``true while NAME``: as long as `holding` NAME is.",
    )
    holding = _KeyOf(
        "holding/{holder}", "Liveliness token of a deadman: the arm stays active while it is there."
    )
    worker = _Key("worker", "Name of the worker whose chunks are executed.")
    rate = _Key("rate", "Chunks per second, a plain number.")
    speed = _Key(
        "speed", "Speed override, 0 to 100 percent of the planned speed: ``30`` or ``30 %``."
    )
    slower = _Key(
        "slower", "As `speed`, but it can only lower it: for every role that may stop the arm."
    )
    stop = _Key("stop", "Anything: latched stop, heard by the command node and the robot node.")
    reset = _Key("reset", "Anything: clears the stop, in both.")
    save = _Key("save", "Why: the rolling record of the last minutes is saved.")

    # -- model workers ------------------------------------------------------------------------
    task = _Key(
        "task", "`Task`: the settings as the command node agreed to them; workers follow it."
    )
    delta = _KeyOf("delta/{worker}", "`ActionChunk` of one worker, whatever its steps mean.")
    spec = _KeyOf("spec/{worker}", "The worker's `ModelSpec`, once a second and on request.")
    seen = _KeyOf(
        "seen/{worker}/{camera}",
        "JPEG of exactly the image the model was given; published while there are subscribers.",
    )
    seen_depth = _KeyOf(
        "seen/{worker}/{camera}/depth",
        "PNG of exactly the depth the model was given; published while there are subscribers.",
    )
    seen_record = _KeyOf(
        "seen/{worker}", "`InferenceDebug`: prompt, raw output and steps of the same inference."
    )

    # -- command node -------------------------------------------------------------------------
    command_pose = _PartKey(
        "command/pose", "`PoseCommand` at a fixed rate. The command node is its only writer."
    )
    command_joint = _PartKey(
        "command/joint",
        "`JointCommand`, in place of poses if the profile's robot is commanded by joints.",
    )
    command_gripper = _PartKey("command/gripper", "`GripperCommand`, newest wins.")

    # -- guarded primitives -------------------------------------------------------------------
    primitive = _KeyOf(
        "primitive/{primitive}",
        "Query with a JSON request; one JSON reply when the arm stands, with the reason why it "
        "does. Only where the node primitives runs.",
    )

    # -- every node ---------------------------------------------------------------------------
    status = _KeyOf("status/{node}", "`NodeStatus`, 2 Hz and on change.")
    event = _KeyOf("event/{node}", "`Event`.")
    alive = _KeyOf("alive/{node}", "Liveliness token.")
    clock = _KeyOf(
        "clock/{node}",
        "Query for the four stamps of NTP; the reply is a `ClockReply`.",
    )

    # -- the simulator's own ------------------------------------------------------------------
    sim_scene = _Key("sim/scene", "`SceneState`: all generalised positions, for renderers.")
    sim_objects = _Key(
        "sim/objects", "`ObjectPoses`: true poses of all free objects, for measuring success."
    )
    sim_reset = _Key(
        "sim/reset", "Empty, or a seed as plain text: the arm goes home, objects are placed again."
    )
    sim_step = _Key(
        "sim/step",
        "Query in lockstep mode with a map ``{ns}``: time advances by it. The reply is a map of "
        "``time_ns`` and of the records ``joint``, ``pose`` and ``gripper``, of a robot of several "
        "parts one such map of each.",
    )

    # -- selectors ----------------------------------------------------------------------------
    all_keys = _Key("**")
    all_raw_images = _Key("camera/*/raw")
    all_deltas = _Key("delta/*")
    all_specs = _Key("spec/*")
    all_seen = _Key("seen/*/*")
    all_seen_of = _KeyOf("seen/{worker}/*")
    all_seen_records = _Key("seen/*")
    all_status = _Key("status/*")
    all_events = _Key("event/*")
    all_alive = _Key("alive/*")
    all_holding = _Key("holding/*")
    all_primitives = _Key("primitive/*")

    @property
    def without_raw_images(self) -> tuple[str, ...]:
        """All keys, also later ones of one or two chunks, but only JPEG images: a subscriber to raw
        ones makes cameras send 1 MB each."""
        pictures = ("camera/*/jpeg", "camera/*/depth", "seen/*/*", "seen/*/*/depth")
        parts = (f"{self.part}/state/*", f"{self.part}/command/*") if self.part else ()
        return tuple(map(self.full, ("*", "*/*", *pictures, *parts)))

    def of_part(self, part: str) -> Keys:
        """The same keys with states and commands of `part`; ``*``: of every part."""
        return replace(self, part=part)

    @property
    def all_robots(self) -> str:
        """The liveliness token of every robot's command node below this root."""
        return f"{self.root}/*/alive/command"

    def short(self, key: str) -> str:
        """`key` without the root and robot, as shown to people; other keys unchanged."""
        return key.removeprefix(f"{self.root}/{self.robot}/")

    def full(self, key: str) -> str:
        """Inverse of `short`; a key that begins with the root is taken as whole already."""
        return key if key.startswith(f"{self.root}/") else f"{self.root}/{self.robot}/{key}"

    @staticmethod
    def of(key: str, root: str) -> Keys | None:
        """The keys of the robot that `key` belongs to, None if it belongs to none below `root`."""
        robot, _, rest = key.removeprefix(f"{root}/").partition("/")
        if not key.startswith(f"{root}/") or not rest:
            return None
        try:
            return Keys(robot, root)
        except ProfileError:
            return None


KEY_PATHS: Mapping[str, KeyPath] = {
    name: path
    for name, path in vars(Keys).items()
    if isinstance(path, KeyPath) and "*" not in path.path
}
"""Member of `Keys` -> its path, for all single keys: the whole wire protocol."""

PART_KEYS = frozenset(name for name, path in KEY_PATHS.items() if isinstance(path, _PartKey))
"""Members of `Keys` that every part of a robot has."""
NOT_PARTS = frozenset(path.path.split("/")[0] for path in KEY_PATHS.values())
"""Names that no part may have: they follow the robot in other keys."""


def last_chunk(key: str) -> str:
    """The last part of a key: the name of the node, worker or camera."""
    return key.rsplit("/", 1)[-1]


NO_DEADMAN_TOKEN = "is not there (a liveliness token on the key holding/NAME)"
"""Why a deadman is not accepted."""

PRIMITIVES = "primitives"
"""Kind of the node that answers on `Keys.primitive`, and its name as a worker."""


def worker_node(worker: str) -> str:
    """Node name of a worker."""
    return f"worker-{worker}"


ROLLING = "rolling"
"""Node, and kind of node, of the rolling record that `up` keeps beside a command node. It is not in
`NODE_KINDS`: a profile does not name it."""

CRASHED, STARTING = "crashed", "starting"
LOADING, NO_TASK, NOTHING_YET = "loading", "no task received", "nothing received yet"
"""Complaints of a worker that starts; more may follow."""
OPENING = "it is being opened"
"""Why a camera that starts sends no images; more may follow."""
"""States in the status that `vla-zenoh up` publishes for a node of its host that does not run."""
ENDED = "ended"
"""State in the last status of a node that ended as it should; one that died publishes none."""
ON_BEHALF = "up-"
"""Prefix of the source of such a status."""


class NodeTraits(NamedTuple):
    """A kind of node; its command is ``vla-zenoh node KIND``, or ``vla-zenoh worker``.

    Args:
        role: in a secured lab, a value of `vla_zenoh.security.roles.Role`.
        stop_s: how long before its deadline `up` stops the next kinds; those with more stop first.
        only_one: why a robot has no second one; empty: it may have several.
    """

    role: str
    stop_s: float
    only_one: str = ""


NODE_KINDS: Mapping[str, NodeTraits] = {
    "router": NodeTraits("router", 0.1),
    "sim": NodeTraits("robot", 0.4, "there is one simulated robot"),
    "ros2": NodeTraits("robot", 0.4, "the robot has one driver"),
    "arm": NodeTraits("robot", 0.4, "the robot has one driver"),
    "command": NodeTraits("command", 0.8, "the robot follows one command node"),
    "camera": NodeTraits("camera", 0.8),
    "worker": NodeTraits("worker", 0.8),
    "primitives": NodeTraits("worker", 0.8, "one primitive is executed at a time"),
}
"""Every kind of node, in the order in which `up` starts them."""
