"""Which middleware the robot's ROS nodes use, by what the bridge says, and what does not work."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.errors import CodecError
from vla_zenoh.profile import Profile, SessionProfile
from vla_zenoh.profile.robot import GRIPPER_ACTIONS, Ros2Gripper
from vla_zenoh.profile.schema import TRUSTED_PROTOCOLS
from vla_zenoh.types import Event
from vla_zenoh_ros2.bridge_view import (
    MAX_REPLY_BYTES,
    SERVES,
    VIEW_KEYS,
    BridgeView,
    any_active,
    any_transient_local,
    endpoints_key,
    read_view,
    route_key,
    vendors,
)

ASK_S = 1.0
"""Timeout of a query."""
PERIOD_S, ROUTED_S = 5.0, 2.0


def gripper_fault(part: str) -> str:
    """Name of the fault that a part's gripper is not reached; of one arm the part is empty."""
    return f"{part}_gripper_middleware" if part else "gripper_middleware"


class Bridges:
    """Queries to the bridges that a session reaches, about DDS; each waits up to `ASK_S`.

    With rmw_zenoh there is neither, and nothing is found.

    Args:
        session: that reaches the bridges.
        profile: of the robot.
        silent: gives the robot's topics on which nothing comes.
    """

    def __init__(
        self, session: zenoh.Session, profile: Profile, silent: Callable[[], Iterable[str]] = tuple
    ) -> None:
        ros2 = profile.ros2
        assert ros2 is not None
        self._session, self._ros2, self._silent = session, ros2, silent
        names = profile.part_names if profile.robot.driver == "ros2" else ()
        self._arms = {name: profile.of_part(name).ros2 or ros2 for name in names}
        self._command = f"{profile.robot.command}_command"

    def view(self) -> BridgeView:
        """Bridges and the middleware that they see."""
        return read_view(reply for key in VIEW_KEYS for reply in self._ask(key))

    def has_transient_local(self, topic: str) -> bool:
        """Whether somebody publishes a topic transient_local: it is sent again to late readers."""
        return any_transient_local(self._ask(endpoints_key("writer", f"rt{topic}")))

    def faults(self, view: BridgeView) -> Iterator[tuple[str, str]]:
        """What does not work, each with its name and what to do."""
        ros2 = self._ros2
        domains = {domain for domain in view.domains.values() if domain is not None}
        if domains and ros2.domain not in domains:
            served = ", ".join(map(str, sorted(domains)))
            yield "ros_domain", f"the bridge serves domain {served}, ros2.domain is {ros2.domain}"
        if view.doubled:
            why = (
                f"{len(view.doubled)} bridges serve one ROS domain, so everything arrives twice: "
                f"end all but one ({', '.join(view.doubled)})"
            )
            yield "two_bridges", why
        cut_off = [topic for topic in self._commanded() if self._cut_off(topic)]
        if cut_off:
            why = (
                f"a node subscribes to {' and '.join(cut_off)}, and the bridge sends it nothing: "
                "restart the bridge. It loses a node that was started again within the lease of "
                "the one before (Fast DDS: 20 s), and lets through what its settings had when it "
                "started (vla-zenoh profile bridge-config)"
            )
            yield "not_routed", why
        published = [
            topic for topic in self._silent() if self._ask(endpoints_key("writer", f"rt{topic}"))
        ]
        if published:
            why = (
                f"a node publishes {' and '.join(published)}, and nothing of it comes through the "
                "bridge. A node on Fast DDS 3 (ROS 2 Kilted) that is started after it needs the "
                "property fastdds.type_propagation=disabled: set it and start the node again"
            )
            yield "not_matched", why
        callers = self._callers() - {SERVES}
        if callers:
            why = (
                f"a client of our services uses {_and(callers)}, whose calls no bridge carries: it "
                f"waits for ever. Use the topics below {ros2.prefix}, or {SERVES} there"
            )
            yield "services_middleware", why
        for part, one in self._arms.items():
            servers = self._servers(one.gripper) - {SERVES}
            if servers and one.gripper is not None:
                why = (
                    f"the gripper's action {one.gripper.topic} is served by {_and(servers)}, to "
                    "which no bridge carries a goal: command it by a topic (ros2.gripper), or "
                    f"start its node with {SERVES}"
                )
                yield gripper_fault(part), why

    def _commanded(self) -> list[str]:
        """Topics of our set-points."""
        outputs = [getattr(one, self._command) for one in self._arms.values()]
        return [output.topic for output in outputs if output is not None]

    def _cut_off(self, topic: str) -> bool:
        """Whether a robot's node subscribes to our set-points and a bridge passes none on.

        It routes a new subscriber within a second, so it is asked twice.
        """
        for pause_s in (ROUTED_S, 0.0):
            if not self._ask(endpoints_key("reader", f"rt{topic}")):
                return False
            if any_active(self._ask(route_key(topic))):
                return False
            time.sleep(pause_s)
        return True

    def _callers(self) -> frozenset[str]:
        if self._ros2.prefix is None or not self._ros2.services:
            return frozenset()
        return vendors(self._ask(endpoints_key("writer", f"rq{self._ros2.prefix}/**")))

    def _servers(self, gripper: Ros2Gripper | None) -> frozenset[str]:
        if gripper is None or gripper.type not in GRIPPER_ACTIONS:
            return frozenset()
        actions = [each for each in (gripper.topic, gripper.grasp) if each is not None]
        topics = [f"rq{action}/_action/send_goalRequest" for action in actions]
        return frozenset().union(*(vendors(self._ask(endpoints_key("reader", t))) for t in topics))

    def _ask(self, key: str) -> list[tuple[str, bytes]]:
        found: list[tuple[str, bytes]] = []
        if self._ros2.bridge != "ros2dds":
            return found
        for reply in self._session.get(key, timeout=ASK_S):
            if reply.ok is not None:
                with contextlib.suppress(CodecError):  # too large
                    payload = bytes_of(reply.ok.payload, MAX_REPLY_BYTES)
                    found.append((str(reply.ok.key_expr), payload))
        return found


def bridge_session(profile: Profile) -> SessionProfile:
    """How the bridge is reached, or the robot's router."""
    ros2 = profile.ros2
    if ros2 is None or ros2.connect is None:
        return profile.session
    more: dict[str, Any] = {"connect": ros2.connect}
    if all(each.partition("/")[0] in TRUSTED_PROTOCOLS for each in ros2.connect):
        more |= {"listen": ros2.connect, "security": profile.session.security}
    return SessionProfile(lease_ms=profile.session.lease_ms, **more)


class MiddlewareWatch:
    """Asks the bridges now and then; `run` is the body of a thread.

    Attributes:
        view: bridges and middleware, as they were last seen.
        faults: name -> what does not work, and what to do.
    """

    def __init__(self, bridges: Bridges, emit: Callable[[Event], None]) -> None:
        self._bridges, self._emit = bridges, emit
        self.view = BridgeView({}, {})
        self.faults: dict[str, str] = {}

    def run(self, stop: threading.Event) -> None:
        """Ask until `stop` is set."""
        while not stop.is_set():
            with contextlib.suppress(zenoh.ZError):  # the session closes
                self.look()
            stop.wait(PERIOD_S)

    def look(self) -> None:
        """Ask the bridges, and emit an event for each new fault."""
        self.view = self._bridges.view()
        faults = dict(self._bridges.faults(self.view))
        for what in faults.keys() - self.faults.keys():
            self._emit(Event("warning", "notice", what, faults[what]))
        self.faults = faults

    def about(self) -> list[str]:
        """Sentences for the ROS log."""
        seen = ", ".join(self.view.middleware) or "no DDS participant"
        return [f"the bridge sees {seen}", *self.faults.values()]


def _and(names: frozenset[str]) -> str:
    return " and ".join(sorted(names))
