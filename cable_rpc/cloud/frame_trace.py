"""The server's spans of frames whose clients trace them, made from the times that an answer carries."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from dataclasses import dataclass

from cable_rpc.cloud.answer_queue import Response
from cable_rpc.tracing.context import SpanContext
from cable_rpc.tracing.spans import Span, SpanFamily, SpanKind, SpanSink, wall_offset_ns
from cable_rpc.wire.v1 import perception_pb2 as pb

MOST_PER_S = 10.0
"""Traces of one stream: the client chooses which frames are traced, not how much work that may make."""
RESERVE = 20.0
"""Traces that may follow each other faster."""


class StreamTracer:
    """Looks at one stream from outside of its session; iterate over it in place of the requests.

    Args:
        requests: of the client.
        sink: where spans go.
        most_per_s: traces, in the long run.
    """

    def __init__(
        self,
        requests: AsyncIterator[pb.StreamPerceptionRequest],
        sink: SpanSink,
        most_per_s: float = MOST_PER_S,
    ) -> None:
        self._requests = requests
        self._sink = sink
        self._most_per_s = most_per_s
        self._level, self._looked_s = RESERVE, time.monotonic()
        self._marked: dict[int, SpanContext] = {}

    def __aiter__(self) -> StreamTracer:
        return self

    async def __anext__(self) -> pb.StreamPerceptionRequest:
        """The next request; not a generator, since a wait for it can be given up and begun again."""
        request = await anext(self._requests)
        if request.frame.traceparent:
            self._mark(request.frame)
        return request

    def _mark(self, frame: pb.VideoFrame) -> None:
        context, now_s = SpanContext.from_traceparent(frame.traceparent), time.monotonic()
        self._level = min(RESERVE, self._level + (now_s - self._looked_s) * self._most_per_s)
        self._looked_s = now_s
        if context is not None and self._level >= 1:
            self._level -= 1
            self._marked[frame.sequence] = context

    def written(self, response: Response, session_id: str, handed_over_ns: int) -> None:
        """Tells the spans of a frame that has been answered.

        Args:
            response: any of the session's messages.
            session_id: of the session.
            handed_over_ns: when writing it began, monotonic clock. The client can have it before writing is over.
        """
        if not self._marked:
            return
        kind, error = response.WhichOneof("payload"), ""
        if kind == "result":
            answer: pb.Result | pb.FrameRejected = response.result
        elif kind == "frame_rejected":
            answer = response.frame_rejected
            error = pb.RejectReason.Name(response.frame_rejected.reason).removeprefix("REJECT_REASON_")
        else:
            return
        context = self._marked.pop(answer.sequence, None)
        if context is not None:
            done = AnsweredFrame(answer.sequence, answer.timing, handed_over_ns, error)
            self._sink.export(done.spans(context, session_id, wall_offset_ns()))


@dataclass(frozen=True, slots=True)
class AnsweredFrame:
    """A frame's way through the server."""

    sequence: int
    timing: pb.ServerTiming
    handed_over_ns: int
    """When its answer went to the transport, monotonic clock."""
    error: str
    """Why it was rejected; empty = it was not."""

    def spans(self, caller: SpanContext, session_id: str, wall_offset_ns: int) -> list[Span]:
        """The server's spans, their parent first.

        Args:
            caller: the client's span that they hang below.
            session_id: of the stream.
            wall_offset_ns: wall clock minus monotonic clock, here.
        """
        timing = self.timing
        whole = Span(
            "perceive",
            caller.sibling(),
            caller.span_id,
            timing.receive_time_ns + wall_offset_ns,
            self.handed_over_ns + wall_offset_ns,
            {"cable.sequence": self.sequence, "cable.session": session_id},
            SpanKind.SERVER,
            self.error,
        )
        family = SpanFamily(whole.context, wall_offset_ns)
        decode_from_ns = timing.receive_time_ns + timing.decode_wait_ns
        decoded_ns = decode_from_ns + timing.decode_ns
        spans = [whole]
        if timing.decode_ns:
            spans += [
                family.child("decode_wait", timing.receive_time_ns, decode_from_ns),
                family.child("decode", decode_from_ns, decoded_ns),
            ]
        for stage in timing.stages:
            if stage.start_time_ns:
                # A model's place in the queue can be older than the frame that takes it.
                waited_from_ns = max(stage.start_time_ns - stage.wait_ns, decoded_ns)
                done_ns = stage.start_time_ns + stage.run_ns
                spans += [
                    family.child(f"{stage.stage}_wait", waited_from_ns, stage.start_time_ns),
                    family.child(stage.stage, stage.start_time_ns, done_ns, self._attributes_of(stage)),
                ]
        return [*spans, family.child("answer", timing.send_time_ns, self.handed_over_ns)]

    def _attributes_of(self, stage: pb.StageTiming) -> dict[str, int]:
        """Parts of a stage have a duration but no place in time."""
        prefix = f"{stage.stage}."
        parts = {f"cable.{part.stage}_ns": part.run_ns for part in self.timing.stages if part.stage.startswith(prefix)}
        return {"cable.batch_frames": stage.batch_size, **parts}
