"""vla-zenoh serve mcp: the robot for agents."""

from __future__ import annotations

import os
import sys

from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import options
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.client.remote_robot import RemoteRobot
from vla_zenoh.security.roles import Role
from vla_zenoh.security.store import local_role
from vla_zenoh_mcp.server import McpServer


@options
def mcp(target: RobotTarget) -> None:
    """Serve the primitives, state and cameras to an agent: an MCP server on stdin and stdout.

    With the rights of this computer's certificate. It ends with its stdin; then the arm brakes.
    """
    profile = target.load()
    drives = local_role(profile) in (None, Role.OPERATOR)
    # What any library prints must not get between the answers.
    out = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    with open_session(profile.session) as session:
        robot = RemoteRobot(profile, session)
        robot.subscribe()
        McpServer(robot, out, drives=drives).serve(sys.stdin.buffer)
