"""One camera's session as the edge sees it: handshake, credit, frames up, answers down, clock offset."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from typing import Any

import grpc
from cable_codecs import STILL_CODECS, RegionTreatment

import cable_rpc
from cable_rpc.edge.channel import PLAIN, ClientSecurity, SecureTarget, connection_error
from cable_rpc.errors import ProtocolError, RemoteError
from cable_rpc.types import CameraIntrinsics
from cable_rpc.wire.answers import FrameAnswer
from cable_rpc.wire.clock import ClockOffset, ClockOffsetEstimator, ClockSample
from cable_rpc.wire.convert import (
    CODECS_BY_NAME,
    PROTOCOL_REVISION,
    intrinsics_to_message,
    retry_after_s,
    status_code_name,
)
from cable_rpc.wire.treatment import treatment_to_message
from cable_rpc.wire.v1 import perception_pb2 as pb
from cable_rpc.wire.v1 import perception_pb2_grpc as pb_grpc

CLOCK_SAMPLES_AT_START = 8
CLOCK_INTERVAL_S = 5.0
SILENCE_TIMEOUT_S = 10.0
"""Rule R7 of the contract: the server says something every 5 s."""


@dataclass(frozen=True, slots=True)
class SessionRequest:
    """What a client asks for when it opens a session."""

    codec: str
    width: int
    height: int
    frame_rate: float
    quality: int = 0
    client_id: str = ""
    prompt: str = ""
    min_score: float = 0.0
    intrinsics: CameraIntrinsics | None = None
    treatment: RegionTreatment | None = None
    """What the server must undo; None: what measured best for the codec, as `FrameEncoder` takes it."""

    def to_hello(self) -> pb.Hello:
        """The opening message."""
        treatment = self.treatment or RegionTreatment.default_for(stateless=self.codec in STILL_CODECS)
        return pb.Hello(
            protocol_revision=PROTOCOL_REVISION,
            client_id=self.client_id,
            user_agent=f"cable-rpc/{cable_rpc.__version__}",
            codec_config=pb.CodecConfig(
                codec=CODECS_BY_NAME[self.codec],
                width=self.width,
                height=self.height,
                frame_rate=self.frame_rate,
                quality=self.quality,
                treatment=treatment_to_message(treatment),
            ),
            task_config=pb.TaskConfig(prompt=self.prompt, min_score=self.min_score),
            intrinsics=intrinsics_to_message(self.intrinsics) if self.intrinsics else None,
            wall_time_ns=time.time_ns(),
        )


class PerceptionClient:
    """An open session; use as an async context manager.

    Frames are sent with `send` once `acquire_credit` has granted a place; `answers` yields one `FrameAnswer` for
    each of them, and the caller gives the place back with `release_credit` when it has applied the answer.

    Args:
        target: ``grpcs://host:port``, ``grpc://host:port`` or ``host:port``.
        request: what is asked for.
        security: TLS and token.
        window: unanswered frames at most, where that is less than the server grants.
        connect_timeout_s: for everything up to the Welcome.
        silence_timeout_s: after which the connection counts as lost.

    Raises:
        ConfigurationError: target, certificates or token can't be used.
        RemoteError: the server can't be reached, refused the session, or vanished.
    """

    def __init__(
        self,
        target: str,
        request: SessionRequest,
        *,
        security: ClientSecurity = PLAIN,
        window: int | None = None,
        connect_timeout_s: float = 10.0,
        silence_timeout_s: float = SILENCE_TIMEOUT_S,
    ) -> None:
        self.target = target
        self._way = SecureTarget(target, security)
        self._request = request
        self._window = window
        self._connect_timeout_s = connect_timeout_s
        self._silence_timeout_s = silence_timeout_s
        self._stack = AsyncExitStack()
        self._clock = ClockOffsetEstimator()
        self.server_info = pb.GetServerInfoResponse()
        self.session_id = ""
        self.max_frame_bytes = 0
        self.keyframe_requested = False

    @property
    def clock_offset(self) -> ClockOffset | None:
        """Server clock against ours."""
        return self._clock.offset

    async def __aenter__(self) -> PerceptionClient:
        async with AsyncExitStack() as stack:
            channel = await stack.enter_async_context(self._way.open_channel())
            clock_channel = await stack.enter_async_context(self._way.open_channel(own_connection=True))
            self._clock_stub = pb_grpc.PerceptionServiceStub(clock_channel)
            stub = pb_grpc.PerceptionServiceStub(channel)
            try:
                async with asyncio.timeout(self._connect_timeout_s):
                    await self._way.wait_until_ready(channel)
                    self.server_info = await stub.GetServerInfo(pb.GetServerInfoRequest(), metadata=self._way.metadata)
                    for _ in range(CLOCK_SAMPLES_AT_START):
                        await self._sample_clock()
                    self._call: Any = stub.StreamPerception(metadata=self._way.metadata)
                    await self._open()
            except TimeoutError:
                raise RemoteError(
                    f"no answer from {self.target} within {self._connect_timeout_s:g} s; is `cable-rpc serve` running "
                    "there, and is the port open?"
                ) from None
            except grpc.aio.AioRpcError as error:
                raise connection_error(self.target, error) from error
            stack.push_async_callback(_cancelled, asyncio.create_task(self._keep_clock()))
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if not self._call.done():
            self._call.cancel()
        await self._stack.aclose()

    async def acquire_credit(self) -> None:
        """Waits until another frame may be sent."""
        await self._credit.acquire()

    def release_credit(self) -> None:
        """Gives the place of an answered frame back."""
        self._credit.release()

    async def send(self, frame: pb.VideoFrame) -> None:
        """Stamps a frame and hands it to the transport.

        Raises:
            RemoteError: the stream is broken.
        """
        if len(frame.data) > self.max_frame_bytes:
            raise RemoteError(
                f"frame {frame.sequence} has {len(frame.data)} bytes, {self.target} accepts {self.max_frame_bytes}; "
                "lower the quality or the resolution"
            )
        frame.send_time_ns = time.monotonic_ns()
        await self._write(pb.StreamPerceptionRequest(frame=frame))

    async def finish(self) -> None:
        """No more frames; the server answers what is pending and ends the stream."""
        await self._write(pb.StreamPerceptionRequest(goodbye=pb.Goodbye()))
        with suppress(asyncio.InvalidStateError):  # the server may have ended the call on Goodbye already
            await self._call.done_writing()

    async def answers(self) -> AsyncIterator[FrameAnswer]:
        """One answer for each frame sent, in order; ends with the stream.

        Raises:
            RemoteError: the server closed the session or vanished.
            ProtocolError: the server sent something that does not fit.
        """
        try:
            while (response := await self._read()) is not grpc.aio.EOF:
                answer = self._understand(response)
                if answer is not None:
                    yield answer
        except grpc.aio.AioRpcError as error:
            raise connection_error(self.target, error) from error

    def _understand(self, response: pb.StreamPerceptionResponse) -> FrameAnswer | None:
        received_ns = time.monotonic_ns()
        size = response.ByteSize()
        kind = response.WhichOneof("payload")
        if kind == "result":
            return FrameAnswer.from_result(
                response.result,
                self._request.height,
                self._request.width,
                receive_time_ns=received_ns,
                message_bytes=size,
            )
        if kind == "frame_rejected":
            return FrameAnswer.from_rejection(response.frame_rejected, receive_time_ns=received_ns, message_bytes=size)
        if kind == "keyframe_request":
            self.keyframe_requested = True
        elif kind == "closing":
            raise _closed(self.target, response.closing)
        return None

    async def _open(self) -> None:
        await self._write(pb.StreamPerceptionRequest(hello=self._request.to_hello()))
        response = await self._call.read()
        if response is grpc.aio.EOF:
            raise RemoteError(f"{self.target} ended the stream without a Welcome")
        kind = response.WhichOneof("payload")
        if kind == "closing":
            raise _closed(self.target, response.closing)
        if kind != "welcome":
            raise ProtocolError(f"{self.target} answered Hello with {kind}")
        welcome = response.welcome
        self.session_id = welcome.session_id
        self.max_frame_bytes = welcome.flow.max_frame_bytes
        granted = max(1, welcome.flow.max_in_flight)
        self._credit = asyncio.Semaphore(min(granted, self._window or granted))

    async def _read(self) -> Any:
        try:
            async with asyncio.timeout(self._silence_timeout_s):
                return await self._call.read()
        except TimeoutError:
            raise RemoteError(
                f"{self.target} was silent for {self._silence_timeout_s:g} s: the connection is lost"
            ) from None

    async def _write(self, request: pb.StreamPerceptionRequest) -> None:
        try:
            await self._call.write(request)
        except asyncio.InvalidStateError as error:
            raise RemoteError(f"{self.target} has ended the stream") from error
        except grpc.aio.AioRpcError as error:
            raise connection_error(self.target, error) from error

    async def _sample_clock(self) -> None:
        sent_ns = time.monotonic_ns()
        response = await self._clock_stub.SyncClock(
            pb.SyncClockRequest(client_send_time_ns=sent_ns), metadata=self._way.metadata
        )
        self._clock.add(
            ClockSample(sent_ns, response.server_receive_time_ns, response.server_send_time_ns, time.monotonic_ns())
        )

    async def _keep_clock(self) -> None:
        while True:
            await asyncio.sleep(CLOCK_INTERVAL_S)
            try:
                await self._sample_clock()
            except grpc.aio.AioRpcError:
                continue  # the stream itself reports a lost server


async def _cancelled(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


def _closed(target: str, closing: pb.Closing) -> RemoteError:
    text = f"{target} closed the session: {status_code_name(closing.status)}: {closing.status.message}"
    wait_s = retry_after_s(closing.status)
    if wait_s is not None:
        text += f"; try again in {wait_s:.0f} s"
    if closing.alternative_target:
        text += f", at {closing.alternative_target}"
    return RemoteError(text)
