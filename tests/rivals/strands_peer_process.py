"""Runs in the environment of strands-robots: a peer of its own mesh, or its agents' tool.

    python strands_peer_process.py NAME     # a line of JSON in, a line of JSON out

Lines: ``{"do": "tell", "peer": ..., "instruction": ..., ...}``, and so on: `Peer` has the verbs. It
has a robot that follows no policy: what is asked of it is kept.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from importlib import import_module
from pathlib import Path
from typing import Any


class Robot:
    """A robot as their mesh takes it."""

    tool_name_str = "robot"

    def __init__(self) -> None:
        self.stops = 0

    def stop_task(self) -> dict[str, Any]:
        self.stops += 1
        return {"status": "success"}


class Peer:
    """One peer of the mesh and what it was asked."""

    def __init__(self, name: str) -> None:
        self.robot, core = Robot(), import_module("strands_robots.mesh.core")
        self.mesh = core.init_mesh(self.robot, peer_id=name)
        assert self.mesh is not None
        assert self.mesh.alive
        self.seen: dict[str, Any] = {}

    def peers(self) -> Any:
        return {one["peer_id"]: one for one in self.mesh.peers}

    def tell(self, peer: str, **fields: Any) -> Any:
        return self.mesh.tell(peer, **fields)

    def send(self, peer: str, command: dict[str, Any], timeout: float = 10.0) -> Any:
        return self.mesh.send(peer, command, timeout=timeout)

    def ping(self, peer: str) -> Any:
        return self.mesh.ping(peer)

    def watch(self, key: str) -> Any:
        """Keep the newest message of a key."""

        def keep(_: str, body: dict[str, Any]) -> None:
            self.seen[key] = body

        return self.mesh.subscribe(key, callback=keep)

    def newest(self, key: str) -> Any:
        return self.seen.get(key)

    def estop(self) -> Any:
        return self.mesh.emergency_stop()

    def publish(self, key: str, body: dict[str, Any]) -> Any:
        self.mesh.publish(key, body)

    def stopped(self) -> Any:
        """Their lock-out, and how often their robot was stopped."""
        return {"locked": self.mesh._estop_lockout.is_set(), "stops": self.robot.stops}

    def tool(self, **arguments: Any) -> Any:
        """Their agents' tool."""
        return import_module("strands_robots.tools.robot_mesh").robot_mesh._tool_func(**arguments)

    def publish_signed(self, certificate: str, key: str, messages: list[Any]) -> Any:
        """Publish messages of now, signed by their own code."""
        wire = import_module("strands_robots.mesh.wire_identity")
        identity = wire.WireIdentity._from_files(Path(certificate), Path(key), "test")
        for to, body in messages:
            self.mesh.publish(to, wire.sign(identity, {**body, "timestamp": time.time()}))
            time.sleep(0.1)  # the order is heard after the presence

    def verify(self, authority: str, message: dict[str, Any]) -> Any:
        """Who signed a message, or why it is refused, by their own code."""
        wire = import_module("strands_robots.mesh.wire_identity")
        roots = wire.TrustRoots.from_pem(Path(authority).read_bytes())
        found = wire.verify(roots, message)
        return {"refused": found} if isinstance(found, str) else {"cn": found.cn}


def main(name: str) -> None:
    """Answer lines, each on a thread of its own: an order may take its time."""
    peer, lock = Peer(name), threading.Lock()

    def answer(number: int, do: str, fields: dict[str, Any]) -> None:
        try:
            found = getattr(peer, do)(**fields)
        except Exception as error:  # of theirs: the test sees it
            found = {"raised": f"{type(error).__name__}: {error}"}
        with lock:
            print(json.dumps({"number": number, "found": found}), flush=True)

    print("READY", flush=True)
    for line in sys.stdin:
        question = json.loads(line)
        number, do = question.pop("number"), question.pop("do")
        threading.Thread(target=answer, args=(number, do, question), daemon=True).start()
    peer.mesh.stop()


if __name__ == "__main__":
    main(sys.argv[1])
