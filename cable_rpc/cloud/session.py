"""One camera's session: pure asyncio over messages, so that plain grpc.aio and Ray Serve host the same class.

The rules R1-R7 that it keeps stand in proto/cable/v1/perception.proto.
"""

from __future__ import annotations

import asyncio
import logging
import time
import uuid
from collections.abc import AsyncGenerator, AsyncIterator
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

from google.rpc import code_pb2, status_pb2

from cable_rpc.cloud.admission import AdmissionControl, StreamShare
from cable_rpc.cloud.bounds import check_codec_config, check_hello, check_task
from cable_rpc.cloud.limits import ANYBODY, Identity
from cable_rpc.cloud.perception import Perception, PerceptionModels
from cable_rpc.cloud.public_text import log_text, public_text
from cable_rpc.cloud.stream_decoder import DecodedFrame, FrameRejection, StreamDecoder
from cable_rpc.cloud.throttled_log import ThrottledWarning
from cable_rpc.errors import CableError, ProtocolError, Refusal
from cable_rpc.wire.convert import (
    PROTOCOL_REVISION,
    detections_to_messages,
    mask_to_message,
    status_of,
)
from cable_rpc.wire.v1 import perception_pb2 as pb

log = logging.getLogger(__name__)
warn_of_refusal = ThrottledWarning(log)

Response = pb.StreamPerceptionResponse


@dataclass(frozen=True, slots=True)
class SessionLimits:
    """What one session may use."""

    max_in_flight: int = 2
    """Unanswered frames; 2 keeps a link busy without queueing stale video."""
    max_frame_bytes: int = 2 << 20
    max_pixels: int = 4096 * 2304
    default_min_score: float = 0.4
    hello_timeout_s: float = 10.0
    heartbeat_s: float = 5.0
    close_timeout_s: float = 5.0
    idle_timeout_s: float = 300.0
    """A client that has nothing unanswered and sends nothing for so long is sent away."""

    def flow(self) -> pb.FlowUpdate:
        """The limits as the client is told them."""
        return pb.FlowUpdate(max_in_flight=self.max_in_flight, max_frame_bytes=self.max_frame_bytes)


@dataclass(frozen=True, slots=True)
class _Accepted:
    """A decoded frame that waits for the models."""

    message: pb.VideoFrame
    decoded: DecodedFrame
    timing: pb.ServerTiming
    answer: asyncio.Future[Response]


def model_infos(models: PerceptionModels) -> list[pb.ModelInfo]:
    """The hosted models as the client is told them."""
    kinds = ((models.detector, pb.RESULT_KIND_DETECTION), (models.segmenter, pb.RESULT_KIND_SEGMENTATION))
    return [
        pb.ModelInfo(name=public_text(model.name), revision=model.revision, device=model.device, result_kind=kind)
        for model, kind in kinds
    ]


class PerceptionSession:
    """Decodes, perceives and answers one stream; owns nothing that outlives it.

    Args:
        models: what answers.
        limits: of this stream.
        decode_executor: where decoding runs.
        admission: counts the streams of the server; None = one that refuses nothing.
        identity: whose stream it is.
    """

    def __init__(
        self,
        models: PerceptionModels,
        limits: SessionLimits,
        decode_executor: Executor,
        *,
        admission: AdmissionControl | None = None,
        identity: Identity = ANYBODY,
    ) -> None:
        self.session_id = uuid.uuid4().hex[:12]
        self._models = models
        self._limits = limits
        self._executor = decode_executor
        self._admission = admission or AdmissionControl()
        self.identity = identity
        self._share: StreamShare | None = None
        self._outbound: asyncio.Queue[Response | asyncio.Future[Response] | None] = asyncio.Queue()
        self._newest: _Accepted | None = None
        self._newest_arrived = asyncio.Event()
        self._decoder: StreamDecoder | None = None
        self._codec: pb.Codec = pb.CODEC_UNSPECIFIED
        self._task = pb.TaskConfig()
        self._in_flight = 0
        self._last_sequence: int | None = None
        self._keyframe_requested = False
        self._closing = False
        self._heard_s = time.monotonic()
        self._awaited: asyncio.Future[Any] | None = None

    async def run(self, requests: AsyncIterator[pb.StreamPerceptionRequest]) -> AsyncGenerator[Response, None]:
        """Serves the stream until the client ends it, breaks a rule, or `drain` is called."""
        reader = asyncio.create_task(self._read_all(requests))
        inference = asyncio.create_task(self._infer_newest())
        try:
            while (response := await self._next_response()) is not None:
                yield response
        finally:
            for task in (reader, inference, self._awaited):
                if task is not None:
                    task.cancel()
            await asyncio.gather(reader, inference, return_exceptions=True)
            if self._share is not None:
                self._share.release()
            self._models.forget_stream(self.session_id)
            if self._decoder is not None:
                # Cancelling the reader does not stop a decode under way: closing waits for it, off the loop.
                await asyncio.to_thread(self._decoder.close)

    def drain(self, status: status_pb2.Status, action: pb.CloseAction, alternative_target: str = "") -> None:
        """Tells the client to go; pending frames are still answered, new ones are ignored.

        Args:
            status: why.
            action: what the client is to do.
            alternative_target: another server, "host:port"; only with MOVE.
        """
        if not self._closing:
            self._closing = True
            self._heard_s = time.monotonic()
            status.message = public_text(status.message)
            closing = pb.Closing(status=status, action=action, alternative_target=alternative_target)
            self._send(Response(closing=closing))

    # -- outbound ---------------------------------------------------------------------------------------------

    async def _next_response(self) -> Response | None:
        """The next message in order, a heartbeat if nothing is ready in time, None at the end."""
        while True:
            if self._awaited is None:
                self._awaited = asyncio.ensure_future(self._outbound.get())
            done, _ = await asyncio.wait({self._awaited}, timeout=self._limits.heartbeat_s)
            if not done:
                if self._is_overdue():
                    return None
                if not self._closing:
                    return Response(flow_update=self._flow())
                continue
            item, self._awaited = self._awaited.result(), None
            if not isinstance(item, asyncio.Future):
                return item
            item.add_done_callback(self._release_credit)
            self._awaited = item

    def _is_overdue(self) -> bool:
        """True when a client that was sent away has not gone; sends away one that has long been silent."""
        silent_s = time.monotonic() - self._heard_s
        if self._in_flight:
            return False
        if self._closing:
            return silent_s > self._limits.close_timeout_s
        if silent_s > self._limits.idle_timeout_s:
            text = f"no message for {silent_s:.0f} s; connect again when there are frames"
            log.info("session %s: %s", self.session_id, text)
            self.drain(status_pb2.Status(code=code_pb2.DEADLINE_EXCEEDED, message=text), pb.CLOSE_ACTION_RESUME)
        return False

    def _flow(self) -> pb.FlowUpdate:
        """The limits of this stream as the client is told them."""
        flow = self._limits.flow()
        if self._share is not None:
            flow.max_frame_rate = self._share.frame_rate_advice
        return flow

    def _release_credit(self, _: asyncio.Future[Response]) -> None:
        self._in_flight -= 1

    def _send(self, response: Response) -> None:
        self._outbound.put_nowait(response)

    # -- inbound ----------------------------------------------------------------------------------------------

    async def _read_all(self, requests: AsyncIterator[pb.StreamPerceptionRequest]) -> None:
        try:
            self._share = self._admission.open_stream(self.identity)
            await self._read_hello(requests)
            async for request in requests:
                self._heard_s = time.monotonic()
                if self._closing:
                    continue
                if request.WhichOneof("payload") == "goodbye":
                    break
                await self._handle(request)
        except Refusal as error:
            warn_of_refusal("session %s of %s refused: %s", self.session_id, self.identity.name, error)
            await self._close(requests, status_of(error), pb.CLOSE_ACTION_RESUME)
        except CableError as error:
            log.info("session %s closed: %s", self.session_id, error)
            await self._close(requests, status_of(error), pb.CLOSE_ACTION_STOP)
        except Exception:
            log.exception("session %s failed", self.session_id)
            internal = status_pb2.Status(code=code_pb2.INTERNAL, message="internal error; see the server's log")
            await self._close(requests, internal, pb.CLOSE_ACTION_STOP)
        finally:
            self._outbound.put_nowait(None)

    async def _close(
        self,
        requests: AsyncIterator[pb.StreamPerceptionRequest],
        status: status_pb2.Status,
        action: pb.CloseAction,
    ) -> None:
        self.drain(status, action)
        # Ending the call while the client still writes would replace our status by a broken stream (grpc #36066).
        try:
            async with asyncio.timeout(self._limits.close_timeout_s):
                async for _ in requests:
                    pass
        except TimeoutError:
            log.info("session %s: the client did not half-close", self.session_id)

    async def _read_hello(self, requests: AsyncIterator[pb.StreamPerceptionRequest]) -> None:
        try:
            async with asyncio.timeout(self._limits.hello_timeout_s):
                first = await anext(requests, None)
        except TimeoutError:
            raise ProtocolError(f"no Hello within {self._limits.hello_timeout_s:g} s") from None
        if first is None:
            raise ProtocolError("the stream ended before its Hello")
        kind = first.WhichOneof("payload")
        if kind != "hello":
            raise ProtocolError(f"the first message must be Hello with a CodecConfig, got {kind or 'nothing'}")
        hello = first.hello
        if hello.protocol_revision != PROTOCOL_REVISION:
            raise ProtocolError(
                f"the client speaks protocol revision {hello.protocol_revision}, this server {PROTOCOL_REVISION}; "
                "update the older one"
            )
        check_hello(hello)
        self._configure(hello.codec_config)
        self._task = hello.task_config
        self._heard_s = time.monotonic()
        log.info(
            "session %s of %s: %s %s %dx%d",
            self.session_id,
            self.identity.name,
            log_text(hello.client_id) or "unnamed client",
            pb.Codec.Name(self._codec),
            hello.codec_config.width,
            hello.codec_config.height,
        )
        self._send(
            Response(
                welcome=pb.Welcome(
                    protocol_revision=PROTOCOL_REVISION,
                    session_id=self.session_id,
                    flow=self._flow(),
                    models=model_infos(self._models),
                )
            )
        )

    def _configure(self, config: pb.CodecConfig) -> None:
        check_codec_config(config, self._limits.max_pixels)
        if self._share is not None:
            self._share.announce(config.width, config.height, config.frame_rate)
        decoder = StreamDecoder(config, self._limits.max_pixels)
        if self._decoder is not None:
            self._decoder.close()
        self._decoder, self._codec = decoder, config.codec
        self._keyframe_requested = False

    async def _handle(self, request: pb.StreamPerceptionRequest) -> None:
        kind = request.WhichOneof("payload")
        if kind == "frame":
            await self._accept(request.frame)
        elif kind == "task_config":
            check_task(request.task_config)
            self._task = request.task_config
        elif kind == "codec_config":
            self._configure(request.codec_config)
        else:
            raise ProtocolError(f"unexpected message in a running session: {kind or 'nothing set'}")

    async def _accept(self, frame: pb.VideoFrame) -> None:
        received_ns = time.monotonic_ns()
        if self._in_flight >= self._limits.max_in_flight:
            raise ProtocolError(
                f"frame {frame.sequence} exceeds the credit of {self._limits.max_in_flight} unanswered frames"
            )
        if self._last_sequence is not None and frame.sequence <= self._last_sequence:
            raise ProtocolError(f"sequence must rise: {frame.sequence} came after {self._last_sequence}")
        wait_s = self._share.take_frame(len(frame.data)) if self._share is not None else 0.0
        self._last_sequence = frame.sequence
        self._in_flight += 1
        answer: asyncio.Future[Response] = asyncio.get_running_loop().create_future()
        self._outbound.put_nowait(answer)
        timing = pb.ServerTiming(receive_time_ns=received_ns)
        if wait_s:
            # Not reading on is what slows the client down: its credit is bounded.
            await asyncio.sleep(wait_s)
        try:
            decoded = await self._decode(frame, timing)
        except FrameRejection as rejection:
            _reject(answer, frame, timing, rejection)
            self._request_keyframe()
            return
        except Exception:
            # An answer left open would hold back all later ones.
            log.exception("session %s: decoding frame %d failed", self.session_id, frame.sequence)
            if self._decoder is not None:
                self._decoder.mark_lost()
            message = f"frame {frame.sequence} can't be decoded; see the server's log"
            _reject(answer, frame, timing, FrameRejection(pb.REJECT_REASON_UNDECODABLE, message))
            self._request_keyframe()
            return
        self._keyframe_requested = False
        self._offer(_Accepted(frame, decoded, timing, answer))

    async def _decode(self, frame: pb.VideoFrame, timing: pb.ServerTiming) -> DecodedFrame:
        decoder = self._decoder
        if decoder is None:
            raise ProtocolError("a frame came before any CodecConfig")
        if len(frame.data) > self._limits.max_frame_bytes:
            decoder.mark_lost()
            raise FrameRejection(
                pb.REJECT_REASON_TOO_LARGE,
                f"frame {frame.sequence} has {len(frame.data)} bytes, the limit is {self._limits.max_frame_bytes}; "
                "lower the quality or the resolution",
            )
        queued_ns = time.monotonic_ns()

        def timed() -> DecodedFrame:
            started_ns = time.monotonic_ns()
            timing.decode_wait_ns = started_ns - queued_ns
            try:
                return decoder.decode(frame)
            finally:
                timing.decode_ns = time.monotonic_ns() - started_ns

        return await asyncio.get_running_loop().run_in_executor(self._executor, timed)

    def _request_keyframe(self) -> None:
        decoder = self._decoder
        if decoder is None or self._keyframe_requested:
            return
        if decoder.needs_keyframe:
            self._keyframe_requested = True
            self._send(Response(keyframe_request=pb.KeyframeRequest(last_good_sequence=decoder.last_good_sequence)))

    def _offer(self, accepted: _Accepted) -> None:
        overtaken = self._newest
        self._newest = accepted
        self._newest_arrived.set()
        if overtaken is not None:
            _reject(
                overtaken.answer,
                overtaken.message,
                overtaken.timing,
                FrameRejection(
                    pb.REJECT_REASON_SUPERSEDED,
                    f"frame {overtaken.message.sequence} was overtaken by {accepted.message.sequence}",
                ),
            )

    # -- inference --------------------------------------------------------------------------------------------

    async def _infer_newest(self) -> None:
        while True:
            await self._newest_arrived.wait()
            self._newest_arrived.clear()
            accepted, self._newest = self._newest, None
            if accepted is not None:
                await self._answer(accepted)

    async def _answer(self, accepted: _Accepted) -> None:
        frame, timing = accepted.message, accepted.timing
        waited_ns = time.monotonic_ns() - timing.receive_time_ns
        if 0 < frame.deadline_ns < waited_ns:
            _reject(
                accepted.answer,
                frame,
                timing,
                FrameRejection(
                    pb.REJECT_REASON_DEADLINE,
                    f"frame {frame.sequence} waited {waited_ns / 1e6:.0f} ms, its deadline is "
                    f"{frame.deadline_ns / 1e6:.0f} ms",
                ),
            )
            return
        try:
            perception = await self._models.perceive(
                accepted.decoded.image,
                accepted.decoded.roi,
                prompt=self._task.prompt,
                min_score=self._task.min_score or self._limits.default_min_score,
                sequence=frame.sequence,
                stream=self.session_id,
            )
        except asyncio.CancelledError:
            raise
        except Exception as error:
            log.exception("session %s: a model failed on frame %d", self.session_id, frame.sequence)
            shown = str(error) if isinstance(error, CableError) else "a model failed; see the server's log"
            _reject(
                accepted.answer,
                frame,
                timing,
                FrameRejection(pb.REJECT_REASON_MODEL_FAILED, f"frame {frame.sequence}: {shown}"),
            )
            return
        _resolve(accepted.answer, Response(result=_result(frame.sequence, timing, perception)))


def _result(sequence: int, timing: pb.ServerTiming, perception: Perception) -> pb.Result:
    timing.stages.extend(
        pb.StageTiming(stage=run.stage, wait_ns=run.wait_ns, run_ns=run.run_ns, batch_size=run.batch_size)
        for run in perception.stages
    )
    result = pb.Result(
        sequence=sequence,
        timing=timing,
        detections=detections_to_messages(perception.detections),
        mask=mask_to_message(perception.segmentation),
    )
    result.timing.send_time_ns = time.monotonic_ns()
    return result


def _reject(
    answer: asyncio.Future[Response], frame: pb.VideoFrame, timing: pb.ServerTiming, rejection: FrameRejection
) -> None:
    timing.send_time_ns = time.monotonic_ns()
    _resolve(
        answer,
        Response(
            frame_rejected=pb.FrameRejected(
                sequence=frame.sequence, reason=rejection.reason, message=public_text(str(rejection)), timing=timing
            )
        ),
    )


def _resolve(answer: asyncio.Future[Response], response: Response) -> None:
    if not answer.done():
        answer.set_result(response)
