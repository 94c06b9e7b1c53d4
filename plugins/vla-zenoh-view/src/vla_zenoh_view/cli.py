"""vla-zenoh view: a robot and its model in Rerun."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vla_zenoh.cli.options import bind_address, options
from vla_zenoh.cli.output import errors, fail
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import OutputError, ProfileError, counted
from vla_zenoh.lab.cli.loopback import require_loopback
from vla_zenoh.lab.cli.options import EndAfterOption
from vla_zenoh.lab.cli.output import progress
from vla_zenoh.lab.cli.output_path import ForceOption, if_wanted, output_file
from vla_zenoh.profile import Profile, read_profile
from vla_zenoh.runtime.process import run_node, stop_on_signals
from vla_zenoh_view.viewer import Viewer, open_server, open_window

if TYPE_CHECKING:
    from vla_zenoh_view.rerun_logger import RerunLogger

POLL_S = 0.03
FLUSH_S = 5.0
PAGE_PORT = 9090
SHOWN_REASONS = 5


@dataclass(frozen=True)
class ViewOutput:
    """Options for where the view goes: a window, browsers, or a file."""

    serve: Annotated[
        bool, typer.Option("--serve", help="Serve the view for browsers; needs no screen.")
    ] = False
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Write it to this file (.rrd) for Rerun; needs no screen."
        ),
    ] = None
    force: ForceOption = False
    bind: Annotated[
        str,
        typer.Option(
            "--bind",
            parser=bind_address,
            help="With --serve: address to listen at; a network's only with an insecure profile.",
        ),
    ] = "127.0.0.1"
    port: Annotated[
        int,
        typer.Option(
            "--port",
            help="With --serve: of the page; the data is at the next port.",
            min=1,
            max=65534,
        ),
    ] = PAGE_PORT

    def check(self, profile: Profile) -> None:
        """Reject serving the view to a network: Rerun has neither password nor encryption.

        Raises:
            SecurityError: see `require_loopback`.
        """
        if not self.serve:
            return
        tunnel = " ".join(f"-L {each}:127.0.0.1:{each}" for each in (self.port, self.port + 1))
        require_loopback(
            profile,
            "--bind",
            self.bind,
            "look through the cameras and send data to this view, as Rerun has neither password "
            "nor encryption",
            f"leave it out, and type on the other computer `ssh {tunnel} THIS_COMPUTER`: the page "
            "is there as it is here; or take -o FILE.rrd there",
        )

    @contextmanager
    def open(self, name: str, file: Path | None) -> Iterator[tuple[Any, Viewer | None]]:
        """Open a stream of Rerun called `name`, and the viewer unless it goes only to `file`."""
        import rerun as rr

        from vla_zenoh_view.rerun_logger import APPLICATION

        sinks: list[Any] = []
        if file is not None:
            sinks.append(rr.FileSink(str(file)))
        viewer = None
        if self.serve:
            viewer = open_server(self.bind, self.port)
            errors().print(f"open in a browser: {viewer.page_url}", soft_wrap=True)
        elif file is None:
            viewer = open_window()
        try:
            if viewer is not None:
                sinks.append(rr.GrpcSink(viewer.data_url))
            stream = rr.RecordingStream(APPLICATION)
            stream.set_sinks(*sinks)
            stream.send_recording_name(name)
            yield stream, viewer
            if viewer is None or not viewer.closed:
                try:
                    stream.flush(timeout_sec=FLUSH_S)
                except RuntimeError as error:  # a full disk, which Rerun has printed
                    raise OutputError(f"the view is incomplete: {error}") from error
            stream.disconnect()
        finally:
            if viewer is not None:
                viewer.close()


@options
def view(
    target: RobotTarget,
    output: ViewOutput,
    file: Annotated[
        Path | None,
        typer.Argument(help="A file of `vla-zenoh record`; default: the running robot."),
    ] = None,
    seconds: EndAfterOption = None,
) -> None:
    """View a robot and its model in Rerun, live or from a recording.

    Shows images, inputs and outputs of the model, the robot, poses with trails, chunks, latencies,
    limits, events. Ctrl-C or closing the window ends it.
    """
    inputs = [] if file is None else [file]
    with if_wanted(output_file, output.output, force=output.force, inputs=inputs) as part:
        if file is None:
            _live(target.load(), output, part, seconds)
        else:
            _recorded(file, target.profile, output, part)
    if output.output is not None:
        errors().print(f"written: {output.output}", soft_wrap=True)


def _live(profile: Profile, output: ViewOutput, part: Path | None, seconds: float | None) -> None:
    from vla_zenoh_view.listener import ViewListener
    from vla_zenoh_view.rerun_logger import RerunLogger

    done: list[RerunLogger] = []
    output.check(profile)

    def run(session: Any, stop: threading.Event) -> None:
        with output.open(profile.robot.name, part) as (stream, viewer):
            logger = RerunLogger(profile, stream, live=True)
            listener = ViewListener(session, profile)
            errors().print(f"viewing robot {profile.robot.name}; Ctrl-C ends it")
            end_s = None if seconds is None else time.monotonic() + seconds
            short: dict[str, str] = {}
            while not stop.is_set() and not (viewer is not None and viewer.closed):
                if end_s is not None and time.monotonic() >= end_s:
                    break
                for sample in listener.take():
                    logger.log(sample)
                logger.dropped = listener.dropped.total()
                before, short = short, listener.reception.short()
                for why in [why for name, why in short.items() if name not in before]:
                    warn(why)
                stop.wait(POLL_S)
            listener.close()
            done.append(logger)

    run_node(profile, run, identity=None)
    if not done:  # interrupted before it began
        raise typer.Exit(130)
    _summarise(done[0])
    if not done[0].shown:
        fail("nothing was published; is a robot up? (`vla-zenoh up`)")


def _recorded(path: Path, profile_name: str, output: ViewOutput, part: Path | None) -> None:
    from vla_zenoh.lab.recording.reader import open_recording
    from vla_zenoh_view.rerun_logger import RerunLogger

    stop = stop_on_signals()
    file = open_recording(path)
    try:
        profile = read_profile(file.profile_yaml, f"profile in {file.path}")
    except ProfileError as error:
        warn(f"{error}; showing the robot of --profile {profile_name}")
        profile = RobotTarget(profile_name).load()
    output.check(profile)
    with output.open(path.stem, part) as (stream, viewer):
        logger = RerunLogger(profile, stream, keys=file.keys)
        with progress(f"reading {path.name}"):
            for sample in file.entries(lambda key: not key.endswith("/raw")):
                if stop.is_set() or (viewer is not None and viewer.closed):
                    break
                logger.log(sample)
        _summarise(logger)
        if file.damage:
            warn(f"{path} is {file.damage}")
        while viewer is not None and not stop.is_set() and not viewer.closed:
            stop.wait(POLL_S)
    if not logger.shown and not stop.is_set():
        fail(f"{path} holds nothing that can be shown")


def _summarise(logger: RerunLogger) -> None:
    logger.close()
    errors().print(f"{logger.shown.total():,} samples of {counted(len(logger.shown), 'key')}")
    if logger.rejected:
        worst = logger.rejected.most_common(SHOWN_REASONS)
        reasons = ", ".join(f"{why} ({count})" for why, count in worst)
        warn(f"not shown: {reasons}")
    if logger.dropped:
        warn(f"dropped, because this was too slow: {logger.dropped} samples")
