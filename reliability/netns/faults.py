"""The faults of a lab network, each of them done to real processes on a real network stack."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from netns.layouts import SMALL_MTU
from netns.rows import Fault
from netns.site import compiler
from netns.stage import Stage
from netns.wire import CUT, GOOD, Shape

LOSSES = (0.0, 0.01, 0.02, 0.05, 0.10)
DELAYS_MS = ((20, 5), (50, 10), (100, 20), (200, 40))
CUTS_S = (0.1, 0.5, 1.0, 5.0, 20.0, 60.0)
CLOCK_STEP_S = 2.0
SMALL = Shape(mtu=SMALL_MTU)
TWIN_S = 30.0
"""At least: a twin goes on trying for some 20 s, and its end is part of the fault."""
REFUSED = "is already running"


def _nothing(_: Stage) -> None:
    """It ends by itself."""


def _shape(shape: Shape, stage: Stage, host: str = "gpu") -> None:
    stage.site.hosts.shape(host, shape)


_good = partial(_shape, GOOD)


def _bad_link(name: str, about: str, shape: Shape, *, goes_on: bool = True) -> Fault:
    return Fault(name, about, partial(_shape, shape), _good, goes_on=goes_on)


def _kill_router(stage: Stage, host: str = "robot") -> float:
    return stage.site.hosts[host].kill("router")


def _crash_hub(stage: Stage) -> float:
    return stage.site.hosts["hub"].crash()


def _hub_again(stage: Stage) -> None:
    stage.site.up("hub")


def _pull_eyes(stage: Stage) -> None:
    stage.site.hosts.cut("eyes")


def _plug_eyes(stage: Stage) -> None:
    stage.site.hosts.cut("eyes", cable=False)


def _twin(name: str, about: str, host: str) -> Fault:
    """The part of `host` a second time, by a computer that calls itself so, until it gives up."""

    def start(stage: Stage) -> None:
        stage.site.impostor("desk", host)

    def given_up(stage: Stage) -> bool:
        return stage.site.hosts["desk"].processes[-1].poll() is not None

    def missing(stage: Stage) -> str:
        said = stage.site.impostor_log.read_text()
        return "" if REFUSED in said else f"no twin was told that it {REFUSED}: {said[-300:]!r}"

    def end(stage: Stage) -> None:
        stage.site.hosts["desk"].crash()

    return Fault(
        name, about, start, end, seconds=TWIN_S, over=given_up, missing=missing, goes_on=True
    )


def _set_clock(host: str, step_s: float, layout: str) -> Fault:
    return Fault(
        f"clock-{host}{step_s:+g}",
        f"the clock of {host} is set by {step_s:+g} s",
        partial(_step_clock, host, step_s),
        partial(_step_clock, host, 0.0),
        layout=layout,
        needs="" if compiler() else "there is no C compiler",
        seconds=4.0,
    )


def _small_link(stage: Stage) -> None:
    stage.site.hosts.set_mtu("gpu", SMALL_MTU)
    _shape(SMALL, stage)


def _usual_link(stage: Stage) -> None:
    stage.site.hosts.set_mtu("gpu")
    _good(stage)


def _step_clock(host: str, step_s: float, stage: Stage) -> None:
    stage.site.step_clock(host, step_s)


def catalogue() -> Iterator[Fault]:
    """All of them, those of one layout together."""
    yield from _links()
    yield from _cuts()
    yield Fault(
        "mtu",
        "the model's link and host go down to an MTU of 1280",
        _small_link,
        _usual_link,
        seconds=8.0,
    )
    yield Fault(
        "mtu-silent",
        "packets above 1280 bytes vanish, and nobody is told",
        partial(_shape, SMALL),
        _good,
        seconds=8.0,
    )
    yield _twin(
        "twin", "a second computer called gpu, with its certificates, starts the same worker", "gpu"
    )
    yield _twin(
        "twin-robot",
        "a second computer called robot, with its certificates, starts all of its nodes",
        "robot",
    )
    yield Fault(
        "mtu-ever",
        "every link of the lab has an MTU of 1280, always",
        _nothing,
        _nothing,
        layout="narrow",
        ever=True,
        goes_on=True,
    )
    for host in ("gpu", "robot"):
        for step_s in (CLOCK_STEP_S, -CLOCK_STEP_S):
            yield _set_clock(host, step_s, "clocks")
    for step_s in (CLOCK_STEP_S, -CLOCK_STEP_S):
        yield _set_clock("eyes", step_s, "eyes-clock")
    yield Fault(
        "router-killed",
        "the only router is killed (SIGKILL); its supervisor starts it again",
        _kill_router,
        _nothing,
        seconds=1.0,
        from_fault=True,
        alone=True,
    )
    yield Fault(
        "router-moved",
        "the computer of the first router dies; another one has a second",
        _crash_hub,
        _hub_again,
        layout="routers",
        seconds=1.0,
        from_fault=True,
        alone=True,
    )
    yield Fault(
        "camera-pulled",
        "the cable of the camera's computer is pulled for 5 s",
        _pull_eyes,
        _plug_eyes,
        layout="eyes",
        seconds=5.0,
    )

    yield from _other_links()
    yield from _sites()


def _other_links() -> Iterator[Fault]:
    """Of the robot's and the camera's computer, where the router is on neither."""
    for host, whose, shapes in (
        (
            "eyes",
            "the camera's link",
            {
                "loss-5": ("loses 5% of all frames", Shape(loss=0.05)),
                "delay-100": (
                    "takes 100 ms more each way, +-20 ms",
                    Shape(delay_s=0.1, jitter_s=0.02),
                ),
                "slow": ("carries 1 Mbit/s", Shape(rate_bit_s=1e6)),
            },
        ),
        (
            "robot",
            "the robot's link",
            {
                "loss-1": ("loses 1% of all frames", Shape(loss=0.01)),
                "loss-1-ever": ("loses 1% of all frames, always", Shape(loss=0.01)),
                "delay-20-ever": (
                    "takes 20 ms more each way, +-5 ms, always",
                    Shape(delay_s=0.02, jitter_s=0.005),
                ),
                "loss-5": ("loses 5% of all frames", Shape(loss=0.05)),
                "delay-20": (
                    "takes 20 ms more each way, +-5 ms",
                    Shape(delay_s=0.02, jitter_s=0.005),
                ),
                "delay-100": (
                    "takes 100 ms more each way, +-20 ms",
                    Shape(delay_s=0.1, jitter_s=0.02),
                ),
                "slow": ("carries 1 Mbit/s", Shape(rate_bit_s=1e6)),
            },
        ),
    ):
        good = partial(_shape, GOOD, host=host)
        for name, (does, shape) in shapes.items():
            yield Fault(
                f"{host}-{name}",
                f"{whose} {does}",
                partial(_shape, shape, host=host),
                good,
                layout="apart",
                ever=name.endswith("-ever"),
                alone=host == "robot",
            )
        for seconds in (0.5, 5.0):
            yield Fault(
                f"{host}-cut-{seconds:g}",
                f"{whose} is dead for {seconds:g} s",
                partial(_shape, CUT, host=host),
                good,
                layout="apart",
                seconds=seconds,
                alone=host == "robot",
            )


def _sites() -> Iterator[Fault]:
    """Two sites with a router each, and a second one at the robot's."""
    yield Fault(
        "site-cut-5",
        "two sites: the link between them is dead for 5 s",
        partial(_shape, CUT),
        _good,
        layout="sites",
        seconds=5.0,
    )
    yield Fault(
        "site-spare",
        "two sites: the second router beside the robot is killed, started again",
        partial(_kill_router, host="spare"),
        _nothing,
        layout="sites",
        goes_on=True,
    )
    yield Fault(
        "site-model",
        "two sites: the router of the model's site is killed, started again",
        partial(_kill_router, host="gpu"),
        _nothing,
        layout="sites",
        seconds=1.0,
        from_fault=True,
    )
    yield Fault(
        "site-robot",
        "two sites: the router of the robot's site is killed, started again; another stands by",
        _kill_router,
        _nothing,
        layout="sites",
        seconds=1.0,
        from_fault=True,
        alone=True,
    )


def _links() -> Iterator[Fault]:
    for loss in LOSSES:
        yield _bad_link(
            f"loss-{loss * 100:g}",
            f"{loss:.0%} of all frames are lost",
            Shape(loss=loss),
            goes_on=loss <= 0.02,
        )
    for delay, jitter in DELAYS_MS:
        yield _bad_link(
            f"delay-{delay}",
            f"{delay} ms more each way, varying by +-{jitter} ms",
            Shape(delay_s=delay / 1e3, jitter_s=jitter / 1e3),
            goes_on=delay <= 100,
        )
    yield _bad_link(
        "reorder",
        "20 ms more each way, which every fifth frame is spared: it overtakes",
        Shape(delay_s=0.02, reorder=0.2),
    )
    yield _bad_link("slow", "the link carries 1 Mbit/s", Shape(rate_bit_s=1e6), goes_on=False)


def _cuts() -> Iterator[Fault]:
    for seconds in CUTS_S:
        yield Fault(
            f"cut-{seconds:g}",
            f"the link is dead for {seconds:g} s",
            partial(_shape, CUT),
            _good,
            seconds=seconds,
        )
