"""vla-zenoh otel: traces of a robot for OpenTelemetry."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlsplit

import typer

from vla_zenoh.cli.options import MAX_SECONDS, options
from vla_zenoh.cli.output import console
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.target import RobotTarget

if TYPE_CHECKING:
    from vla_zenoh_otel.journeys import Journey


def http_url(text: str) -> str:
    """Parse the URL of a receiver, or raise a `ValueError`."""
    try:
        parts = urlsplit(text)
        known = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0
    except ValueError:
        known = False
    if not known or re.search(r"\s", text):
        raise ValueError(f"{text!r} is no URL such as http://localhost:4318/v1/traces")
    return text


@options
def otel(
    target: RobotTarget,
    endpoint: Annotated[
        str | None,
        typer.Option(
            "--endpoint",
            parser=http_url,
            metavar="URL",
            help="Where an OTLP receiver takes traces. Default: as OTEL_EXPORTER_OTLP_ENDPOINT and "
            "its like say, else http://localhost:4318/v1/traces.",
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", "-s", min=0.1, max=MAX_SECONDS, help="Default: until Ctrl-C."),
    ] = None,
) -> None:
    """Send a trace of every observation, from its image to the first command, over OTLP (HTTP).

    It reads chunks and commands, which carry all times, and publishes nothing.
    """
    import threading

    from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter

    from vla_zenoh.runtime.process import stop_on_signals
    from vla_zenoh_otel.export import Exporter
    from vla_zenoh_otel.follow import follow

    exporter, stop = Exporter(OTLPSpanExporter(endpoint=endpoint)), stop_on_signals()
    sent = 0

    def send(journey: Journey) -> None:
        nonlocal sent
        exporter.send(journey)
        sent += 1

    with target.client() as client:
        if seconds is not None:
            alarm = threading.Timer(seconds, stop.set)
            alarm.daemon = True
            alarm.start()
        lost = follow(client.profile, client.session, send, stop)
    exporter.close()
    console().print(f"{sent} traces of robot {client.keys.robot}")
    if lost:
        warn(f"{lost} chunks were given up: too many waited for a command")
