"""vla-zenoh view."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vla_zenoh.cli.bind_check import refuse_beyond_here
from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    HostOption,
    ProfileOption,
)
from vla_zenoh.cli.output import errors, fail
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import MissingExtraError, ProfileError, RecordingError
from vla_zenoh.lab.view.viewer import Viewer, open_server, open_window
from vla_zenoh.profile import Profile, read_profile
from vla_zenoh.runtime.process import run_node, stop_on_signals

if TYPE_CHECKING:
    from vla_zenoh.lab.recording.reader import Recording
    from vla_zenoh.lab.view.rerun_logger import RerunLogger

POLL_S = 0.03
FLUSH_S = 5.0
PAGE_PORT = 9090
SHOWN_REASONS = 5


def view(
    file: Annotated[
        Path | None,
        typer.Argument(help="A file of `vla-zenoh record`; without it, the robot that lives."),
    ] = None,
    serve: Annotated[
        bool, typer.Option("--serve", help="Serve the view for browsers; no screen needed.")
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option("--save", help="Write it to this file (.rrd), for Rerun; no screen needed."),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", "-s", help="Listen for so long.", min=0.1)
    ] = None,
    bind: Annotated[
        str,
        typer.Option(
            "--bind",
            help="With --serve: where to listen; elsewhere than here in an insecure profile alone.",
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int,
        typer.Option(
            "--port", help="With --serve: of the page; data at the next port.", min=1, max=65534
        ),
    ] = PAGE_PORT,
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
) -> None:
    """Look at a robot and its model in Rerun, live or from a recording.

    Pictures, what the model sees and answers, the robot, poses with trails, chunks, latencies,
    bounds, events. Ctrl-C or closing the window ends it.
    """
    try:
        import rerun  # noqa: F401  # before anything is opened
    except ImportError as error:
        raise MissingExtraError("rerun", "view") from error
    if file is None:
        _live(RobotTarget(profile, connect, host).load(), serve, save, seconds, bind, port)
    else:
        _recorded(file, profile, serve, save, bind, port)


def _live(
    profile: Profile, serve: bool, save: Path | None, seconds: float | None, bind: str, port: int
) -> None:
    from vla_zenoh.lab.view.listener import ViewListener
    from vla_zenoh.lab.view.rerun_logger import RerunLogger

    done: list[RerunLogger] = []
    if serve:
        _refuse_strangers(profile, bind, port)

    def run(session: Any, stop: threading.Event) -> None:
        with _sink(profile.robot.name, serve, save, bind, port) as (stream, viewer):
            show = RerunLogger(profile, stream, live=True)
            listener = ViewListener(session, profile)
            errors().print(f"looking at robot {profile.robot.name}; Ctrl-C ends it")
            end_s = None if seconds is None else time.monotonic() + seconds
            while not stop.is_set() and not (viewer is not None and viewer.closed):
                if end_s is not None and time.monotonic() >= end_s:
                    break
                for sample in listener.take():
                    show.log(sample)
                show.dropped = listener.dropped.total()
                stop.wait(POLL_S)
            listener.close()
            done.append(show)

    run_node(profile, run, identity=None)
    if not done:  # interrupted before it began
        raise typer.Exit(130)
    _tell(done[0], save)
    if not done[0].shown:
        fail("nothing was said; is a robot up? (`vla-zenoh up`)")


def _recorded(
    path: Path, profile_name: str, serve: bool, save: Path | None, bind: str, port: int
) -> None:
    from vla_zenoh.lab.recording.reader import open_recording
    from vla_zenoh.lab.view.rerun_logger import RerunLogger

    stop = stop_on_signals()
    file = open_recording(path)
    profile = _profile_of(file, profile_name)
    if serve:
        _refuse_strangers(profile, bind, port)
    with _sink(path.stem, serve, save, bind, port) as (stream, viewer):
        show = RerunLogger(profile, stream, keys=file.keys)
        for sample in file.entries(lambda key: not key.endswith("/raw")):
            if stop.is_set() or (viewer is not None and viewer.closed):
                break
            show.log(sample)
        _tell(show, save)
        if file.damage:
            errors().print(f"{path} is {file.damage}", style="yellow")
        while viewer is not None and not stop.is_set() and not viewer.closed:
            stop.wait(POLL_S)
    if not show.shown and not stop.is_set():
        fail(f"{path} holds nothing that can be shown")


def _refuse_strangers(profile: Profile, bind: str, port: int) -> None:
    ways = " ".join(f"-L {each}:127.0.0.1:{each}" for each in (port, port + 1))
    refuse_beyond_here(
        profile,
        "--bind",
        bind,
        "look through the cameras and send this view what it likes, as Rerun has neither password "
        "nor encryption",
        f"leave it out, and type on the other computer `ssh {ways} THIS_COMPUTER`: the page is "
        "there as it is here; or take --save FILE.rrd there",
    )


def _profile_of(file: Recording, name: str) -> Profile:
    try:
        return read_profile(file.profile_yaml, f"profile in {file.path}")
    except ProfileError as error:
        why = f"{error}; --profile {name} says what the robot looks like"
        errors().print(why, style="yellow")
        return RobotTarget(name).load()


@contextmanager
def _sink(
    name: str, serve: bool, save: Path | None, bind: str, port: int
) -> Iterator[tuple[Any, Viewer | None]]:
    """A Rerun stream to a window, to browsers, into a file, and the viewer where there is one."""
    import rerun as rr

    from vla_zenoh.lab.view.rerun_logger import APPLICATION

    sinks: list[Any] = []
    if save is not None:
        try:
            save.parent.mkdir(parents=True, exist_ok=True)
            save.open("wb").close()
        except OSError as error:
            raise RecordingError(f"{save} cannot be written: {error.strerror}") from error
        sinks.append(rr.FileSink(str(save)))
    viewer = None
    if serve:
        viewer = open_server(bind, port)
        errors().print(f"open in a browser: {viewer.page_url}", soft_wrap=True)
    elif save is None:
        viewer = open_window()
    try:
        if viewer is not None:
            sinks.append(rr.GrpcSink(viewer.data_url))
        stream = rr.RecordingStream(APPLICATION)
        stream.set_sinks(*sinks)
        stream.send_recording_name(name)
        yield stream, viewer
        if viewer is None or not viewer.closed:
            stream.flush(timeout_sec=FLUSH_S)
        stream.disconnect()
    finally:
        if viewer is not None:
            viewer.close()


def _tell(show: RerunLogger, save: Path | None) -> None:
    screen = errors()
    where = f" in {save}" if save is not None else ""
    screen.print(
        f"{show.shown.total():,} samples of {len(show.shown)} keys{where}",
        soft_wrap=True,
    )
    if show.refused:
        worst = show.refused.most_common(SHOWN_REASONS)
        reasons = ", ".join(f"{why} ({count})" for why, count in worst)
        screen.print(f"not shown: {reasons}", style="yellow")
    if show.dropped:
        said = f"left out, because this was too slow: {show.dropped} samples"
        screen.print(said, style="yellow")
