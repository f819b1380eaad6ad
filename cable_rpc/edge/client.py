"""One camera's session as the edge sees it: handshake, credit, frames up, answers down, clock offset."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from typing import Any

import grpc
from cable_codecs import STILL_CODECS, RegionTreatment

import cable_rpc
from cable_rpc.edge.channel import PLAIN, ClientSecurity, SecureTarget
from cable_rpc.edge.clock_keeper import ClockKeeper
from cable_rpc.edge.credit import Credit
from cable_rpc.edge.transport_errors import closing_error, transport_errors
from cable_rpc.errors import ConnectionLost, ProtocolError, RemoteError
from cable_rpc.types import CameraIntrinsics
from cable_rpc.wire.answers import FrameAnswer
from cable_rpc.wire.clock import ClockOffset
from cable_rpc.wire.convert import CODECS_BY_NAME, PROTOCOL_REVISION, intrinsics_to_message
from cable_rpc.wire.treatment import treatment_to_message
from cable_rpc.wire.v1 import perception_pb2 as pb
from cable_rpc.wire.v1 import perception_pb2_grpc as pb_grpc

WELCOME_TIMEOUT_S = 3.0
"""Rule R1 of the contract."""
PARTING_TIMEOUT_S = 2.0
"""For what is still to come after Closing."""
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

    resume_token: bytes = b""
    """Of the session to go on with."""
    last_result_sequence: int | None = None
    """Last answer received in that session."""

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
            resume_token=self.resume_token,
            last_result_sequence=self.last_result_sequence,
        )


class PerceptionClient:
    """An open session over one connection; use as an async context manager. `ResumingClient` outlives connections.

    Frames are sent with `send` once `acquire_credit` has granted a place; `answers` yields one `FrameAnswer` for
    each of them, and the caller gives the place back with `release_credit` when it has applied the answer.

    Args:
        target: ``grpcs://host:port``, ``grpc://host:port`` or ``host:port``.
        request: what is asked for.
        security: TLS and token.
        window: unanswered frames at most, where that is less than the server grants.
        connect_timeout_s: for everything up to the Welcome.
        silence_timeout_s: after which the connection counts as lost.
        credit: takes the places that the server grants; None = its own.

    Raises:
        ConfigurationError: target, certificates or token can't be used.
        ConnectionLost: the server can't be reached, vanished, or is to be asked again later.
        RemoteError: the server refused the session.
    """

    connection = 0
    """Number of the connection; there is but one."""

    def __init__(
        self,
        target: str,
        request: SessionRequest,
        *,
        security: ClientSecurity = PLAIN,
        window: int | None = None,
        connect_timeout_s: float = 10.0,
        silence_timeout_s: float = SILENCE_TIMEOUT_S,
        credit: Credit | None = None,
    ) -> None:
        self.target = target
        self._way = SecureTarget(target, security)
        self._request = request
        self._window = window
        self._connect_timeout_s = connect_timeout_s
        self._silence_timeout_s = silence_timeout_s
        self._stack = AsyncExitStack()
        self._clock: ClockKeeper | None = None
        self._credit = credit or Credit()
        self.server_info = pb.GetServerInfoResponse()
        self.welcome = pb.Welcome()
        self.max_frame_rate = 0.0
        self.keyframe_requested = False

    @property
    def clock_offset(self) -> ClockOffset | None:
        """Server clock against ours."""
        return None if self._clock is None else self._clock.offset

    @property
    def session_id(self) -> str:
        """Name of the session in the server's logs."""
        return self.welcome.session_id

    @property
    def max_frame_bytes(self) -> int:
        """Largest coded frame that the server accepts."""
        return self.welcome.flow.max_frame_bytes

    @property
    def resumed(self) -> bool:
        """True when the server still had the session that was asked for."""
        return self.welcome.resumed

    @property
    def decoded_sequence(self) -> int | None:
        """Frame that the first one may refer to; None = begin with a keyframe."""
        return self.welcome.decoded_sequence if self.welcome.HasField("decoded_sequence") else None

    async def __aenter__(self) -> PerceptionClient:
        async with AsyncExitStack() as stack:
            # Shared, the connection could be one that is dead and does not know it.
            channel = await stack.enter_async_context(self._way.open_channel(own_connection=True))
            clock_channel = await stack.enter_async_context(self._way.open_channel(own_connection=True))
            self._clock = ClockKeeper(pb_grpc.PerceptionServiceStub(clock_channel), self._way.metadata)
            stub = pb_grpc.PerceptionServiceStub(channel)
            try:
                async with asyncio.timeout(self._connect_timeout_s):
                    with transport_errors(self.target):
                        await self._way.wait_until_ready(channel)
                        if not self._request.resume_token:
                            # Who resumes is in a hurry, and asks only for what it can't begin without.
                            self.server_info = await stub.GetServerInfo(
                                pb.GetServerInfoRequest(), metadata=self._way.metadata
                            )
                            await self._clock.begin()
                        self._call: Any = stub.StreamPerception(metadata=self._way.metadata)
                        stack.callback(self._cancel_call)
                        await self._open()
            except TimeoutError:
                raise ConnectionLost(
                    f"no answer from {self.target} within {self._connect_timeout_s:g} s; is `cable-rpc serve` running "
                    "there, and is the port open?"
                ) from None
            stack.push_async_callback(_cancelled, asyncio.create_task(self._clock.run()))
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
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
            ConnectionLost: the stream is broken.
            RemoteError: the frame is too large.
        """
        if len(frame.data) > self.max_frame_bytes:
            raise RemoteError(
                f"frame {frame.sequence} has {len(frame.data)} bytes, {self.target} accepts {self.max_frame_bytes}; "
                "lower the quality or the resolution"
            )
        frame.send_time_ns = time.monotonic_ns()
        await self._write(pb.StreamPerceptionRequest(frame=frame))

    async def finish(self, *, keep_session: bool = False) -> None:
        """No more frames; the server answers what is pending and ends the stream.

        Args:
            keep_session: True asks the server to keep the session for a later stream.

        Raises:
            ConnectionLost: the stream is broken.
        """
        await self._write(pb.StreamPerceptionRequest(goodbye=pb.Goodbye(keep_session=keep_session)))
        await self._half_close()

    async def answers(self) -> AsyncGenerator[FrameAnswer, None]:
        """One answer for each frame sent, in order; ends with the stream.

        Raises:
            ConnectionLost: the connection broke, or the server asks to be called again.
            RemoteError: the server closed the session.
            ProtocolError: the server sent something that does not fit.
        """
        closed: RemoteError | None = None
        silence_timeout_s = self._silence_timeout_s
        while (response := await self._read(silence_timeout_s, closed)) is not grpc.aio.EOF:
            if response.WhichOneof("payload") == "closing":
                closed = closing_error(self.target, response.closing)
                silence_timeout_s = min(silence_timeout_s, PARTING_TIMEOUT_S)
                await self._half_close()
                continue
            answer = self._understand(response)
            if answer is not None:
                yield answer
        if closed is not None:
            raise closed

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
        elif kind == "flow_update":
            self.max_frame_rate = response.flow_update.max_frame_rate
            if response.flow_update.max_in_flight:
                self._credit.resize(self._window_of(response.flow_update))
        return None

    async def _open(self) -> None:
        await self._write(pb.StreamPerceptionRequest(hello=self._request.to_hello()))
        try:
            async with asyncio.timeout(WELCOME_TIMEOUT_S):
                response = await self._call.read()
        except TimeoutError:
            raise ConnectionLost(f"{self.target} did not say Welcome within {WELCOME_TIMEOUT_S:g} s") from None
        if response is grpc.aio.EOF:
            raise ConnectionLost(f"{self.target} ended the stream without a Welcome")
        kind = response.WhichOneof("payload")
        if kind == "closing":
            raise closing_error(self.target, response.closing)
        if kind != "welcome":
            raise ProtocolError(f"{self.target} answered Hello with {kind}")
        self.welcome = response.welcome
        self.max_frame_rate = self.welcome.flow.max_frame_rate
        self._credit.reset(self._window_of(self.welcome.flow))

    def _window_of(self, flow: pb.FlowUpdate) -> int:
        """Our window under this advice; what the server enforces stands in the Welcome."""
        granted = max(1, self.welcome.flow.max_in_flight)
        return max(1, min(flow.max_in_flight, granted, self._window or granted))

    async def _read(self, timeout_s: float, closed: RemoteError | None) -> Any:
        try:
            with transport_errors(self.target):
                async with asyncio.timeout(timeout_s):
                    return await self._call.read()
        except TimeoutError:
            raise closed or ConnectionLost(
                f"{self.target} was silent for {timeout_s:g} s: the connection is lost"
            ) from None
        except ConnectionLost as error:
            raise closed or error from None

    async def _write(self, request: pb.StreamPerceptionRequest) -> None:
        with transport_errors(self.target):
            await self._call.write(request)

    async def _half_close(self) -> None:
        # The server may have ended the call already, or a write may be stuck in it.
        with suppress(asyncio.InvalidStateError, grpc.aio.InternalError):
            await self._call.done_writing()

    def _cancel_call(self) -> None:
        if not self._call.done():
            self._call.cancel()


async def _cancelled(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
