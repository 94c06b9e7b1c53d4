"""Looks at a running ROS 2 robot over Zenoh: its description, joint states, images and topics.

It subscribes, asks for one parameter at most, and publishes nothing.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple, TypeVar

import zenoh

from vla_zenoh.bus.buffers import CallbackRing, bytes_of
from vla_zenoh.bus.session import open_session
from vla_zenoh.codec.cdr import MAX_MESSAGE_BYTES
from vla_zenoh.errors import CodecError, ResourceError, SessionError
from vla_zenoh.profile import SessionProfile
from vla_zenoh.profile.robot import Ros2Profile
from vla_zenoh_ros2.bridge_view import CONFIGS, MAX_REPLY_BYTES
from vla_zenoh_ros2.keys import (
    LATCHED,
    SENSOR,
    TEXT,
    TOKENS_OF_RMW,
    Endpoint,
    EntityRole,
    RmwZenoh,
)
from vla_zenoh_ros2.messages import MAX_PICTURE_BYTES, Messages
from vla_zenoh_ros2.proposal import (
    CONTROLLER_STATE,
    HeardImages,
    HeardJoints,
    Topic,
    below,
    camera_topics,
    controller_states,
    state_topics,
)
from vla_zenoh_ros2.readers import JOINT_STATE, read
from vla_zenoh_ros2.ros_graph import RosGraph
from vla_zenoh_ros2.ros_names import ENTITIES, RosDomain, domains_of_bridges, domains_of_rmw

DESCRIPTION, NODE = "/robot_description", "/robot_state_publisher"
PARAMETER = "robot_description"
GET_PARAMETERS = "rcl_interfaces/srv/GetParameters"
DEFINITIONS = {
    GET_PARAMETERS: "string[] names\n---\nrcl_interfaces/ParameterValue[] values\n",
    CONTROLLER_STATE: "std_msgs/Header header\nstring[] joint_names\n",
}
"""Of the state of a controller only how it begins, which is the same in every distribution."""
ASK_S, POLL_S = 1.0, 0.3
SETTLED_S = 1.0
"""Names that did not change for so long are all there are."""
LISTEN_S = 1.0
"""Joint states and images are listened to for so long after the first joint state."""
CONTROLLERS_S = 2.0
STATES = 4096
SHOWN = 12
"""Names in a message, at most."""

Found = TypeVar("Found")


class Survey(NamedTuple):
    """What was found of a robot.

    Args:
        domain: the names of its nodes.
        namespace: of the robot, as /left; empty: the root.
        description: its URDF; empty: it was not looked for.
        described_by: the topic or parameter that has it.
        joints: what was heard of joint states, by topic.
        images: what was heard of cameras, by topic.
        controllers: topic of trajectories -> joints that its controller says it moves; none: it
            publishes no state, as one that is not active.
    """

    domain: RosDomain
    namespace: str
    description: str
    described_by: str
    joints: Mapping[str, HeardJoints]
    images: Mapping[str, HeardImages]
    controllers: Mapping[str, tuple[str, ...]]


def survey(
    session: SessionProfile,
    *,
    namespace: str | None = None,
    number: int | None = None,
    describe: bool = True,
    timeout_s: float = 10.0,
    tell: Callable[[str], None] = lambda doing: None,
) -> Survey:
    """Look at a robot.

    Args:
        session: leads to the bridge, or to the router of rmw_zenoh.
        namespace: of the robot; None: the only one with a description.
        number: of the ROS domain; None: the only one.
        describe: find the description, too.
        timeout_s: of each step: names, description, joint states.
        tell: is told what is waited for.

    Raises:
        SessionError: no router answers, or there is no ROS domain behind it; says what to do.
        ResourceError: there is no description, or there are several.
    """
    where = ", ".join(session.connect)
    try:
        opened = open_session(session, identity="ros2")
    except SessionError as error:
        raise SessionError(
            f"no Zenoh router answers at {where}: start zenoh-bridge-ros2dds on the robot's "
            "computer (or, where the robot runs rmw_zenoh, its router: ros2 run rmw_zenoh_cpp "
            "rmw_zenohd), and check its address, --connect tcp/ROBOT:7447, port and firewall"
        ) from error
    with opened:
        return _Look(opened, where, timeout_s, tell).survey(namespace, number, describe=describe)


class _Look:
    """One look at a robot."""

    def __init__(
        self, session: zenoh.Session, where: str, timeout_s: float, tell: Callable[[str], None]
    ) -> None:
        self._session, self._where = session, where
        self._timeout_s, self._tell = timeout_s, tell

    def survey(self, namespace: str | None, number: int | None, *, describe: bool) -> Survey:
        within = f"at {self._where}, up to {self._timeout_s:g} s"
        self._tell(f"looking for a ROS 2 robot {within}")
        domain = self._domain(namespace, number, describe=describe)
        settings = Ros2Profile(
            bridge=domain.bridge, domain=domain.number, distribution=domain.distribution
        )
        self._messages = Messages(domain.distribution, DEFINITIONS)
        self._graph = RosGraph(self._session, settings, self._messages, "vla_profile_new")
        try:
            space, text, by = (namespace or "").rstrip("/"), "", ""
            if describe:
                topics, parameters = _descriptions(domain, namespace)
                space, text, by = self._description(domain, topics, parameters)
            joints, images = self._states(domain, space)
            controllers = self._controllers(domain, space)
        finally:
            self._graph.close()
        return Survey(domain, space, text, by, joints, images, controllers)

    # -- names ------------------------------------------------------------------------------------
    def _domain(self, namespace: str | None, number: int | None, *, describe: bool) -> RosDomain:
        """The domain, when its names no longer change and a description is among them."""
        began_s = changed_s = time.monotonic()
        before: list[RosDomain] = []
        while True:
            domains = self._domains()
            now_s = time.monotonic()
            if domains != before:
                before, changed_s = domains, now_s
            wanted = [each for each in domains if number in (None, each.number)]
            described = [each for each in wanted if any(_descriptions(each, namespace))]
            there = described if describe else [each for each in wanted if each.published]
            if there and now_s - changed_s >= SETTLED_S:
                break
            if now_s - began_s > self._timeout_s:
                break
            time.sleep(POLL_S)
        if not wanted:
            raise SessionError(self._nothing(domains, number))
        if len(there) > 1 or (not there and len(wanted) > 1):
            ways = "; ".join(each.way for each in there or wanted)
            raise ResourceError(f"several ROS domains at {self._where}: {ways}. Give --domain")
        if there:
            return there[0]
        raise ResourceError(self._not_described(wanted[0], namespace))

    def _domains(self) -> list[RosDomain]:
        replies = [(k, p) for each in (CONFIGS, ENTITIES) for k, p in self._ask(each)]
        tokens = self._session.liveliness().get(TOKENS_OF_RMW, timeout=ASK_S)
        named = sorted(str(each.ok.key_expr) for each in tokens if each.ok is not None)
        return [*domains_of_bridges(replies), *domains_of_rmw(named)]

    def _ask(self, key: str) -> Iterable[tuple[str, bytes]]:
        for reply in self._session.get(key, timeout=ASK_S):
            if reply.ok is None:
                continue
            try:
                payload = bytes_of(reply.ok.payload, MAX_REPLY_BYTES)
            except CodecError:  # too long for what is asked for here
                continue
            yield str(reply.ok.key_expr), payload

    def _nothing(self, domains: list[RosDomain], number: int | None) -> str:
        if domains:
            ways = "; ".join(each.way for each in domains)
            return f"no ROS domain {number} at {self._where}. There is: {ways}"
        return (
            f"a Zenoh router answers at {self._where}, and no ROS 2 within {self._timeout_s:g} s: "
            "neither a zenoh-bridge-ros2dds nor a node with rmw_zenoh. Connect the bridge to this "
            "router (zenoh-bridge-ros2dds -e), or give the router of the robot with --connect"
        )

    def _not_described(self, domain: RosDomain, namespace: str | None) -> str:
        if not domain.published:
            return (
                f"{domain.way} at {self._where}: no node of ROS is seen there within "
                f"{self._timeout_s:g} s. Does the robot use another ROS_DOMAIN_ID, or the bridge "
                "(zenoh-bridge-ros2dds -d)?"
            )
        topics, parameters = _descriptions(domain, None)
        others = [each.removesuffix(DESCRIPTION) or "/" for each in (*topics, *parameters)]
        if namespace is not None and others:
            spaces = ", ".join(f"--namespace {each}" for each in others)
            return f"no robot_description below {namespace!r} ({domain.way}). There is: {spaces}"
        shown = sorted(domain.published)[:SHOWN]
        more = len(domain.published) - len(shown)
        return (
            f"no node publishes robot_description within {self._timeout_s:g} s ({domain.way}). "
            "Start robot_state_publisher, or give the description as a file beside --ros2. "
            f"Published: {', '.join(shown)}{f' and {more} more' if more else ''}"
        )

    # -- description ------------------------------------------------------------------------------
    def _description(
        self, domain: RosDomain, topics: list[str], parameters: list[str]
    ) -> tuple[str, str, str]:
        """Namespace, text and origin of the only description."""
        if len(topics) > 1 or (not topics and len(parameters) > 1):
            found = topics or parameters
            spaces = [each.removesuffix(DESCRIPTION) or "/" for each in found]
            raise ResourceError(
                f"several robots are described ({domain.way}): {', '.join(found)}. Choose one "
                f"with --namespace: {', '.join(spaces)}"
            )
        for topic in topics:
            self._tell(f"reading {topic}, up to {self._timeout_s:g} s")
            text = self._latched(topic)
            if text is not None:
                return topic.removesuffix(DESCRIPTION), text, f"topic {topic}"
        for name in parameters:
            space = name.removesuffix(DESCRIPTION)
            service = f"{space}{NODE}/get_parameters"
            if service in domain.unreached:
                continue
            self._tell(f"asking {space}{NODE}, up to {self._timeout_s:g} s")
            text = self._parameter(service)
            if text:
                return space, text, f"parameter of {space}{NODE}"
        raise ResourceError(self._silent(domain, topics, parameters))

    def _silent(self, domain: RosDomain, topics: list[str], parameters: list[str]) -> str:
        topic = (topics or parameters)[0]
        service = f"{topic.removesuffix(DESCRIPTION)}{NODE}/get_parameters"
        if not topics:
            why = f"{domain.unreached.get(service, '')} answers no call through the bridge"
            return (
                f"no topic {topic}, and the parameter of {NODE[1:]} cannot be read: {why}. Start a "
                f"{NODE[1:]} that publishes it, or give the description as a file beside --ros2"
            )
        if domain.bridge == "ros2dds":
            return (
                f"a node publishes {topic}, and nothing of it comes through the bridge within "
                f"{self._timeout_s:g} s. Does the bridge's file allow it? That of `profile "
                "bridge-config` does not: start it without one, zenoh-bridge-ros2dds -d "
                f"{domain.number}. Nodes of Kilted need a setting: docs/how-to/ros2.md"
            )
        return f"a node publishes {topic}, and nothing came within {self._timeout_s:g} s"

    def _latched(self, topic: str) -> str | None:
        ring = CallbackRing(4, MAX_MESSAGE_BYTES)
        self._graph.subscribe_to_others(topic, TEXT, ring, LATCHED)
        sample = _until(ring.pop, self._timeout_s)
        if sample is None:
            return None
        payload = bytes_of(sample.sample.payload, MAX_MESSAGE_BYTES)
        try:
            return str(read(self._messages, TEXT, payload))
        except CodecError as error:
            raise ResourceError(f"{topic} cannot be read: {error}") from error

    def _parameter(self, service: str) -> str | None:
        client = self._graph.client(service, GET_PARAMETERS)
        wanted = self._messages.new(f"{GET_PARAMETERS}_Request", names=[PARAMETER])
        request = self._messages.encode(wanted)

        def ask() -> str | None:
            answered = threading.Event()
            answers: list[bytes] = []

            def done(answer: bytes | None) -> None:
                answers.extend([] if answer is None else [answer])
                answered.set()

            client.call(request, done, ASK_S)
            answered.wait(2 * ASK_S)
            for answer in answers:
                try:
                    said = self._messages.decode(f"{GET_PARAMETERS}_Response", answer)
                except CodecError:
                    return None
                return next((str(each.string_value) for each in said.values), None)
            return None

        return _until(ask, self._timeout_s)

    # -- joints and images ------------------------------------------------------------------------
    def _states(
        self, domain: RosDomain, namespace: str
    ) -> tuple[dict[str, HeardJoints], dict[str, HeardImages]]:
        states = {topic: CallbackRing(STATES) for topic in state_topics(domain, namespace)}
        cameras = [*camera_topics(domain, namespace).values()]
        images = {topic: CallbackRing(1, MAX_PICTURE_BYTES) for topic in cameras}
        if not (states or images):
            return {}, {}
        self._tell(f"listening to {len(states)} topic(s) of joints and {len(images)} of images")
        for topic, ring in states.items():
            self._graph.subscribe(topic, JOINT_STATE, ring, SENSOR)
        for topic, ring in images.items():
            self._graph.subscribe(topic.name, topic.type, ring, SENSOR)
        rings = [*states.values(), *images.values()]
        _until(lambda: all(ring.has_new for ring in rings) or None, self._timeout_s / 2)
        # The rate is that of a second in which everything flows.
        counts = [ring.count for ring in rings]
        began_s = time.monotonic()
        time.sleep(LISTEN_S)
        took_s = time.monotonic() - began_s
        rates_hz = [(r.count - n) / took_s for r, n in zip(rings, counts, strict=True)]
        of_states, of_images = rates_hz[: len(states)], rates_hz[len(states) :]
        return (
            {
                topic: self._joints(ring, rate_hz)
                for (topic, ring), rate_hz in zip(states.items(), of_states, strict=True)
            },
            {
                topic.name: image
                for (topic, ring), rate_hz in zip(images.items(), of_images, strict=True)
                if (image := self._image(topic, ring, rate_hz)) is not None
            },
        )

    def _controllers(self, domain: RosDomain, namespace: str) -> dict[str, tuple[str, ...]]:
        """Of each controller of trajectories, the joints that its state names."""
        # With rmw_zenoh the hash is part of the key, and that of the whole message is not known.
        wire = RmwZenoh("", "", domain.number, lambda kind: "*")
        rings: dict[str, CallbackRing] = {}
        for command, state in controller_states(domain, namespace).items():
            ring = rings[command] = CallbackRing(1)
            if domain.bridge == "rmw_zenoh":
                end = Endpoint(EntityRole.SUBSCRIBER, state, CONTROLLER_STATE)
                ring.subscribe(self._session, wire.key(end))
            else:
                self._graph.subscribe(state, CONTROLLER_STATE, ring, SENSOR)
        if rings:
            self._tell(f"listening to {len(rings)} controller(s)")
            _until(lambda: all(ring.has_new for ring in rings.values()) or None, CONTROLLERS_S)
        return {command: self._moved(ring) for command, ring in rings.items()}

    def _moved(self, ring: CallbackRing) -> tuple[str, ...]:
        arrival = ring.pop()
        if arrival is None:
            return ()
        try:
            payload = bytes_of(arrival.sample.payload)
            return tuple(self._messages.decode(CONTROLLER_STATE, payload).joint_names)
        except CodecError:
            return ()

    def _joints(self, ring: CallbackRing, rate_hz: float) -> HeardJoints:
        position: dict[str, float] = {}
        behind_s = 0.0
        for arrival in ring.drain():
            try:
                said = read(self._messages, JOINT_STATE, bytes_of(arrival.sample.payload))
            except CodecError:
                continue
            position |= dict(zip(said.names, said.position.tolist(), strict=True))
            behind_s = (time.time_ns() - said.stamp_ns) / 1e9
        return HeardJoints(rate_hz, position, behind_s)

    def _image(self, topic: Topic, ring: CallbackRing, rate_hz: float) -> HeardImages | None:
        arrival = ring.pop()
        if arrival is None:
            return None
        payload = bytes_of(arrival.sample.payload, MAX_PICTURE_BYTES)
        try:
            height, width = read(self._messages, topic.type, payload).rgb.shape[:2]
        except CodecError:
            return None
        return HeardImages(width, height, rate_hz)


def _descriptions(domain: RosDomain, namespace: str | None) -> tuple[list[str], list[str]]:
    """Topics with a description, and those that a robot_state_publisher's parameter stands for."""
    spaces = None if namespace is None else f"{namespace.rstrip('/')}{DESCRIPTION}"
    topics = [each.name for each in below("", domain.published, [TEXT])]
    topics = [each for each in topics if each.endswith(DESCRIPTION)]
    end = f"{NODE}/get_parameters"
    parameters = [
        f"{name.removesuffix(end)}{DESCRIPTION}" for name in domain.services if name.endswith(end)
    ]
    wanted = [
        [each for each in found if spaces in (None, each)] for found in (topics, sorted(parameters))
    ]
    return wanted[0], wanted[1]


def _until(look: Callable[[], Found | None], timeout_s: float) -> Found | None:
    """What `look` finds; None after `timeout_s`."""
    give_up_s = time.monotonic() + timeout_s
    while (found := look()) is None and time.monotonic() < give_up_s:
        time.sleep(0.02)
    return found
