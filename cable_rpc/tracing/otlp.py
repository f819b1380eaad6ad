"""Spans on their way to an OpenTelemetry collector. Needs the tracing extra, which is looked for on opening only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import cable_rpc
from cable_rpc.errors import ConfigurationError
from cable_rpc.tracing.spans import Span, SpanSink
from cable_rpc.wire.address import Target

EXPORT_TIMEOUT_S = 5.0
"""For one batch, tries included; also how long the end of the process can wait for an absent collector."""


@contextmanager
def open_otlp(address: str, service: str) -> Iterator[SpanSink]:
    """A sink that sends spans by OTLP over gRPC from a thread of its own; what is left is sent at the end.

    The exporter's other settings come from the usual variables, e.g. OTEL_EXPORTER_OTLP_HEADERS.

    Args:
        address: ``HOST:PORT`` of a collector, ``grpcs://HOST:PORT`` with TLS.
        service: what the traces call this end (``service.name``).

    Raises:
        ConfigurationError: the address is none, or the extra is missing.
    """
    target = Target.parse(address)
    try:
        from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ModuleNotFoundError as error:
        raise ConfigurationError("traces need the tracing extra: pip install 'cable-rpc[tracing]'") from error
    exporter = OTLPSpanExporter(target.address, insecure=not target.tls, timeout=EXPORT_TIMEOUT_S)
    processor: Any = BatchSpanProcessor(exporter)
    try:
        yield ProcessorSink(processor, service)
    finally:
        processor.shutdown()


class ProcessorSink:
    """Hands spans to a span processor of the OpenTelemetry SDK.

    The SDK's own spans would have to be begun when their time begins; ours are known when it is over.

    Args:
        processor: an `opentelemetry.sdk.trace.SpanProcessor`.
        service: what the traces call this end.
    """

    def __init__(self, processor: Any, service: str) -> None:
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.util.instrumentation import InstrumentationScope

        self._processor = processor
        self._resource = Resource.create({"service.name": service, "service.version": cable_rpc.__version__})
        self._scope = InstrumentationScope("cable_rpc", cable_rpc.__version__)

    def export(self, spans: Sequence[Span]) -> None:
        """See `SpanSink`."""
        for span in spans:
            self._processor.on_end(self._readable(span))

    def _readable(self, span: Span) -> Any:
        from opentelemetry.sdk.trace import ReadableSpan
        from opentelemetry.trace import SpanContext, SpanKind, Status, StatusCode, TraceFlags

        def context(span_id: str, *, is_remote: bool) -> SpanContext:
            flags = TraceFlags(TraceFlags.SAMPLED)
            return SpanContext(int(span.context.trace_id, 16), int(span_id, 16), is_remote, flags)

        kind = SpanKind[span.kind.name]
        return ReadableSpan(
            span.name,
            context(span.context.span_id, is_remote=False),
            context(span.parent_id, is_remote=kind is SpanKind.SERVER) if span.parent_id else None,
            self._resource,
            dict(span.attributes),
            kind=kind,
            status=Status(StatusCode.ERROR, span.error) if span.error else Status(),
            start_time=span.start_time_ns,
            end_time=span.end_time_ns,
            instrumentation_scope=self._scope,
        )
