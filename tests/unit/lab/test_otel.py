"""Traces of OpenTelemetry: an observation, its stages, and whether a command followed it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import pytest
from camera_rig import await_match, free_endpoint, until
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from vla_zenoh_otel.cli import http_url
from vla_zenoh_otel.export import Exporter
from vla_zenoh_otel.follow import follow
from vla_zenoh_otel.journeys import PATIENCE_NS, STAGES, Journey, Journeys, trace_id

from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import records
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.types import ActionChunk, Cause, Header, PoseCommand, Stamped

MS = 1_000_000
IMAGE_NS = 10**18
TIMES_NS = tuple(IMAGE_NS + ms * MS for ms in (0, 4, 5, 45, 46, 48, 51))
"""Image, observation, inference from and to, published, received, first command."""
DOWN = np.array([1.0, 0.0, 0.0, 0.0])


def chunk(seq: int = 7, worker: str = "brick", received_ns: int = 0) -> Stamped[ActionChunk]:
    image_ns, observed_ns, start_ns, end_ns, published_ns, *_ = TIMES_NS
    record = ActionChunk(
        *(worker, "abcd", 3, image_ns, 11, image_ns + 10**9, np.zeros((2, 7), np.float32)),
        *(observed_ns, start_ns, end_ns),
    )
    return Stamped(Header(published_ns, seq, f"worker-{worker}#1"), record, received_ns)


def cause(seq: int = 7, worker: str = "brick", times_ns: Sequence[int] = TIMES_NS) -> Cause:
    return Cause(worker, seq, *times_ns[:6])


def ended(journeys: Journeys) -> Journey:
    assert journeys.take_chunk(chunk()) is None
    journey = journeys.take_command(cause(), TIMES_NS[6])
    assert journey is not None
    return journey


def test_a_journey_has_the_time_of_every_stage_up_to_the_first_command() -> None:
    journey = ended(Journeys("panda"))
    lengths_ms = {stage.name: (stage.end_ns - stage.start_ns) / MS for stage in journey.stages()}
    assert lengths_ms == dict(zip(STAGES, (4, 1, 40, 1, 2, 3), strict=True))
    assert journey.executed


def test_only_the_first_command_of_a_chunk_ends_a_journey() -> None:
    journeys = Journeys("panda")
    ended(journeys)
    assert journeys.take_command(cause(), TIMES_NS[6] + 4 * MS) is None
    assert journeys.take_command(None, TIMES_NS[6] + 8 * MS) is None


def test_a_command_that_overtakes_its_chunk_ends_the_same_journey() -> None:
    journeys = Journeys("panda")
    assert journeys.take_command(cause(), TIMES_NS[6]) is None
    assert journeys.take_command(cause(), TIMES_NS[6] + 4 * MS) is None
    journey = journeys.take_chunk(chunk())
    assert journey is not None
    assert list(journey.stages()) == list(ended(Journeys("panda")).stages())


def test_a_shadows_chunk_ends_without_a_command_after_a_while() -> None:
    journeys = Journeys("panda")
    journeys.take_chunk(chunk(worker="shadow"))
    assert list(journeys.overdue(PATIENCE_NS - 1)) == []
    (journey,) = journeys.overdue(PATIENCE_NS)
    assert not journey.executed
    assert [stage.name for stage in journey.stages()] == list(STAGES[:4])


def test_a_stage_that_ends_before_it_begins_is_left_out_and_said() -> None:
    journeys = Journeys("panda")
    journeys.take_chunk(chunk())
    early = (*TIMES_NS[:5], TIMES_NS[4] - MS)
    journey = journeys.take_command(cause(times_ns=early), TIMES_NS[6])
    assert journey is not None
    assert journey.disordered
    assert "receive" not in {stage.name for stage in journey.stages()}


# -- spans ----------------------------------------------------------------------------------------
def test_a_trace_is_found_by_robot_worker_and_observation() -> None:
    memory = InMemorySpanExporter()
    exporter = Exporter(memory)
    exporter.send(ended(Journeys("panda")))
    exporter.close()
    spans = {span.name: span for span in memory.get_finished_spans()}
    root = spans.pop("observation")
    assert root.parent is None
    assert (root.start_time, root.end_time) == (TIMES_NS[0], TIMES_NS[6])
    assert root.attributes is not None
    assert root.attributes["vla.observation.stamp_ns"] == IMAGE_NS
    assert root.attributes["vla.observation.seq"] == 11
    assert root.attributes["vla.executed"] is True
    assert root.resource.attributes["service.name"] == "vla-zenoh"
    assert set(spans) == set(STAGES)
    wanted = trace_id("panda", "brick", IMAGE_NS)
    for span in (root, *spans.values()):
        assert span.context.trace_id == wanted
    for span in spans.values():
        assert span.parent is not None
        assert span.parent.span_id == root.context.span_id
    assert (spans["infer"].start_time, spans["infer"].end_time) == TIMES_NS[2:4]


@pytest.fixture
def profile() -> Profile:
    endpoint = free_endpoint()
    session = {"listen": [endpoint], "connect": [endpoint]}
    return override(load_profile("panda_sim"), {"session": session})


def test_what_is_on_the_bus_becomes_traces(profile: Profile) -> None:
    memory = InMemorySpanExporter()
    exporter, stop = Exporter(memory), threading.Event()
    keys = profile.keys
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as ours,
        open_session(profile.session) as nodes,
    ):
        thread = threading.Thread(target=follow, args=(profile, ours, exporter.send, stop))
        thread.start()
        try:
            await_match(nodes, keys.delta("brick"))
            await_match(nodes, keys.command_pose)
            sent = chunk()
            put = (records.encode(sent.record), records.encode_header(sent.header))
            nodes.put(keys.delta("brick"), put[0], attachment=put[1])
            goal = (np.array([0.4, 0.0, 0.3]), DOWN)
            for tick in range(5):
                command = PoseCommand(*goal, np.zeros(6), np.zeros(6), *goal, "active", cause())
                header = Header(TIMES_NS[6] + 4 * tick * MS, tick, "command#1")
                nodes.put(
                    keys.command_pose,
                    records.encode(command),
                    attachment=records.encode_header(header),
                )
            nodes.put(keys.delta("brick"), b"no chunk")
            time.sleep(0.3)
        finally:
            stop.set()
            thread.join(10.0)
    exporter.close()
    roots = [span for span in memory.get_finished_spans() if span.parent is None]
    assert [(root.start_time, root.end_time) for root in roots] == [(TIMES_NS[0], TIMES_NS[6])]


class Receiver(HTTPServer):
    """Takes traces over OTLP, as a collector does: protobuf of the specification, by HTTP."""

    def __init__(self) -> None:
        self.requests: list[ExportTraceServiceRequest] = []
        requests = self.requests

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                requests.append(ExportTraceServiceRequest.FromString(body))
                self.send_response(200 if self.path == "/v1/traces" else 404)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        super().__init__(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server_port}/v1/traces"


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with Receiver() as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def test_traces_arrive_over_otlp_as_they_were_sent(receiver: Receiver) -> None:
    exporter = Exporter(OTLPSpanExporter(endpoint=receiver.url))
    exporter.send(ended(Journeys("panda")))
    exporter.close()
    until("a request", lambda: receiver.requests)
    spans = [
        span
        for request in receiver.requests
        for resource in request.resource_spans
        for scope in resource.scope_spans
        for span in scope.spans
    ]
    assert {span.name for span in spans} == {"observation", *STAGES}
    wanted = trace_id("panda", "brick", IMAGE_NS).to_bytes(16, "big")
    assert {span.trace_id for span in spans} == {wanted}
    command = next(span for span in spans if span.name == "command")
    assert (command.start_time_unix_nano, command.end_time_unix_nano) == TIMES_NS[5:7]


@pytest.mark.parametrize(
    "text", ["localhost:4318", "ftp://a/", "http://", "http://a b/", "http://a:99999/"]
)
def test_what_is_no_url_of_a_receiver_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match="is no URL such as http"):
        http_url(text)
    assert http_url("https://traces.lab:4318/v1/traces")
