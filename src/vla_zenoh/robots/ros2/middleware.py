"""Watches which middleware the robot's ROS nodes use, and says what does not work with it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import zenoh

from vla_zenoh.profile.robot import GRIPPER_ACTIONS, Ros2Profile
from vla_zenoh.robots.ros2.ros_graph import RosGraph
from vla_zenoh.ros2.bridge_view import SERVES, BridgeView
from vla_zenoh.types import Event

PERIOD_S = 5.0
GRIPPER = "gripper_middleware"


class MiddlewareWatch:
    """Looks at the bridge's DDS domain now and then; `run` is the body of a thread.

    Attributes:
        view: bridges and middleware, as they were last seen.
        faults: name -> what does not work, and what to do.
    """

    def __init__(self, graph: RosGraph, ros2: Ros2Profile, emit: Callable[[Event], None]) -> None:
        self._graph, self._ros2, self._emit = graph, ros2, emit
        self.view = BridgeView({}, {})
        self.faults: dict[str, str] = {}

    def run(self, stop: threading.Event) -> None:
        """Look until `stop` is set."""
        while not stop.is_set():
            self.look()
            stop.wait(PERIOD_S)

    def look(self) -> None:
        """Ask the bridge, and emit an event for each new fault."""
        try:
            self.view = self._graph.view()
            faults = dict(self._find())
        except zenoh.ZError:  # the session closes
            return
        for what, why in faults.items():
            if what not in self.faults:
                self._emit(Event("warning", "notice", what, why))
        self.faults = faults

    def about(self) -> list[str]:
        """Sentences for the ROS log."""
        seen = ", ".join(self.view.middleware) or "no DDS participant"
        return [f"the bridge sees {seen}", *self.faults.values()]

    def _find(self) -> Iterator[tuple[str, str]]:
        ros2, view = self._ros2, self.view
        domains = {domain for domain in view.domains.values() if domain is not None}
        if domains and ros2.domain not in domains:
            served = ", ".join(map(str, sorted(domains)))
            why = f"the bridge serves ROS domain {served}, ros2.domain is {ros2.domain}"
            yield "ros_domain", why
        if view.doubled:
            yield (
                "two_bridges",
                f"{len(view.doubled)} bridges serve one ROS domain, so everything arrives twice: "
                f"end all but one ({', '.join(view.doubled)})",
            )
        if ros2.prefix is not None and ros2.services:
            others = self._graph.callers_of(ros2.prefix) - {SERVES}
            if others:
                yield (
                    "services_middleware",
                    f"a client of {ros2.prefix}'s services uses {_and(others)}, whose calls no "
                    f"bridge carries: it waits for ever. Use the topics, or {SERVES} there",
                )
        others = self._gripper_servers() - {SERVES}
        if others and ros2.gripper is not None:
            yield (
                GRIPPER,
                f"the gripper's action {ros2.gripper.topic} is served by {_and(others)}, to which "
                f"no bridge carries a goal: command it by a topic (ros2.gripper), or start its "
                f"node with {SERVES}",
            )

    def _gripper_servers(self) -> frozenset[str]:
        gripper = self._ros2.gripper
        if gripper is None or gripper.type not in GRIPPER_ACTIONS:
            return frozenset()
        actions = [each for each in (gripper.topic, gripper.grasp) if each is not None]
        return frozenset().union(*map(self._graph.servers_of, actions))


def _and(names: frozenset[str]) -> str:
    return " and ".join(sorted(names))
