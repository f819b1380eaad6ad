"""Traces of single frames, as a collector receives them from both ends of a real stream."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import grpc
import pytest
from cable_codecs import CodecParameters
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.cli.tracing_options import edge_tracing, server_spans
from cable_rpc.cloud.frame_trace import AnsweredFrame, StreamTracer
from cable_rpc.edge.capture import CapturedFrame
from cable_rpc.edge.frame_encoder import FrameEncoder
from cable_rpc.edge.frame_trace import EdgeTracing, spans_of
from cable_rpc.edge.strategy import FullFrame
from cable_rpc.edge.streamer import StreamedFrame
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.stream_run import StreamRun, StreamRunConfig
from cable_rpc.tracing.context import SpanContext
from cable_rpc.tracing.otlp import ProcessorSink, open_otlp
from cable_rpc.tracing.spans import Span
from cable_rpc.wire.answers import FrameAnswer
from cable_rpc.wire.clock import ClockOffset
from cable_rpc.wire.v1 import perception_pb2 as pb

from .conftest import FailingSegmenter
from .secure_server import serving
from .test_loop import MovingSquare

opentelemetry = pytest.importorskip("opentelemetry.sdk", reason="needs the tracing extra")

EDGE, SERVER = "cable-rpc-edge", "cable-rpc-server"
EDGE_SPANS = {"frame", "capture", "edge_wait", "roi", "fill", "encode", "send", "round trip", "uplink", "downlink"}
SERVER_SPANS = {"perceive", "decode_wait", "decode", "detect_wait", "detect", "segment_wait", "segment", "answer"}
EXAMPLE = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01"
"""Of the standard."""


@dataclass
class ListSink:
    spans: list[Span] = field(default_factory=list)

    def export(self, spans: Any) -> None:
        self.spans.extend(spans)


@contextmanager
def collector() -> Iterator[tuple[str, list[tuple[str, Any]]]]:
    """A collector on a real socket; yields its address and the (service, span) pairs that it has received."""
    from opentelemetry.proto.collector.trace.v1 import trace_service_pb2 as messages
    from opentelemetry.proto.collector.trace.v1 import trace_service_pb2_grpc as services

    received: list[tuple[str, Any]] = []

    class Collector(services.TraceServiceServicer):
        def Export(self, request: Any, context: Any) -> Any:
            for of_resource in request.resource_spans:
                names = [a.value.string_value for a in of_resource.resource.attributes if a.key == "service.name"]
                received.extend((names[0], span) for scope in of_resource.scope_spans for span in scope.spans)
            return messages.ExportTraceServiceResponse()

    server = grpc.server(ThreadPoolExecutor(2))
    services.add_TraceServiceServicer_to_server(Collector(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield f"127.0.0.1:{port}", received
    server.stop(None).wait()


async def stream(target: str, out: Path, frames: int, tracing: EdgeTracing) -> None:
    config = StreamRunConfig(target, out, codec="jpeg", evaluate=False, tracing=tracing)
    await StreamRun(MovingSquare(frames), config, lambda *_: None).run()


async def test_a_trace_holds_both_ends_rightly_nested(tmp_path: Path) -> None:
    with collector() as (address, received):
        with open_otlp(address, EDGE) as edge, open_otlp(address, SERVER) as cloud:
            async with serving(spans=cloud) as server:
                # Seven frames, of which the first and the sixth.
                await stream(f"127.0.0.1:{server.port}", tmp_path, 7, EdgeTracing(5, edge))
        traces = {span.trace_id for _, span in received}
        assert len(traces) == 2
        for trace in traces:
            check_trace([(service, span) for service, span in received if span.trace_id == trace])


def check_trace(trace: list[tuple[str, Any]]) -> None:
    by_id = {span.span_id: span for _, span in trace}
    assert len(by_id) == len(trace)
    assert {span.name for service, span in trace if service == EDGE} == EDGE_SPANS | {"apply"}
    assert {span.name for service, span in trace if service == SERVER} == SERVER_SPANS
    assert [span.name for span in by_id.values() if not span.parent_span_id] == ["frame"]
    for span in by_id.values():
        assert span.start_time_unix_nano <= span.end_time_unix_nano
        if span.parent_span_id:
            # One machine, one wall clock; a parent at the other end was placed by another reading of it.
            slack_ns = 200_000 if span.name == "perceive" else 0
            parent = by_id[span.parent_span_id]
            assert span.start_time_unix_nano >= parent.start_time_unix_nano - slack_ns
            assert span.end_time_unix_nano <= parent.end_time_unix_nano + slack_ns
    spans = {span.name: span for span in by_id.values()}
    parents = {name: by_id[span.parent_span_id].name for name, span in spans.items() if span.parent_span_id in by_id}
    assert parents["perceive"] == parents["uplink"] == parents["downlink"] == "round trip"
    assert {parents[name] for name in SERVER_SPANS - {"perceive"}} == {"perceive"}
    (clock_error_ns,) = (entry.value.int_value for entry in spans["uplink"].attributes)
    in_order = [
        "capture", "edge_wait", "roi", "fill", "encode", "send", "uplink", "decode", "detect", "segment", "downlink",
        "apply",
    ]  # fmt: skip
    for before, after in itertools.pairwise(in_order):
        slack_ns = 200_000 + clock_error_ns if {before, after} & {"uplink", "downlink"} else 0
        assert spans[before].end_time_unix_nano <= spans[after].start_time_unix_nano + slack_ns, (before, after)


async def test_spans_last_as_long_as_the_times_that_were_measured(tmp_path: Path) -> None:
    from cable_rpc.study.run_record import read_frames

    edge, cloud = ListSink(), ListSink()
    async with serving(spans=cloud) as server:
        await stream(f"127.0.0.1:{server.port}", tmp_path, 1, EdgeTracing(1, edge))
    (record,) = read_frames(tmp_path / "frames.csv")
    took = {span.name: span.end_time_ns - span.start_time_ns for span in edge.spans + cloud.spans}
    for name, measured in {
        "roi": record.roi_ns,
        "fill": record.fill_ns,
        "encode": record.encode_ns,
        "uplink": record.uplink_ns,
        "downlink": record.downlink_ns,
        "decode": record.decode_ns,
        "detect": record.detect_ns,
        "segment": record.segment_ns,
        "apply": record.apply_ns,
        "frame": (record.end_to_end_ns or 0) + (record.capture_ns or 0),
    }.items():
        assert took[name] == measured, name
    assert edge.spans[0].attributes["cable.uplink_bytes"] == record.uplink_message_bytes


async def test_a_rejected_frame_is_an_error_at_both_ends(tmp_path: Path) -> None:
    edge, cloud = ListSink(), ListSink()
    async with serving(spans=cloud, segmenter=FailingSegmenter()) as server:
        await stream(f"127.0.0.1:{server.port}", tmp_path, 2, EdgeTracing(1, edge))
    failed = {span.name: span.error for span in edge.spans + cloud.spans if span.error}
    assert set(failed) <= {"frame", "round trip", "perceive"}
    assert failed["frame"].startswith("MODEL_FAILED: ")


@pytest.mark.parametrize("tracing", [EdgeTracing(0, ListSink()), EdgeTracing(0)])
async def test_nobody_asked_nothing_is_traced(tmp_path: Path, tracing: EdgeTracing) -> None:
    cloud = ListSink()
    async with serving(spans=cloud) as server:
        await stream(f"127.0.0.1:{server.port}", tmp_path, 2, tracing)
    assert not cloud.spans
    assert not getattr(tracing.sink, "spans", [])


async def marked_frames(*traceparents: str) -> Any:
    for sequence, traceparent in enumerate(traceparents):
        yield pb.StreamPerceptionRequest(frame=pb.VideoFrame(sequence=sequence, traceparent=traceparent))


async def traced_of(tracer: StreamTracer, sink: ListSink) -> list[Any]:
    async for request in tracer:
        result = pb.Result(sequence=request.frame.sequence, timing=pb.ServerTiming(receive_time_ns=1, send_time_ns=2))
        tracer.written(pb.StreamPerceptionResponse(result=result), "a session", 3)
    return [span.attributes["cable.sequence"] for span in sink.spans if span.name == "perceive"]


async def test_a_client_can_not_have_every_frame_traced() -> None:
    sink = ListSink()
    limited = StreamTracer(marked_frames(*[EXAMPLE] * 500), sink, most_per_s=0.0)
    assert await traced_of(limited, sink) == list(range(20))


def test_waiting_for_a_model_does_not_begin_before_the_frame_was_there() -> None:
    """A session can be in the queue before the frame that it will give, and parts of a stage have no place in time."""
    stages = [
        pb.StageTiming(stage="segment", wait_ns=900, run_ns=50, start_time_ns=1500, batch_size=3),
        pb.StageTiming(stage="segment.clip", run_ns=7, batch_size=3),
    ]
    timing = pb.ServerTiming(receive_time_ns=1000, decode_wait_ns=10, decode_ns=200, stages=stages, send_time_ns=1600)
    spans = AnsweredFrame(4, timing, 1700, "").spans(SpanContext("1" * 32, "2" * 16), "s", 5)
    assert [(span.name, span.start_time_ns - 5, span.end_time_ns - 5) for span in spans] == [
        ("perceive", 1000, 1700),
        ("decode_wait", 1000, 1010),
        ("decode", 1010, 1210),
        ("segment_wait", 1210, 1500),
        ("segment", 1500, 1550),
        ("answer", 1600, 1700),
    ]
    assert spans[4].attributes == {"cable.batch_frames": 3, "cable.segment.clip_ns": 7}


hexadecimal = st.text("0123456789abcdef", min_size=1, max_size=40)


@settings(max_examples=60)
@given(
    st.one_of(
        st.tuples(
            st.sampled_from(["00", "01", "ff", "0", "000", "fe"]),
            st.sampled_from([EXAMPLE[3:35], "0" * 32, EXAMPLE[3:35].upper(), EXAMPLE[3:34]]) | hexadecimal,
            st.sampled_from([EXAMPLE[36:52], "0" * 16]) | hexadecimal,
            st.sampled_from(["00", "01", "03", "fe", "ff", "1", "01-", "01-more", ""]),
        ).map("-".join),
        st.text(max_size=70),
    )
)
def test_trace_context_is_read_as_opentelemetry_reads_it(text: str) -> None:
    from opentelemetry import trace
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    theirs = trace.get_current_span(TraceContextTextMapPropagator().extract({"traceparent": text})).get_span_context()
    ours = SpanContext.from_traceparent(text)
    if ours is None:
        assert not (theirs.is_valid and theirs.trace_flags.sampled)
    else:
        assert theirs.is_valid
        assert (int(ours.trace_id, 16), int(ours.span_id, 16)) == (theirs.trace_id, theirs.span_id)


def test_the_example_of_the_standard() -> None:
    found = SpanContext.from_traceparent(EXAMPLE)
    assert found == SpanContext("4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7")
    assert found.to_traceparent() == EXAMPLE


def test_spans_arrive_in_the_sdk_as_they_are() -> None:
    from opentelemetry.sdk.trace.export import SimpleSpanProcessor
    from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

    exporter = InMemorySpanExporter()
    context = SpanContext("ab" * 16, "cd" * 8)
    ProcessorSink(SimpleSpanProcessor(exporter), "a service").export(
        [Span("one", context, "ef" * 8, 5, 8, {"cable.sequence": 3}, error="late")]
    )
    (span,) = exporter.get_finished_spans()
    assert (span.name, span.start_time, span.end_time) == ("one", 5, 8)
    assert span.context is not None
    assert span.parent is not None
    assert (span.context.trace_id, span.context.span_id) == (int("ab" * 16, 16), int("cd" * 8, 16))
    assert span.parent.span_id == int("ef" * 8, 16)
    assert dict(span.attributes or {}) == {"cable.sequence": 3}
    assert span.status.description == "late"
    assert span.resource.attributes["service.name"] == "a service"


def test_a_lost_frame_has_no_way_through_the_network(tmp_path: Path) -> None:
    lost = streamed_frame(FrameAnswer.lost(3, "the server vanished"))
    spans = {span.name: span for span in spans_of(lost, ClockOffset(7, 1), wall_offset_ns=0)}
    assert not {"uplink", "downlink"} & set(spans)
    assert spans["frame"].error == spans["round trip"].error == "LOST: the server vanished"


def streamed_frame(answer: FrameAnswer) -> StreamedFrame:
    (frame,) = MovingSquare(1)
    encoder = FrameEncoder(FullFrame(), CodecParameters("jpeg", 160, 96, 10.0), trace_every=1)
    prepared = encoder.prepare(CapturedFrame(frame, 5, time.monotonic_ns()), force_keyframe=False)
    encoder.close()
    return StreamedFrame(prepared, answer, 1, time.monotonic_ns())


def test_one_of_so_many_frames_is_marked() -> None:
    encoder = FrameEncoder(FullFrame(), CodecParameters("jpeg", 160, 96, 10.0), trace_every=3)
    marks = [
        encoder.prepare(CapturedFrame(frame, 0, 0), force_keyframe=False).message.traceparent
        for frame in MovingSquare(7)
    ]
    encoder.close()
    assert [bool(mark) for mark in marks] == [True, False, False, True, False, False, True]
    assert len(set(marks)) == 4, "each frame has a trace of its own"


def test_a_vehicle_can_mark_frames_without_a_collector() -> None:
    with edge_tracing("", None) as nothing, edge_tracing("", 5) as marked, edge_tracing("127.0.0.1:1", None) as usual:
        assert nothing == EdgeTracing(0)
        assert marked == EdgeTracing(5)
        assert (usual.every, usual.sink is None) == (30, False)
    with server_spans("") as sink:
        assert sink is None


@pytest.fixture
def without_opentelemetry(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    def bar() -> None:
        for name in [name for name in sys.modules if name.split(".")[0] == "opentelemetry"]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, "opentelemetry", None)

    return bar


def test_what_is_missing_or_wrong_is_said(without_opentelemetry: Callable[[], None]) -> None:
    with pytest.raises(ConfigurationError, match="is not HOST:PORT"), open_otlp("nowhere", EDGE):
        pass
    without_opentelemetry()
    with pytest.raises(ConfigurationError, match=r"cable-rpc\[tracing\]"), open_otlp("127.0.0.1:4317", EDGE):
        pass
