"""Runs in the environment of trossen-arm-sim: its controller, the maker's client, or a stranger.

    python trossen_process.py controller           # a line of JSON in, a line of JSON out
    python trossen_process.py client               # likewise
    python trossen_process.py stranger JOINT RAD   # datagrams at 200 Hz, until its input ends

The controller is the package's own server, simulation and contact monitor; a thread of ours writes
down where the simulated joints are. The client is the maker's library and nothing else.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from importlib import import_module
from typing import Any

HOST = "127.0.0.1"
WATCH_S, COMMAND_S = 0.005, 0.005
PATIENCE_S = 3.0


def tell(**values: Any) -> None:
    print(json.dumps(values), flush=True)


def control() -> None:
    """Be a controller: ``{"fault": NAME}``, ``{"since": s}`` asks where joints were."""
    package = import_module("trossen_arm_sim")
    errors = import_module("trossen_arm_sim.protocol").ErrorState
    sim = package.WidowXSim()
    monitor = package.CollisionMonitor(sim)
    rows: list[tuple[float, list[float]]] = []

    def watch() -> None:
        while True:
            joints = [output.position for output in sim.read_joint_outputs()]
            rows.append((time.monotonic(), joints))
            time.sleep(WATCH_S)

    sim.start()
    server = package.TrossenArmSimServer(sim, host=HOST)
    server.start()
    threading.Thread(target=watch, daemon=True).start()
    tell(ready=True)
    for line in sys.stdin:
        asked = json.loads(line)
        if "fault" in asked:
            server.fault(errors[asked["fault"]], "a test of ours")
        since_s = asked.get("since", float("inf"))
        tell(
            rows=[row for row in rows if row[0] >= since_s],
            modes=[mode.name for mode in server.modes],
            contacts=[contact.to_dict() for contact in monitor.active_contacts()],
        )


def drive() -> None:
    """Be the maker's client: ``{"to": [7 joints], "in": s}``, ``{}`` asks where it is."""
    library = import_module("trossen_arm")
    driver = library.TrossenArmDriver()
    try:
        end_effector = library.StandardEndEffector.wxai_v0_follower
        driver.configure(library.Model.wxai_v0, end_effector, HOST, False, PATIENCE_S)
    except RuntimeError as error:
        tell(refused=str(error).splitlines()[0])
        return
    driver.set_all_modes(library.Mode.position)
    tell(ready=True)
    for line in sys.stdin:
        asked = json.loads(line)
        if "to" in asked:
            driver.set_all_positions(asked["to"], asked["in"], True)
        tell(at=list(driver.get_all_positions()))
    driver.cleanup()


def intrude(joint: int, target_rad: float) -> None:
    """Be a stranger who sends targets of one joint to the controller's UDP port, zero else."""
    protocol = import_module("trossen_arm_sim.protocol")
    position = protocol.JOINT_INPUT_STRUCT
    idle = position.pack(protocol.Mode.IDLE, 0.0, 0.0, 0.0)
    inputs = [idle] * protocol.NUM_JOINTS
    inputs[joint] = position.pack(protocol.Mode.POSITION, target_rad, 0.0, 0.0)
    datagram = bytes([protocol.UDPCommand.SET_ROBOT_INPUT]) + b"".join(inputs)
    done = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), done.set()), daemon=True).start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        tell(ready=True)
        while not done.wait(COMMAND_S):
            sender.sendto(datagram, (HOST, protocol.UDP_PORT))


if __name__ == "__main__":
    role = sys.argv[1]
    if role == "stranger":
        intrude(int(sys.argv[2]), float(sys.argv[3]))
    else:
        {"controller": control, "client": drive}[role]()
