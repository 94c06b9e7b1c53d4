"""Journeys as spans: one trace for each observation of a worker, one span for each stage."""

from __future__ import annotations

from opentelemetry.context import Context
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor, SpanExporter
from opentelemetry.sdk.trace.id_generator import RandomIdGenerator
from opentelemetry.trace import set_span_in_context

from vla_zenoh import __version__
from vla_zenoh_otel.journeys import Journey

SERVICE = "vla-zenoh"
_NOTHING = Context()


class _TraceIds(RandomIdGenerator):
    """Gives the next trace the id that it is told."""

    next_trace_id = 0

    def generate_trace_id(self) -> int:
        return self.next_trace_id


class Exporter:
    """Sends journeys through an exporter of OpenTelemetry; `close` sends what is left.

    Sampling, limits and batches are those of the library (``OTEL_TRACES_SAMPLER``,
    ``OTEL_BSP_...``), and so are further attributes of the resource
    (``OTEL_RESOURCE_ATTRIBUTES``).
    """

    def __init__(self, exporter: SpanExporter) -> None:
        self._ids = _TraceIds()
        resource = Resource.create({"service.name": SERVICE, "service.version": __version__})
        self._provider = TracerProvider(
            resource=resource, id_generator=self._ids, shutdown_on_exit=False
        )
        self._provider.add_span_processor(BatchSpanProcessor(exporter))
        self._tracer = self._provider.get_tracer("vla_zenoh_otel", __version__)

    def send(self, journey: Journey) -> None:
        """Send one trace."""
        chunk, times_ns = journey.chunk, journey.times_ns
        self._ids.next_trace_id = journey.trace_id
        attributes = {
            "vla.robot": journey.robot,
            "vla.worker": chunk.worker,
            "vla.source": journey.source,
            "vla.spec": chunk.spec_hash,
            "vla.episode": chunk.episode,
            "vla.observation.stamp_ns": chunk.observation_stamp_ns,
            "vla.observation.seq": chunk.observation_seq,
            "vla.chunk.seq": journey.seq,
            "vla.chunk.steps": len(chunk.steps),
            "vla.executed": journey.executed,
            "vla.clocks_disordered": journey.disordered,
        }
        # No parent: whatever context this program runs in is not that of the robot.
        root = self._tracer.start_span(
            "observation", context=_NOTHING, start_time=times_ns[0], attributes=attributes
        )
        inside = set_span_in_context(root, _NOTHING)
        for stage in journey.stages():
            span = self._tracer.start_span(stage.name, context=inside, start_time=stage.start_ns)
            span.end(stage.end_ns)
        root.end(max(times_ns))

    def close(self) -> None:
        """Send what is left."""
        self._provider.shutdown()
