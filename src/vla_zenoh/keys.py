"""Every key expression of ours, with its payload. The only file with key text; keys of ROS 2 are
in ``interop/ros2/keys.py``.

A key is ``{root}/{robot}/...``: `Keys` makes the keys of one robot, `Kind` chooses the quality of
service. The members below are the whole wire protocol.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from vla_zenoh.errors import ProfileError

SCHEMA = 1
"""Version of the wire. Raise it when a record of the last version cannot be decoded any more, or an
old node would reject a new one: decoders reject unknown fields, so a new field raises it too."""

DEFAULT_ROOT = "vla"

MAX_CHUNK = 64
"""Characters between two slashes."""

_CHUNK = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


class Kind(Enum):
    """Quality of service of a key, see bus/session.py."""

    FRAME = "frame"  # images: large, newest only, may be dropped
    STATE = "state"  # small, fast, newest only, may be dropped
    CONTROL = "control"  # small, real-time priority, express, may be dropped: a newer one follows
    ORDER = "order"  # small, real-time priority, express, must arrive
    TELEMETRY = "news"  # status and events


def key_chunk(name: str, what: str) -> str:
    """Check that `name` can stand between two slashes of a key.

    Raises:
        ProfileError: it cannot; says what is allowed.
    """
    if len(name) > MAX_CHUNK or not _CHUNK.fullmatch(name):
        shown = name if len(name) <= MAX_CHUNK else f"{name[:MAX_CHUNK]}..."
        raise ProfileError(
            f"{what} {shown!r} cannot be part of a key: use letters, digits, '_', '-' and '.', "
            f"starting with a letter, digit or '_', at most {MAX_CHUNK} of them"
        )
    return name


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one robot.

    Args:
        robot: the robot's name.
        root: what stands before it, may hold slashes.
    """

    robot: str
    root: str = DEFAULT_ROOT

    def __post_init__(self) -> None:
        key_chunk(self.robot, "robot name")
        for part in self.root.split("/"):
            key_chunk(part, "root")

    def _at(self, *parts: str) -> str:
        return "/".join((self.root, self.robot, *parts))

    # -- streams of the robot side ------------------------------------------------------------
    def camera_raw(self, camera: str) -> str:
        """Pixels, C-contiguous RGB uint8 (H, W, 3); published while there are subscribers."""
        return self._at("camera", key_chunk(camera, "camera name"), "raw")

    def camera_jpeg(self, camera: str) -> str:
        """A plain JPEG file, encoding image/jpeg; published while there are subscribers."""
        return self._at("camera", key_chunk(camera, "camera name"), "jpeg")

    def camera_fitted(self, camera: str, form: str) -> str:
        """A JPEG as a model wants it, made where the camera is; see `size_variant`."""
        return self._at(
            "camera", key_chunk(camera, "camera name"), "fitted", key_chunk(form, "form")
        )

    @property
    def state_joint(self) -> str:
        """`JointState`."""
        return self._at("state", "joint")

    @property
    def state_pose(self) -> str:
        """`PoseState`, with the stamp and seq of the `JointState` it belongs to."""
        return self._at("state", "pose")

    @property
    def state_gripper(self) -> str:
        """`GripperState`, with the same stamp and seq."""
        return self._at("state", "gripper")

    # -- settings: plain text, any client may put ---------------------------------------------
    @property
    def prompt(self) -> str:
        """Plain UTF-8 text."""
        return self._at("prompt")

    @property
    def active(self) -> str:
        """true / false, also 1/0, on/off. ``true while NAME``: as long as `holding` NAME is."""
        return self._at("active")

    def holding(self, holder: str) -> str:
        """Liveliness token of a deadman: the arm stays active while it is there."""
        return self._at("holding", key_chunk(holder, "holder"))

    @property
    def worker(self) -> str:
        """Name of the worker whose chunks are carried out."""
        return self._at("worker")

    @property
    def rate(self) -> str:
        """Chunks per second, a plain number."""
        return self._at("rate")

    @property
    def speed(self) -> str:
        """Speed override, 0 to 100 percent of the planned speed: ``30`` or ``30 %``."""
        return self._at("speed")

    @property
    def slower(self) -> str:
        """As `speed`, but it can only lower it: for every role that may stop the arm."""
        return self._at("slower")

    @property
    def stop(self) -> str:
        """Anything: latched emergency stop."""
        return self._at("stop")

    @property
    def reset(self) -> str:
        """Anything: clears the emergency stop."""
        return self._at("reset")

    # -- model workers ------------------------------------------------------------------------
    @property
    def task(self) -> str:
        """`Task`: the settings as the command node agreed to them; workers follow it."""
        return self._at("task")

    def delta(self, worker: str) -> str:
        """`ActionChunk` of one worker: the delta key."""
        return self._at("delta", key_chunk(worker, "worker name"))

    def spec(self, worker: str) -> str:
        """The worker's `ModelSpec`, once a second and on request."""
        return self._at("spec", key_chunk(worker, "worker name"))

    def seen(self, worker: str, camera: str) -> str:
        """JPEG of exactly the image the model was given; published while there are subscribers."""
        return self._at("seen", key_chunk(worker, "worker name"), key_chunk(camera, "camera name"))

    def seen_record(self, worker: str) -> str:
        """`InferenceDebug`: prompt, raw output and steps of the same inference."""
        return self._at("seen", key_chunk(worker, "worker name"))

    # -- command node -------------------------------------------------------------------------
    @property
    def command_pose(self) -> str:
        """`PoseCommand` at a fixed rate. The command node is its only writer."""
        return self._at("command", "pose")

    @property
    def command_joint(self) -> str:
        """`JointCommand`, in place of poses if the profile's robot is commanded by joints."""
        return self._at("command", "joint")

    @property
    def command_gripper(self) -> str:
        """`GripperCommand`, newest wins."""
        return self._at("command", "gripper")

    # -- every node ---------------------------------------------------------------------------
    def status(self, node: str) -> str:
        """`NodeStatus`, 2 Hz and on change."""
        return self._at("status", key_chunk(node, "node name"))

    def event(self, node: str) -> str:
        """`Event`."""
        return self._at("event", key_chunk(node, "node name"))

    def alive(self, node: str) -> str:
        """Liveliness token."""
        return self._at("alive", key_chunk(node, "node name"))

    def clock(self, node: str) -> str:
        """Query for the four stamps of NTP: the reply has its times of arrival and reply."""
        return self._at("clock", key_chunk(node, "node name"))

    # -- the simulator's own ------------------------------------------------------------------
    @property
    def sim_scene(self) -> str:
        """`SceneState`: all generalised positions, for renderers."""
        return self._at("sim", "scene")

    @property
    def sim_objects(self) -> str:
        """`ObjectPoses`: true poses of all free objects, for measuring success."""
        return self._at("sim", "objects")

    @property
    def sim_reset(self) -> str:
        """Empty, or a seed as plain text: the arm goes home, objects are placed again."""
        return self._at("sim", "reset")

    @property
    def sim_step(self) -> str:
        """Query in lockstep mode: advance by so many nanoseconds, reply with the state."""
        return self._at("sim", "step")

    # -- selectors ----------------------------------------------------------------------------
    @property
    def all_keys(self) -> str:
        """All keys of this robot."""
        return self._at("**")

    @property
    def without_images(self) -> tuple[str, ...]:
        """The same without pictures; two-part keys that are added later are among them, too."""
        return (self._at("*"), self._at("*", "*"))

    @property
    def without_raw_images(self) -> tuple[str, ...]:
        """The same with JPEG alone: who listens to raw pictures makes cameras send 1 MB each."""
        return (*self.without_images, self._at("camera", "*", "jpeg"), self._at("seen", "*", "*"))

    @property
    def all_raw_images(self) -> str:
        """The raw pictures of every camera."""
        return self._at("camera", "*", "raw")

    @property
    def all_deltas(self) -> str:
        return self._at("delta", "*")

    @property
    def all_specs(self) -> str:
        return self._at("spec", "*")

    @property
    def all_seen(self) -> str:
        return self._at("seen", "*", "*")

    @property
    def all_seen_records(self) -> str:
        return self._at("seen", "*")

    def all_seen_of(self, worker: str) -> str:
        """The pictures of one worker."""
        return self._at("seen", key_chunk(worker, "worker name"), "*")

    @property
    def all_status(self) -> str:
        return self._at("status", "*")

    @property
    def all_events(self) -> str:
        return self._at("event", "*")

    @property
    def all_alive(self) -> str:
        return self._at("alive", "*")

    @property
    def all_holding(self) -> str:
        return self._at("holding", "*")

    @property
    def all_robots(self) -> str:
        """The liveliness token of every robot's command node below this root."""
        return f"{self.root}/*/alive/command"

    def short(self, key: str) -> str:
        """`key` without the root and robot, as people say it; other keys as they are."""
        return key.removeprefix(f"{self.root}/{self.robot}/")

    def full(self, key: str) -> str:
        """The way back of `short`; what begins with the root is taken as whole already."""
        return key if key.startswith(f"{self.root}/") else self._at(key)

    def group(self, key: str) -> str:
        """The first part below the robot: ``camera``, ``state``, ``prompt``; of others nothing."""
        return self.short(key).split("/", 1)[0] if key.startswith(self._at("")) else ""

    def on(self, other: Keys, key: str) -> str:
        """The key of `other` that says what `key` says of this robot."""
        return other._at(self.short(key))

    @staticmethod
    def of(key: str, root: str) -> Keys | None:
        """The keys of the robot that `key` is of, None where it is of none below `root`."""
        robot, _, rest = key.removeprefix(f"{root}/").partition("/")
        if not key.startswith(f"{root}/") or not rest:
            return None
        try:
            return Keys(robot, root)
        except ProfileError:
            return None


def last_chunk(key: str) -> str:
    """The last part of a key: the node, worker or camera it is about."""
    return key.rsplit("/", 1)[-1]


def covers(wide: str, narrow: str) -> bool:
    """Whether every key that the expression `narrow` means is also meant by `wide`.

    Of Zenoh's expressions ``*`` and ``**`` are known; that is all that is used here.
    """
    return _covers(wide.split("/"), narrow.split("/"))


def _covers(wide: list[str], narrow: list[str]) -> bool:
    if not wide:
        return not narrow
    if wide[0] == "**":
        return any(_covers(wide[1:], narrow[at:]) for at in range(len(narrow) + 1))
    if not narrow or narrow[0] == "**":
        return False
    return wide[0] in ("*", narrow[0]) and _covers(wide[1:], narrow[1:])


NO_DEADMAN_TOKEN = "is not there (a liveliness token on the key holding/NAME)"
"""Why a deadman is not accepted."""


def worker_node(worker: str) -> str:
    """Node name of a worker."""
    return f"worker-{worker}"


CRASHED, STARTING = "crashed", "starting"
"""States in the status that `vla-zenoh up` publishes for a node of its host that does not run."""
ON_BEHALF = "up-"
"""How the source of such a status begins."""


class NodeTraits(NamedTuple):
    """A kind of node; its command is ``vla-zenoh node KIND``, or ``vla-zenoh worker``.

    Args:
        role: in a secured lab, a value of `vla_zenoh.security.identity.Role`.
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
    "command": NodeTraits("command", 0.8, "the robot obeys one command node"),
    "camera": NodeTraits("camera", 0.8),
    "worker": NodeTraits("worker", 0.8),
}
"""Every kind of node, in the order in which `up` starts them."""
