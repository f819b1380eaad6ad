"""The edge's loop: capture, prepare, send, and apply what comes back, each in its own task."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

from cable_rpc.edge.capture import Capture, CapturedFrame
from cable_rpc.edge.client import PerceptionClient
from cable_rpc.edge.credit import FramePacer
from cable_rpc.edge.frame_encoder import FrameEncoder, PreparedFrame
from cable_rpc.edge.resuming_client import ResumingClient
from cable_rpc.errors import RemoteError
from cable_rpc.wire.answers import FrameAnswer

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class StreamedFrame:
    """A frame that went the whole way, or was lost on it."""

    prepared: PreparedFrame
    answer: FrameAnswer
    apply_ns: int
    """Applying the mask to the tracker."""
    applied_time_ns: int
    """When the mask had become the prior, monotonic clock."""


@dataclass(frozen=True, slots=True)
class _SentFrame:
    """A frame whose answer is still to come."""

    prepared: PreparedFrame
    told: asyncio.Event = field(default_factory=asyncio.Event)
    """The strategy knows what the frame cost, or sending failed."""


class EdgeStreamer:
    """Streams one capture through one session.

    The client's credit bounds what is in flight. A frame is taken from the camera only when there is a place for
    it, so in real time it is always the newest, and frames are dropped before the encoder, never after. While a
    `ResumingClient` has no connection the camera goes on, and nothing is kept for later. The streamer closes the
    encoder when it is done.
    """

    def __init__(self, capture: Capture, encoder: FrameEncoder, client: PerceptionClient | ResumingClient) -> None:
        self._capture = capture
        self._encoder = encoder
        self._client = client
        self._pacer = FramePacer()
        self._held: CapturedFrame | None = None
        self._begun: int | None = None
        self._sent: dict[int, _SentFrame] = {}
        self._finished = False
        # One worker for tracker and encoder: both hold state and must see frames and masks in one order.
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="edge")

    @property
    def unanswered(self) -> list[int]:
        """Indices of frames that were sent and not answered; what is left of them after an error is lost."""
        return sorted(self._sent)

    async def run(self) -> AsyncGenerator[StreamedFrame, None]:
        """Yields every answered, rejected or lost frame, in order, until the source ends.

        Raises:
            SourceError: the source failed.
            RemoteError: the server closed the session or vanished.
        """
        self._capture.start()
        sender = asyncio.create_task(self._send_all())
        try:
            async for answer in self._client.answers():
                yield await self._apply(answer)
                if not answer.is_lost:
                    self._client.release_credit()
            if not self._finished:
                raise RemoteError(f"{self._client.target} ended the stream before the source did")
            await sender
        finally:
            self._capture.stop()
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)
            self._worker.shutdown(wait=True)
            self._encoder.close()

    async def _send_all(self) -> None:
        try:
            while True:
                await self._client.acquire_credit()
                connection = self._client.connection
                captured = await self._next_frame()
                if captured is None:
                    break
                if self._client.connection != connection:
                    self._set_aside(captured)
                    continue
                prepared = await self._prepare(captured, connection)
                if self._client.connection != connection:
                    # It was coded for a decoder that may be gone; the next frame makes up for it.
                    self._capture.dropped.append(prepared.index)
                    continue
                await self._send(prepared)
        finally:
            self._finished = True
            await self._client.finish()

    async def _next_frame(self) -> CapturedFrame | None:
        if self._capture.realtime:
            await self._pacer.wait(self._client.max_frame_rate)
        held, self._held = self._held, None
        return held or await self._capture.next_frame()

    def _set_aside(self, captured: CapturedFrame) -> None:
        """The place that the frame was taken for has gone with its connection."""
        if self._capture.realtime:
            self._capture.dropped.append(captured.frame.index)
        else:
            self._held = captured

    async def _prepare(self, captured: CapturedFrame, connection: int) -> PreparedFrame:
        """Codes a frame so that the server can begin with it, if it is the first of a connection."""
        client, encoder = self._client, self._encoder
        force_keyframe, client.keyframe_requested = client.keyframe_requested, False
        if connection != self._begun and encoder.last_index is not None:
            force_keyframe |= encoder.last_index != client.decoded_sequence
            if not client.resumed:
                await self._in_worker(encoder.strategy.request_keyframe)
        self._begun = connection
        return await self._in_worker(partial(encoder.prepare, captured, force_keyframe=force_keyframe))

    async def _send(self, prepared: PreparedFrame) -> None:
        self._sent[prepared.index] = sent = _SentFrame(prepared)
        try:
            await self._client.send(prepared.message)
            await self._in_worker(partial(self._encoder.strategy.sent, prepared.index, prepared.uplink_message_bytes))
        finally:
            sent.told.set()

    async def _apply(self, answer: FrameAnswer) -> StreamedFrame:
        sent = self._sent.pop(answer.sequence, None)
        if sent is None:
            raise RemoteError(f"{self._client.target} answered frame {answer.sequence}, which is not open")
        # A fast answer could overtake the sender's own bookkeeping.
        await sent.told.wait()
        started_ns = time.monotonic_ns()
        segmentation = answer.segmentation
        if segmentation is not None:
            update = partial(
                self._encoder.strategy.update,
                answer.sequence,
                segmentation.mask,
                confidence=segmentation.confidence,
                uncertainty=segmentation.uncertainty,
            )
            await self._in_worker(update)
        elif answer.is_lost and sent.prepared.proposal.keyframe:
            await self._in_worker(self._encoder.strategy.request_keyframe)
        applied_ns = time.monotonic_ns()
        return StreamedFrame(sent.prepared, answer, applied_ns - started_ns, applied_ns)

    async def _in_worker(self, call: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._worker, call)
