"""The profile of one robot and its lab, checked as a whole."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    ValidationError,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from vla_zenoh import keys, plugins
from vla_zenoh.errors import PluginError, ProfileError, describe_fault
from vla_zenoh.keys import NODE_KINDS, NOT_PARTS, PRIMITIVES, Keys, worker_node
from vla_zenoh.profile.limits import Limits
from vla_zenoh.profile.robot import (
    Options,
    PartBase,
    RobotProfile,
    Ros2Camera,
    Ros2Profile,
)
from vla_zenoh.profile.schema import (
    SIMULATED,
    CameraProfile,
    Composition,
    HostProfile,
    SessionProfile,
    SimProfile,
    TaskProfile,
    Timing,
    endpoint_faults,
)
from vla_zenoh.profile.section import (
    Fault,
    Name,
    Names,
    Place,
    Section,
    Text,
    Word,
    Words,
    merge,
    unlisted,
)
from vla_zenoh.resources import is_path


def checked_root(value: str) -> str:
    for part in value.split("/"):
        keys.key_chunk(part, "root")
    return value


def _no_paths(names: Any) -> Any:
    for name in names if isinstance(names, (list, tuple)) else ():
        if isinstance(name, str) and is_path(name):
            called = Path(name).stem
            raise ValueError(
                f"{name!r} is a path: give that model a name, as models: {{{called}: {name}}}, "
                f"and write {called} here"
            )
    return names


class PartProfile(Section):
    """One of several arms of a robot, each with its gripper.

    Args:
        base: where it stands, in the frame of the robot. Poses, workspace and table of a part are
            in its own base frame.
        robot: what differs from the section `robot` of the profile.
        limits: what differs from its `limits`.
        ros2: its own topics, where they differ from those in `ros2`: joint_states, finger_states,
            wrench, joint_command and gripper.
    """

    base: PartBase = PartBase()
    robot: dict[str, Any] = Field(default_factory=dict)
    limits: dict[str, Any] = Field(default_factory=dict)
    ros2: dict[str, Any] = Field(default_factory=dict)


class Profile(Section):
    """Everything about one robot and its lab.

    Args:
        parts: arms under one policy, by name; empty: the robot is one arm.
        workers: worker names; each is also the name of its model, unless `models` gives another.
        models: worker -> its model: a path, or the name of another model.
        serves: worker -> the robots it serves, this one among them and all of the same kind; a
            worker that is not listed serves this robot only.
        options: worker -> options of its model as ``--set`` gives them, name -> text.
        ros2: required for a robot or camera of ROS 2.
        unconfirmed: places of this profile that were guessed, as `vla-zenoh profile new` writes
            them. While there are any, a real arm is not activated; a simulated one is. Look at
            each, correct it, and delete its line.

    Further sections have the name of a robot driver, and hold its options. That of a driver which
    is not installed is a map: another computer runs it, and checks it.
    """

    model_config = ConfigDict(extra="allow")

    name: Name
    about: Text = ""
    root: Annotated[Word, AfterValidator(checked_root)] = keys.DEFAULT_ROOT
    robot: RobotProfile
    parts: dict[Name, PartProfile] = Field(default_factory=dict, max_length=4)
    limits: Limits = Limits()
    timing: Timing = Timing()
    composition: Composition = Composition()
    cameras: dict[Name, CameraProfile] = Field(default_factory=dict)
    sim: SimProfile = SimProfile()
    workers: Annotated[Names, BeforeValidator(_no_paths)] = ("scripted",)
    models: dict[Name, Word] = Field(default_factory=dict)
    serves: dict[Name, Annotated[Names, Field(min_length=1)]] = Field(default_factory=dict)
    options: dict[Name, Options] = Field(default_factory=dict)
    task: TaskProfile = TaskProfile()
    session: SessionProfile = SessionProfile()
    hosts: dict[Name, HostProfile] = Field(
        default_factory=lambda: {"here": HostProfile(nodes=SIMULATED)}
    )
    ros2: Ros2Profile | None = None
    unconfirmed: Words = ()
    _part: str = PrivateAttr("")

    @classmethod
    def keys_here(cls) -> Mapping[str, Any]:
        """Also the sections of installed robot drivers."""
        robots = plugins.load_all(plugins.ROBOTS)
        sections = {name: robot.options for name, robot in robots.items() if robot.options}
        return {**super().keys_here(), **sections}

    @model_validator(mode="wrap")
    @classmethod
    def _with_driver(cls, data: Any, read: ModelWrapValidatorHandler[Self]) -> Self:
        """Validate the sections of robot drivers, each by the class that its plug-in declares."""
        if not isinstance(data, Mapping):
            return read(data)
        own = {name: value for name, value in data.items() if name in cls.model_fields}
        robot = own.get("robot")
        driver = robot.get("driver", "sim") if isinstance(robot, Mapping) else "sim"
        found: dict[str, Any] = {}
        faults: list[InitErrorDetails] = []
        for name in data.keys() - own.keys():
            if data[name] is not None:
                try:
                    found[name] = _driver_section(name, data[name], name == driver)
                except ValidationError as error:
                    faults += [_again(fault, name) for fault in error.errors(include_url=False)]
        if isinstance(driver, str) and driver not in data and (why := _not_installed(driver)):
            custom = PydanticCustomError("value_error", "{why}", {"why": why})
            faults.append({"type": custom, "loc": ("robot", "driver"), "input": driver})
        try:
            made = read({**own, **found})
        except ValidationError as error:
            # What contradicts a section that is wrong may be right: it is at no place of its own.
            more = [
                fault for fault in error.errors(include_url=False) if fault["loc"] or not faults
            ]
            faults = [*map(_again, more), *faults]
        else:
            if not faults:
                return made
        raise ValidationError.from_exception_data("Profile", faults)

    @property
    def driver_options(self) -> Any:
        """The section of its robot driver, checked; None if the driver needs none.

        Raises:
            PluginError: the driver is not installed here.
        """
        robot = plugins.load(plugins.ROBOTS, self.robot.driver)
        if robot.options is None:
            return None
        given = (self.__pydantic_extra__ or {}).get(self.robot.driver)
        return robot.options() if given is None else given

    @property
    def keys(self) -> Keys:
        """The keys of this profile's robot, or of its part."""
        return Keys(self.robot.name, self.root, self._part)

    @property
    def keys_of_all_parts(self) -> Keys:
        """The keys of this robot, as expressions of every part where it has several."""
        return self.keys.of_part(keys.ANY_PART) if self.parts else self.keys

    @property
    def part(self) -> str:
        """The part that this profile is of; empty: the whole robot."""
        return self._part

    @property
    def part_names(self) -> tuple[str, ...]:
        """Names of the parts; of a robot that is one arm one empty name."""
        return tuple(self.parts) or ("",)

    def of_part(self, name: str) -> Profile:
        """The profile of one part, as if it were a robot of its own; of no name: this one."""
        if not name:
            return self
        part = self.parts[name]
        own = {name: _filled(getattr(self, name), getattr(part, name)) for name in OF_PARTS}
        made = self.model_copy(update={**own, "parts": {}})
        made._part = name
        return made

    def require_one_arm(self, what: str) -> None:
        """Reject a robot of parts by a `ProfileError`: `what` moves or shows one arm only."""
        if self.parts:
            raise ProfileError(
                f"{what}: for one arm only, and robot {self.robot.name!r} has the parts "
                f"{', '.join(self.parts)}"
            )

    def contradictions(self) -> Iterator[Fault]:
        """Sections that do not go together."""
        for check in (_robot, _parts, _cameras, _beside):
            yield from check(self)
        yield from unlisted(("task", "worker"), [self.task.worker], "workers", self.workers)
        yield from _serves(self)
        yield from unlisted(("models",), self.models, "workers", self.workers)
        yield from unlisted(("options",), self.options, "workers", self.workers)
        yield from _hosts(self)

    # -- which node runs where ----------------------------------------------------------------
    def cameras_of(self, host: HostProfile) -> tuple[str, ...]:
        """Names of the cameras that the camera node of `host` serves."""
        if "camera" not in host.nodes:
            return ()
        return tuple(self.cameras) if host.cameras is None else host.cameras

    def ros2_cameras(self) -> dict[str, Ros2Camera]:
        """Camera -> its topic, of all that come from ROS 2."""
        named = self.ros2.cameras if self.ros2 is not None else {}
        return {
            name: named.get(name) or Ros2Camera(topic=camera.source.removeprefix("ros2:"))
            for name, camera in self.cameras.items()
            if camera.from_ros2
        }

    def workers_of(self, host: HostProfile) -> tuple[str, ...]:
        """Names of the workers that run on `host`."""
        if "worker" not in host.nodes:
            return ()
        return self.workers if host.workers is None else host.workers

    @property
    def robot_nodes(self) -> dict[str, str]:
        """Robot driver -> kind of its node; ``ros2``, too, where it serves what another moves."""
        found = {self.robot.driver: self.robot.node}
        return found if self.ros2 is None else {**found, "ros2": "ros2"}

    def node_name(self, host: str, kind: str) -> str:
        """Name on the bus of the node of this kind on `host`; unique if several hosts run one."""
        if kind == PRIMITIVES:  # its chunks are those of a worker
            return worker_node(kind)
        hosts = [name for name, part in self.hosts.items() if kind in part.nodes]
        return kind if len(hosts) < 2 else f"{kind}-{host}"

    def camera_servers(self) -> dict[str, str]:
        """Camera -> name of the node that serves it.

        A camera that no host runs belongs to a ``vla-zenoh node camera`` started by hand.
        """
        servers = dict.fromkeys(self.cameras, "camera")
        for host, part in self.hosts.items():
            for camera in self.cameras_of(part):
                servers[camera] = self.node_name(host, "camera")
        return servers | dict.fromkeys(self.ros2_cameras(), "ros2")


# -- checks across sections: (place, sentence) of every fault -------------------------------------
OF_PARTS = ("robot", "limits", "ros2")
"""Sections that a part may have of its own."""
TOPICS_OF_PARTS = {"joint_states", "finger_states", "wrench", "joint_command", "gripper"}
OWN_ROBOT = "A robot of your own is driver: arm, with a Python file: arm: {file: my_arm.py}"


def _driver_section(name: str, given: Any, is_driver: bool) -> Any:
    """The section of a robot driver, checked; as it is, if that driver is not installed here.

    Raises:
        ValidationError: an option is wrong, or there is no such section.
    """
    why = ""
    try:
        robot = plugins.load(plugins.ROBOTS, name)
    except PluginError as error:
        known = name in plugins.installed(plugins.ROBOTS)
        if (is_driver or plugins.in_own_environment()) and not known:
            return given
        why = str(error) if known else ""
    else:
        if robot.options is not None:
            return robot.options.model_validate(given)
    unknown = (
        PydanticCustomError("value_error", "{why}", {"why": why}) if why else "extra_forbidden"
    )
    raise ValidationError.from_exception_data(name, [{"type": unknown, "loc": (), "input": given}])


def _again(fault: Any, *above: str) -> InitErrorDetails:
    """A fault of a section as one of what it is in."""
    kind, context = fault["type"], fault.get("ctx", {})
    if kind == "value_error" and "error" not in context:
        kind = PydanticCustomError("value_error", "{why}", {"why": fault["msg"]})
    return {"type": kind, "loc": (*above, *fault["loc"]), "input": fault["input"], "ctx": context}


def _not_installed(driver: str) -> str:
    """Why a driver that has no section cannot be right; empty: it may be."""
    known = plugins.installed(plugins.ROBOTS)
    if driver in known or plugins.in_own_environment():
        return ""
    try:
        plugins.load(plugins.ROBOTS, driver)
    except PluginError as error:
        return f"{error}. {OWN_ROBOT}"
    return ""


def _robot(profile: Profile) -> Iterator[Fault]:
    yield from _joint_limits((), profile.robot, profile.limits)
    driver = profile.robot.driver
    if driver == "ros2" and profile.ros2 is None:
        yield (driver,), "is missing: robot.driver is ros2"
    if driver not in plugins.installed(plugins.ROBOTS):
        return  # another computer runs it
    try:
        robot = plugins.load(plugins.ROBOTS, driver)
    except PluginError as error:
        yield ("robot", "driver"), str(error)
        return
    if profile.robot.command not in robot.commands:
        allowed = " or ".join(robot.commands)
        yield ("robot", "command"), f"must be {allowed}: robot.driver is {driver}"
    fields = robot.options.model_fields if robot.options else {}
    required = [f"{name}: ..." for name, field in fields.items() if field.is_required()]
    if required and driver not in (profile.__pydantic_extra__ or {}):
        give = f"Give {driver}: {{{', '.join(required)}}}"
        yield (driver,), f"is missing: robot.driver is {driver}. {give}"
        return
    yield from plugins.faults_of(driver, robot.contradictions, profile, profile.driver_options)


def _joint_limits(place: Place, robot: RobotProfile, limits: Limits) -> Iterator[Fault]:
    joints = len(robot.arm_joints)
    for name, values in limits.joint:
        if len(values) not in (1, joints):
            yield (
                (*place, "limits", "joint", name),
                f"has {len(values)} numbers for {joints} arm_joints: give one for all, or one each",
            )


def _filled(section: Section | None, over: Mapping[str, Any]) -> Section | None:
    """`section` with the values of `over`, map by map."""
    if section is None or not over:
        return section
    return type(section).model_validate(merge(section.model_dump(), {}, over, {}, ("parts",))[0])


def _parts(profile: Profile) -> Iterator[Fault]:
    """What the parts of a robot have in common, and what only one arm can have."""
    if len(profile.parts) == 1:
        yield ("parts",), "names one part: leave it out, and describe the arm in robot and limits"
    if profile.parts and profile.robot.driver not in ("sim", "ros2"):
        yield (
            ("parts",),
            f"go with robot.driver: sim or ros2, and it is {profile.robot.driver}: give each arm a "
            "robot of its own",
        )
    if profile.parts and profile.robot.command != "joint":
        yield (
            ("robot", "command"),
            "must be joint: the robot has parts, whose distance is only known where their joints "
            "are commanded",
        )
    for name, part in profile.parts.items():
        if name in NOT_PARTS:
            taken = ", ".join(sorted(NOT_PARTS))
            yield ("parts", name), f"is taken by keys; names that are taken: {taken}"
        for field in {"name", "driver", "command"} & set(part.robot):
            yield ("parts", name, "robot", field), "is that of the whole robot: leave it out"
        for field in sorted(part.ros2.keys() - TOPICS_OF_PARTS):
            yield ("parts", name, "ros2", field), "is that of the whole robot: leave it out"
        if part.ros2 and profile.ros2 is None:
            yield ("parts", name, "ros2"), "needs a section ros2 of the whole robot"
        for what in OF_PARTS:
            try:
                _filled(getattr(profile, what), getattr(part, what))
            except ValidationError as error:
                for fault in error.errors(include_url=False):
                    place = ("parts", name, what, *map(str, fault["loc"]))
                    yield place, describe_fault(fault)
                break
        else:
            own = profile.of_part(name)
            yield from _joint_limits(("parts", name), own.robot, own.limits)


def _cameras(profile: Profile) -> Iterator[Fault]:
    for name, camera in profile.cameras.items():
        place = ("cameras", name, "source")
        if camera.from_ros2 and profile.ros2 is None:
            yield place, f"is {camera.source!r}, which needs a section ros2"
        if camera.from_ros2 and camera.fit_for_workers:
            yield ("cameras", name, "fit_for_workers"), "cannot be done for a camera of ROS 2"
        if camera.source.startswith("sim:") and profile.robot.driver != "sim":
            yield (
                place,
                f"is {camera.source!r}, and robot.driver is {profile.robot.driver}: nothing is "
                f"simulated. Give another source, or leave an inherited camera out: {name}: null",
            )


def _beside(profile: Profile) -> Iterator[Fault]:
    """What the plug-in finds that serves ROS 2 beside a robot of another driver."""
    others = profile.robot_nodes.keys() - {profile.robot.driver}
    for name in others & plugins.installed(plugins.ROBOTS).keys():
        robot = plugins.load(plugins.ROBOTS, name)
        yield from plugins.faults_of(name, robot.contradictions, profile, None)


def _serves(profile: Profile) -> Iterator[Fault]:
    yield from unlisted(("serves",), profile.serves, "workers", profile.workers)
    for worker, robots in profile.serves.items():
        if profile.robot.name not in robots:
            yield (
                ("serves", worker),
                f"lacks {profile.robot.name}, the robot of this profile: name all that the worker "
                "serves, or remove the entry",
            )


def _hosts(profile: Profile) -> Iterator[Fault]:
    if not profile.hosts:
        yield ("hosts",), "is empty: name at least one host and its nodes"
    from_ros2 = set(profile.ros2_cameras())
    runs: dict[tuple[str, str], list[str]] = defaultdict(list)
    for name, host in profile.hosts.items():
        place = ("hosts", name)
        if not host.nodes:
            yield (
                (*place, "nodes"),
                "is empty: give the host a node, or remove it. A computer that only drives or "
                f"watches is not a host: `vla-zenoh secure add {name} --role operator` (or viewer) "
                "gives it a certificate",
            )
        yield from unlisted((*place, "cameras"), host.cameras or (), "cameras", profile.cameras)
        yield from unlisted((*place, "workers"), host.workers or (), "workers", profile.workers)
        for kind in ("sim", "arm"):
            if kind in host.nodes and profile.robot.node != kind:
                yield (*place, "nodes"), f"has {kind}, and robot.driver is {profile.robot.driver}"
        if "ros2" in host.nodes and profile.ros2 is None:
            yield (*place, "nodes"), "has ros2, which needs a section ros2"
        cameras = set(profile.cameras_of(host))
        for camera in sorted(cameras & from_ros2) if host.cameras is not None else ():
            yield (*place, "cameras"), f"has {camera}, of ROS 2: the node ros2 serves it"
        if "camera" in host.nodes and not cameras - from_ros2:
            yield (
                (*place, "nodes"),
                "has camera, and there is no camera for it to serve: describe one in cameras, or "
                "take camera out of nodes",
                [("cameras",)],
            )
        for kind in host.nodes:
            if NODE_KINDS[kind].only_one:
                runs["nodes", kind].append(name)
        for camera in profile.cameras_of(host):
            runs["cameras", camera].append(name)
        for worker in profile.workers_of(host):
            runs["workers", worker].append(name)
        yield from _endpoints(profile, name, host)
    yield from _routers(profile)
    for (what, name), hosts in runs.items():
        if len(hosts) > 1:
            why = NODE_KINDS[name].only_one if what == "nodes" else "each key has one writer"
            hint = "" if what == "nodes" else f". List on each host which {what} it runs"
            yield (("hosts", hosts[-1], what), f"{name} runs on {' and '.join(hosts)}: {why}{hint}")


def _endpoints(profile: Profile, name: str, host: HostProfile) -> Iterator[Fault]:
    for what in ("connect", "listen", "link"):
        endpoints = getattr(host, what)
        yield from endpoint_faults(endpoints or (), profile.session, "hosts", name, what)
        if endpoints is not None and what != "connect" and "router" not in host.nodes:
            yield ("hosts", name, what), "is for a router, and this host runs none"


def _routers(profile: Profile) -> Iterator[Fault]:
    """Every router but one needs a link to another: they do not discover each other."""
    alone = [n for n, host in profile.hosts.items() if "router" in host.nodes and not host.link]
    for name in alone[1:]:
        yield (
            ("hosts", name, "link"),
            f"is missing: routers do not discover each other, and {alone[0]} runs one as well. "
            "Give its address, as link: [tcp/10.0.0.2:7447]",
        )
