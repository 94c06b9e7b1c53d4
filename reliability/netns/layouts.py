"""The labs in which faults happen: their hosts, and what runs where."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

SMALL_MTU = 1280
"""What IPv6 asks of every link, and many a tunnel has."""
FRONT = "sim:front"
PICTURE = f"file:{Path(__file__).resolve().parents[2] / 'docs/images/front.png'}"
"""A camera that stamps its pictures by its own clock; those of the simulator have the scene's."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Hosts of a lab.

    Args:
        plain: its profile on loopback.
        hosts: names.
        routers: those that run one, the first one first.
        shaped: whose link can be made bad.
        clocks: whose wall clock can be set.
        mtu: of all its links, from the beginning; 0: the usual one.
    """

    plain: str
    hosts: tuple[str, ...]
    routers: tuple[str, ...]
    shaped: tuple[str, ...] = ()
    clocks: tuple[str, ...] = ()
    mtu: int = 0


def _profile(extends: str, more: str = "", front: str = FRONT) -> str:
    camera = f'{{source: "{front}", width: 160, height: 120, rate_hz: 20}}'
    return f"extends: {extends}\ncameras:\n  front: {camera}\n  wrist: null\n{more}"


def _eyes(front: str = FRONT, clocks: tuple[str, ...] = ()) -> Layout:
    """The cameras have a computer of their own."""
    hosts = (
        "hosts:\n"
        "  robot: {nodes: [router, sim, command]}\n"
        "  eyes: {nodes: [camera], connect: [tcp/127.0.0.1:7447]}\n"
        "  gpu: {nodes: [worker], connect: [tcp/127.0.0.1:7447]}\n"
    )
    plain = _profile("panda_sim_lab", hosts, front)
    return Layout(plain, ("robot", "eyes", "gpu"), ("robot",), clocks=clocks)


LAYOUTS = {
    # The robot's computer, one for models, and a desk.
    "lab": Layout(_profile("panda_sim_lab"), ("robot", "gpu", "desk"), ("robot",), ("gpu",)),
    # The same, and no link carries more than IPv6 asks of every link.
    "narrow": Layout(
        _profile("panda_sim_lab"), ("robot", "gpu"), ("robot",), ("gpu",), mtu=SMALL_MTU
    ),
    "eyes": _eyes(),
    "eyes-clock": _eyes(PICTURE, clocks=("eyes",)),
    # Robot and cameras each on the network, the router on neither.
    "apart": Layout(
        _profile(
            "panda_sim_lab",
            "hosts:\n"
            "  hub: {nodes: [router]}\n"
            "  robot: {nodes: [sim, command]}\n"
            "  eyes: {nodes: [camera]}\n"
            "  gpu: {nodes: [worker]}\n",
        ),
        ("hub", "robot", "eyes", "gpu"),
        ("hub",),
        ("robot", "eyes"),
    ),
    # The robot with a router and one in reserve, the model at another site with its own.
    "sites": Layout(
        _profile("panda_sim_two_sites"),
        ("robot", "spare", "gpu"),
        ("robot", "spare", "gpu"),
        ("gpu",),
    ),
    # The first one with wall clocks of their own.
    "clocks": Layout(
        _profile("panda_sim_lab"), ("robot", "gpu"), ("robot",), clocks=("robot", "gpu")
    ),
    # Two routers that are nobody else's computer.
    "routers": Layout(
        _profile(
            "panda_sim",
            "session:\n"
            "  listen: [tcp/127.0.0.1:7447]\n"
            "  connect: [tcp/127.0.0.1:7447, tcp/127.0.0.1:7457]\n"
            "  separate_links: true\n"
            "hosts:\n"
            "  hub: {nodes: [router], connect: [tcp/127.0.0.1:7447]}\n"
            "  spare:\n"
            "    nodes: [router]\n"
            "    listen: [tcp/127.0.0.1:7457]\n"
            "    link: [tcp/127.0.0.1:7447]\n"
            "    connect: [tcp/127.0.0.1:7457]\n"
            "  robot: {nodes: [sim, camera, command]}\n"
            "  gpu: {nodes: [worker]}\n",
        ),
        ("hub", "spare", "robot", "gpu"),
        ("hub", "spare"),
    ),
}
