"""One camera's session: pure asyncio over messages, so that plain grpc.aio and Ray Serve host the same class.

The rules R1-R8 that it keeps stand in proto/cable/v1/perception.proto.
"""

from __future__ import annotations

import asyncio
import logging
import time
import uuid
from collections.abc import AsyncGenerator, AsyncIterator
from concurrent.futures import Executor
from functools import partial

from google.rpc import code_pb2, status_pb2

from cable_rpc.cloud.admission import AdmissionControl, StreamShare
from cable_rpc.cloud.answer_queue import Answer, AnswerQueue, Response
from cable_rpc.cloud.bounds import check_codec_config, check_task
from cable_rpc.cloud.credit_advice import CreditAdvice
from cable_rpc.cloud.frame_answers import rejection_of, resolve, result_of
from cable_rpc.cloud.handshake import read_hello
from cable_rpc.cloud.limits import ANYBODY, Identity
from cable_rpc.cloud.newest_frame import NewestFrame, WaitingFrame
from cable_rpc.cloud.perception import Perception, PerceptionModels, PerceptionRequest
from cable_rpc.cloud.public_text import log_text, public_text
from cable_rpc.cloud.server_info import model_infos
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.cloud.session_store import SessionState, SessionStore, StoreLimits
from cable_rpc.cloud.stream_decoder import DecodedFrame, FrameRejection, StreamDecoder
from cable_rpc.cloud.telemetry import NOBODY, Telemetry
from cable_rpc.cloud.throttled_log import ThrottledWarning
from cable_rpc.errors import CableError, ProtocolError, Refusal
from cable_rpc.structured_log import label_client, label_stream
from cable_rpc.wire.convert import PROTOCOL_REVISION, status_of
from cable_rpc.wire.v1 import perception_pb2 as pb

log = logging.getLogger(__name__)
warn_of_refusal = ThrottledWarning(log)

SMALL_MASK_CELLS = 1 << 14
"""A mask of so few is coded sooner than it is handed to another thread."""

Requests = AsyncIterator[pb.StreamPerceptionRequest]


class PerceptionSession:
    """Decodes, perceives and answers one stream; what outlives it goes to the store of its server.

    Args:
        models: what answers.
        limits: of this stream.
        decode_executor: where decoding runs.
        admission: counts the streams of the server; None = one that refuses nothing.
        identity: whose stream it is.
        telemetry: is told what happens.
        store: where sessions wait for their clients to come back; None = none is kept.
    """

    def __init__(
        self,
        models: PerceptionModels,
        limits: SessionLimits,
        decode_executor: Executor,
        *,
        admission: AdmissionControl | None = None,
        identity: Identity = ANYBODY,
        telemetry: Telemetry = NOBODY,
        store: SessionStore | None = None,
    ) -> None:
        self._state = SessionState(uuid.uuid4().hex[:12])
        self._store = SessionStore(StoreLimits(window_s=0.0), models.forget_stream) if store is None else store
        self._token = b""
        self._keep = True
        self._winding_up: asyncio.Future[None] | None = None
        self._models = models
        self._limits = limits
        self._executor = decode_executor
        self._admission = admission or AdmissionControl()
        self.identity = identity
        self._telemetry = telemetry
        self._share: StreamShare | None = None
        self._answers = AnswerQueue()
        self._newest = NewestFrame(limits.latency_bound_s)
        self._credit = CreditAdvice(limits.max_in_flight)
        self._keyframe_requested = False
        self._closing = False
        self._heard_s = time.monotonic()
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def session_id(self) -> str:
        """Name of the session; a stream that takes one over takes its name."""
        return self._state.session_id

    async def run(self, requests: Requests) -> AsyncGenerator[Response, None]:
        """Serves the stream until the client ends it, breaks a rule, or `drain` is called."""
        self._telemetry.stream_opened()
        label_stream(self.session_id, self.identity.name)
        self._tasks = [asyncio.create_task(self._read_all(requests)), asyncio.create_task(self._infer_newest())]
        try:
            while (response := await self._next_response()) is not None:
                self._telemetry.response_sent(response)
                yield response
        finally:
            self._telemetry.stream_closed()
            await self._end()

    async def give_way(self) -> None:
        """Ends this stream, whose client has come back on another; its state is in the store then."""
        log.info("session %s: taken over by a new stream", self.session_id)
        await self._end()
        self._answers.abandon()

    async def _end(self) -> None:
        """Ends the work, once, whoever asks for it first."""
        if self._winding_up is None:
            self._winding_up = asyncio.ensure_future(self._wind_up())
        await asyncio.shield(self._winding_up)

    async def _wind_up(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._share is not None:
            self._share.release()
        await self._state.settle()
        await self._store.leave(self._token, self.identity, self._state, keep=self._keep and bool(self._token))

    def drain(self, status: status_pb2.Status, action: pb.CloseAction, alternative_target: str = "") -> None:
        """Tells the client to go; pending frames are still answered, new ones are ignored.

        Args:
            status: why.
            action: what the client is to do.
            alternative_target: another server, "host:port"; only with MOVE.
        """
        if not self._closing:
            self._closing = True
            self._keep &= action != pb.CLOSE_ACTION_STOP
            self._heard_s = time.monotonic()
            status.message = public_text(status.message)
            closing = pb.Closing(status=status, action=action, alternative_target=alternative_target)
            self._answers.send(Response(closing=closing))

    # -- outbound ---------------------------------------------------------------------------------------------

    async def _next_response(self) -> Response | None:
        """The next message in order, a heartbeat if nothing is ready in time, None at the end."""
        while True:
            try:
                return await self._answers.next(self._limits.heartbeat_s)
            except TimeoutError:
                if self._is_overdue():
                    return None
                if not self._closing:
                    return Response(flow_update=self._flow())

    def _is_overdue(self) -> bool:
        """True when a client that was sent away has not gone; sends away one that has long been silent."""
        silent_s = time.monotonic() - self._heard_s
        if self._answers.unanswered:
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
        flow.max_in_flight = self._credit.in_flight
        if self._share is not None:
            flow.max_frame_rate = self._share.frame_rate_advice
        return flow

    # -- inbound ----------------------------------------------------------------------------------------------

    async def _read_all(self, requests: Requests) -> None:
        try:
            await self._begin(await read_hello(requests, self._limits.hello_timeout_s))
            async for request in requests:
                self._heard_s = time.monotonic()
                if self._closing:
                    continue
                if request.WhichOneof("payload") == "goodbye":
                    self._keep = request.goodbye.keep_session
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
            self._answers.end()

    async def _close(
        self,
        requests: Requests,
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

    async def _begin(self, hello: pb.Hello) -> None:
        # A stream that the client has given up may hold the place that this one needs.
        await self._store.end_stream(hello.resume_token, self.identity)
        self._share = self._admission.open_stream(self.identity)
        kept = self._store.take(hello.resume_token, self.identity)
        if kept is not None:
            self._state = kept
            self._token = hello.resume_token
        self._configure(hello.codec_config, keep_decoder=True)
        self._state.task = hello.task_config
        self._token = self._store.enter(self, self._token)
        self._heard_s = time.monotonic()
        label_client(self.session_id, hello.client_id)
        log.info(
            "session %s of %s%s: %s %s %dx%d",
            self.session_id,
            self.identity.name,
            "" if kept is None else " resumed",
            log_text(hello.client_id) or "unnamed client",
            pb.Codec.Name(hello.codec_config.codec),
            hello.codec_config.width,
            hello.codec_config.height,
        )
        welcome = pb.Welcome(
            protocol_revision=PROTOCOL_REVISION,
            session_id=self.session_id,
            flow=self._flow(),
            models=model_infos(self._models),
            resumed=kept is not None,
            decoded_sequence=self._state.decoded_sequence,
        )
        if self._store.limits.window_s > 0:
            welcome.resume_token, welcome.resume_window_s = self._token, self._store.limits.window_s
        self._answers.send(Response(welcome=welcome))

    def _configure(self, config: pb.CodecConfig, *, keep_decoder: bool = False) -> None:
        check_codec_config(config, self._limits.max_pixels)
        if self._share is not None:
            self._share.announce(config.width, config.height, config.frame_rate)
        state = self._state
        if keep_decoder and state.decoder is not None and state.config == config:
            return
        decoder = StreamDecoder(config, self._limits.max_pixels)
        if state.decoder is not None:
            state.decoder.close()
        state.decoder, state.config = decoder, config
        self._keyframe_requested = False

    async def _handle(self, request: pb.StreamPerceptionRequest) -> None:
        kind = request.WhichOneof("payload")
        if kind == "frame":
            await self._accept(request.frame)
        elif kind == "task_config":
            check_task(request.task_config)
            self._state.task = request.task_config
        elif kind == "codec_config":
            self._configure(request.codec_config)
        else:
            raise ProtocolError(f"unexpected message in a running session: {kind or 'nothing set'}")

    async def _accept(self, frame: pb.VideoFrame) -> None:
        received_ns = time.monotonic_ns()
        if self._answers.unanswered >= self._limits.max_in_flight:
            raise ProtocolError(
                f"frame {frame.sequence} exceeds the credit of {self._limits.max_in_flight} unanswered frames"
            )
        if self._state.last_sequence is not None and frame.sequence <= self._state.last_sequence:
            raise ProtocolError(f"sequence must rise: {frame.sequence} came after {self._state.last_sequence}")
        wait_s = self._share.take_frame(len(frame.data)) if self._share is not None else 0.0
        self._state.last_sequence = frame.sequence
        self._telemetry.frame_received(frame)
        answer = self._answers.open_answer()
        timing = pb.ServerTiming(receive_time_ns=received_ns)
        if wait_s:
            # Not reading on is what slows the client down: its credit is bounded.
            await asyncio.sleep(wait_s)
        try:
            decoded = await self._decode(frame, timing)
        except FrameRejection as rejection:
            self._reject(answer, frame, timing, rejection)
            return
        except Exception:
            # An answer left open would hold back all later ones.
            log.exception("session %s: decoding frame %d failed", self.session_id, frame.sequence)
            if self._state.decoder is not None:
                self._state.decoder.mark_lost()
            message = f"frame {frame.sequence} can't be decoded; see the server's log"
            self._reject(answer, frame, timing, FrameRejection(pb.REJECT_REASON_UNDECODABLE, message))
            return
        self._keyframe_requested = False
        self._newest.offer(WaitingFrame(frame.sequence, decoded, timing, answer, frame.deadline_ns))

    def _reject(self, answer: Answer, frame: pb.VideoFrame, timing: pb.ServerTiming, rejection: FrameRejection) -> None:
        resolve(answer, rejection_of(frame.sequence, timing, rejection.reason, str(rejection)))
        self._request_keyframe()

    async def _decode(self, frame: pb.VideoFrame, timing: pb.ServerTiming) -> DecodedFrame:
        decoder = self._state.decoder
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
        decoder = self._state.decoder
        if decoder is None or self._keyframe_requested:
            return
        if decoder.needs_keyframe:
            self._keyframe_requested = True
            self._answers.send(
                Response(keyframe_request=pb.KeyframeRequest(last_good_sequence=decoder.last_good_sequence))
            )

    # -- inference --------------------------------------------------------------------------------------------

    async def _infer_newest(self) -> None:
        while True:
            await self._newest.wait()
            await self._perceive_newest()

    async def _perceive_newest(self) -> None:
        taken: list[WaitingFrame] = []

        def take() -> PerceptionRequest | None:
            frame = self._newest.take()
            if frame is None:
                return None
            taken.append(frame)
            self._credit.frame_taken(self._newest.overtaken)
            min_score = self._state.task.min_score or self._limits.default_min_score
            return PerceptionRequest(
                frame.decoded.image, frame.decoded.roi, min_score, self._state.task.prompt, frame.sequence
            )

        advised = self._credit.in_flight
        try:
            perception = await self._models.perceive_newest(take, self.session_id)
            result = None if perception is None else await self._coded(taken[0], perception)
        except asyncio.CancelledError:
            raise
        except Exception as error:
            log.exception("session %s: a model failed", self.session_id)
            shown = str(error) if isinstance(error, CableError) else "a model failed; see the server's log"
            for frame in taken:
                text = f"frame {frame.sequence}: {shown}"
                rejection = rejection_of(frame.sequence, frame.timing, pb.REJECT_REASON_MODEL_FAILED, text)
                resolve(frame.answer, rejection)
            return
        if perception is not None and result is not None:
            resolve(taken[0].answer, result)
            self._credit.frame_answered(
                sum(run.wait_ns for run in perception.stages), sum(run.run_ns for run in perception.stages)
            )
        if self._credit.in_flight != advised:
            self._answers.send(Response(flow_update=self._flow()))

    async def _coded(self, frame: WaitingFrame, perception: Perception) -> Response:
        """The answer; coding a large mask takes milliseconds, which the other streams must not wait for."""
        code = partial(result_of, frame.sequence, frame.timing, perception)
        if perception.segmentation.mask.size <= SMALL_MASK_CELLS:
            return code()
        return await asyncio.get_running_loop().run_in_executor(self._executor, code)
