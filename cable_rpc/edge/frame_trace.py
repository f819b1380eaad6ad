"""One trace for each of some frames: which, and the edge's spans of it."""

from __future__ import annotations

from dataclasses import dataclass

from cable_rpc.edge.streamer import StreamedFrame
from cable_rpc.tracing.context import SpanContext, new_span_id
from cable_rpc.tracing.spans import Span, SpanFamily, SpanKind, SpanSink, wall_offset_ns
from cable_rpc.wire.clock import ClockOffset


@dataclass(frozen=True, slots=True)
class EdgeTracing:
    """What is traced and where spans go."""

    every: int
    """One of so many frames is traced at both ends; 0 = none."""
    sink: SpanSink | None = None
    """None = frames are marked, and only the server tells of them."""

    def frame_done(self, streamed: StreamedFrame, clock_offset: ClockOffset | None) -> None:
        """Tells the spans of a frame that went the whole way, if it was marked."""
        if self.sink is not None and streamed.prepared.message.traceparent:
            self.sink.export(spans_of(streamed, clock_offset, wall_offset_ns()))


NOT_TRACED = EdgeTracing(0)


def spans_of(streamed: StreamedFrame, clock_offset: ClockOffset | None, wall_offset_ns: int) -> list[Span]:
    """The edge's spans of a marked frame, the root first.

    The server's spans hang below "round trip". Its part of the times is placed by the clock offset that was measured,
    and left out where none was.

    Args:
        streamed: the frame; its message has a valid traceparent.
        clock_offset: server's monotonic clock against ours.
        wall_offset_ns: wall clock minus monotonic clock, here.
    """
    prepared, answer = streamed.prepared, streamed.answer
    round_trip = SpanContext.from_traceparent(prepared.message.traceparent)
    if round_trip is None:
        return []
    root = SpanContext(round_trip.trace_id, new_span_id())
    family = SpanFamily(root, wall_offset_ns)
    available_ns, sent_ns = prepared.captured.available_time_ns, prepared.message.send_time_ns
    captured_from_ns = available_ns - prepared.captured.capture_ns
    roi_end_ns = prepared.started_time_ns + prepared.roi_ns
    encoded_ns = prepared.encoded_time_ns
    error = answer.rejection or ""
    whole = Span(
        "frame",
        root,
        "",
        captured_from_ns + wall_offset_ns,
        streamed.applied_time_ns + wall_offset_ns,
        {
            "cable.sequence": prepared.index,
            "cable.uplink_bytes": prepared.uplink_message_bytes,
            "cable.downlink_bytes": answer.message_bytes,
            "cable.whole_frame": prepared.proposal.keyframe,
            "cable.codec_keyframe": prepared.encoded.keyframe,
            "cable.coverage": prepared.sent_region.coverage,
        },
        error=error,
    )
    way = Span(
        "round trip",
        round_trip,
        root.span_id,
        sent_ns + wall_offset_ns,
        answer.receive_time_ns + wall_offset_ns,
        kind=SpanKind.CLIENT,
        error=error,
    )
    return [
        whole,
        family.child("capture", captured_from_ns, available_ns),
        family.child("edge_wait", available_ns, prepared.started_time_ns),
        family.child("roi", prepared.started_time_ns, roi_end_ns),
        family.child("fill", roi_end_ns, roi_end_ns + prepared.fill_ns),
        family.child("encode", encoded_ns - prepared.encoded.duration_ns, encoded_ns),
        family.child("send", encoded_ns, sent_ns),
        way,
        *_both_ways(streamed, clock_offset, SpanFamily(round_trip, wall_offset_ns)),
        family.child("apply", streamed.applied_time_ns - streamed.apply_ns, streamed.applied_time_ns),
    ]


def _both_ways(streamed: StreamedFrame, clock_offset: ClockOffset | None, family: SpanFamily) -> list[Span]:
    times, received_ns = streamed.answer.times, streamed.answer.receive_time_ns
    if clock_offset is None or not times.receive_time_ns:
        return []
    known_to = {"cable.clock_error_ns": clock_offset.error_ns}
    there_ns, back_ns = clock_offset.to_client(times.receive_time_ns), clock_offset.to_client(times.send_time_ns)
    # The offset has an error, which must not put a span outside its parent.
    sent_ns = streamed.prepared.message.send_time_ns
    there_ns, back_ns = (min(max(moment_ns, sent_ns), received_ns) for moment_ns in (there_ns, back_ns))
    return [
        family.child("uplink", sent_ns, there_ns, known_to),
        family.child("downlink", back_ns, received_ns, known_to),
    ]
