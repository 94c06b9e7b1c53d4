"""Somebody at the robot's ROS 2: an rclpy node that does what a test says, and tells what it hears.

Commands on stdin, one JSON object a line:

    {"do": "hear", "topic": "/vla/status", "type": "diagnostic_msgs/msg/DiagnosticArray", "qos": {}}
    {"do": "offer", "topic": "/vla/prompt", "type": "std_msgs/msg/String"}
    {"do": "say", "topic": "/vla/prompt", "type": "std_msgs/msg/String", "value": {"data": "hold"}}
    {"do": "call", "service": "/vla/stop", "type": "std_srvs/srv/Trigger", "value": {}}
    {"do": "graph"}

`say` waits until somebody listens, unless `wait_s` is 0; `bytes` (hex) instead of `value` is
published as it is, as `ros2 bag play` does. `offer` makes its publisher and publishes nothing; it
and `hear` tell the ids in DDS of this node's ends of the topic.
"""

from __future__ import annotations

import array
import contextlib
import importlib
import threading
import time
from typing import Any

import numpy as np
import rclpy
from qos import publishes, qos, subscribes
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from told import obey, tell

NAME = "person"
BIG = 256


def type_of(name: str) -> Any:
    """The Python class of a ROS type such as ``std_msgs/msg/String``."""
    package, room, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.{room}"), kind)


def plain(value: Any) -> Any:
    """A message as JSON has it; of long arrays only how long."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, (array.array, np.ndarray, bytes)):
        return list(value) if len(value) <= BIG else {"length": len(value)}
    return [plain(each) for each in value] if isinstance(value, (list, tuple)) else value


def filled(message: Any, fields: dict[str, Any]) -> Any:
    """`message` with these fields."""
    for name, value in fields.items():
        if isinstance(value, dict):
            filled(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


class Person:
    """See the module."""

    def __init__(self) -> None:
        self._node = rclpy.create_node(NAME)
        self._executor = SingleThreadedExecutor()
        self._said: dict[Any, Any] = {}
        self._heard: list[Any] = []

    def hear(self, topic: str, type: str, qos_of: Any = None, every: int = 1) -> None:
        """Subscribe; `every`: tell of one message in so many."""
        count = [0]

        def on_message(message: Any) -> None:
            wall_ns = time.time_ns()
            count[0] += 1
            if count[0] % every == 0:
                tell(heard=topic, wall_ns=wall_ns, value=plain(message))

        self._heard.append(
            self._node.create_subscription(
                type_of(type),
                topic,
                on_message,
                qos(**(qos_of or {})),
                event_callbacks=subscribes(topic),
            )
        )
        tell(hears=topic, ids=ids_of(self._node.get_subscriptions_info_by_topic(topic)))

    def offer(self, topic: str, type: str, qos_of: Any = None) -> None:
        """Be a publisher of a topic."""
        self._publisher(topic, type, qos_of)
        tell(offers=topic, ids=ids_of(self._node.get_publishers_info_by_topic(topic)))

    def _publisher(self, topic: str, type: str, qos_of: Any) -> Any:
        key = (topic, str(qos_of))
        if key not in self._said:
            self._said[key] = self._node.create_publisher(
                type_of(type), topic, qos(**(qos_of or {})), event_callbacks=publishes(topic)
            )
        return self._said[key]

    def say(
        self,
        topic: str,
        type: str,
        value: Any = None,
        bytes: str | None = None,
        qos_of: Any = None,
        wait_s: float = 10.0,
        count: int = 1,
        rate_hz: float = 10.0,
        stamped: bool = False,
    ) -> None:
        """Publish; `stamped`: each with the time in its header."""
        publisher = self._publisher(topic, type, qos_of)
        give_up_s = time.monotonic() + wait_s
        while not publisher.get_subscription_count() and time.monotonic() < give_up_s:
            time.sleep(0.005)
        message = filled(type_of(type)(), value or {})
        for number in range(count):
            if number:
                time.sleep(1 / rate_hz)
            if stamped:
                message.header.stamp = self._node.get_clock().now().to_msg()
            wall_ns = time.time_ns()
            publisher.publish(message if bytes is None else bytes_of(bytes))
            tell(said=topic, wall_ns=wall_ns, listeners=publisher.get_subscription_count())

    def unsay(self) -> None:
        """Take every publisher back, where nothing waits for one at that moment."""
        publishers = list(self._said.values())
        self._said.clear()

        def take_back() -> None:
            for publisher in publishers:
                self._node.destroy_publisher(publisher)

        self._executor.create_task(take_back)

    def call(self, service: str, type: str, value: Any = None, patience_s: float = 10.0) -> None:
        """Call a service."""
        kind = type_of(type)
        client = self._node.create_client(kind, service)
        found = client.wait_for_service(patience_s)
        answered = threading.Event()
        future = client.call_async(filled(kind.Request(), value or {})) if found else None
        if future is not None:
            future.add_done_callback(lambda _: answered.set())
            answered.wait(patience_s)
        answer = plain(future.result()) if future is not None and future.done() else None
        self._executor.create_task(lambda: self._node.destroy_client(client))
        tell(called=service, found=found, answer=answer)

    def graph(self) -> None:
        """Names of topics and services, with their types."""
        topics = dict(self._node.get_topic_names_and_types())
        services = dict(self._node.get_service_names_and_types())
        tell(topics=topics, services=services)

    def spin(self) -> None:
        """Serve until ROS ends."""
        self._executor.add_node(self._node)
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()


def ids_of(ends: Any) -> list[str]:
    """Of this node's among the ends of a topic, in hexadecimal."""
    return [bytes(end.endpoint_gid).hex() for end in ends if end.node_name == NAME]


def bytes_of(text: str) -> bytes:
    """Bytes of hex digits."""
    return bytes.fromhex(text)


def main() -> None:
    """Do what stdin says."""
    rclpy.init()
    person = Person()
    threading.Thread(target=person.spin).start()
    tell(ready=rclpy.get_rmw_implementation_identifier())
    names = ("hear", "offer", "say", "unsay", "call", "graph")
    obey({name: getattr(person, name) for name in names})
    rclpy.shutdown()


if __name__ == "__main__":
    main()
