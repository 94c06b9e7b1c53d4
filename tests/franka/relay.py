"""A cable to the robot that can be pulled: ``python relay.py ADDRESS PORT``.

Stands between driver (which connects to ADDRESS) and franka-sim (127.0.0.1:PORT). A line with a
number of seconds on the standard input pulls the cable for so long: datagrams are lost, both ways,
and what TCP carries is late.
"""

from __future__ import annotations

import os
import selectors
import socket
import struct
import sys
import time

FCI_PORT = 1337
CONNECT = struct.Struct("<IIIHH")
"""Header (command, its number, size), then version and UDP port of the client."""
PRIORITY, MOST = 30, 1 << 16


def main(address: str, port: int) -> None:
    """Serve one client after the other until the standard input ends."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    except OSError:
        print("no real-time priority", flush=True)
    server = socket.socket()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    server.bind((address, FCI_PORT))
    server.listen()
    print("listening", flush=True)
    while True:
        client, (host, _) = server.accept()
        with client, socket.create_connection(("127.0.0.1", port)) as robot:
            carry(client, robot, host, address)


def carry(client: socket.socket, robot: socket.socket, host: str, address: str) -> None:
    """Between one client and the robot, until either hangs up."""
    to_client, to_robot = (socket.socket(type=socket.SOCK_DGRAM) for _ in range(2))
    to_client.bind((address, 0))
    to_robot.bind(("127.0.0.1", 0))
    first = client.recv(CONNECT.size, socket.MSG_WAITALL)
    command, number, size, version, client_port = CONNECT.unpack(first)
    robot.sendall(CONNECT.pack(command, number, size, version, to_robot.getsockname()[1]))
    for plain in (client, robot):
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    ways = selectors.DefaultSelector()
    for read in (client, robot, to_client, to_robot, sys.stdin):
        ways.register(read, selectors.EVENT_READ)
    robot_port, pulled_until_s = 0, 0.0
    with ways, to_client, to_robot:
        while True:
            pulled = time.monotonic() < pulled_until_s
            for key, _ in ways.select(0.001 if pulled else None):
                if key.fileobj is sys.stdin:
                    line = sys.stdin.readline()
                    if not line:
                        sys.exit()
                    pulled_until_s = time.monotonic() + float(line)
                    pulled = True
                elif key.fileobj is to_client:
                    datagram = to_client.recv(MOST)
                    if robot_port and not pulled:
                        to_robot.sendto(datagram, ("127.0.0.1", robot_port))
                elif key.fileobj is to_robot:
                    datagram, (_, robot_port) = to_robot.recvfrom(MOST)
                    if not pulled:
                        to_client.sendto(datagram, (host, client_port))
                elif not pulled:
                    source = key.fileobj
                    data = source.recv(MOST) if isinstance(source, socket.socket) else b""
                    if not data:
                        return
                    (robot if source is client else client).sendall(data)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
