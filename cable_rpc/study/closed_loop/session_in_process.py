"""A perception session beside its client in one process: real messages, no network."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor

from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.cloud.session import PerceptionSession
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.edge.client import SessionRequest
from cable_rpc.errors import FrameError, RemoteError
from cable_rpc.wire.answers import FrameAnswer
from cable_rpc.wire.v1 import perception_pb2 as pb

NO_LIMIT = 1 << 30
NOMINAL_DURATION_NS = 5_000_000
NOMINAL_STAMP_NS = 10**14
"""A day or so after the machine came up."""


class SessionInProcess:
    """An open session of the models, in lock-step; use as an async context manager.

    Every message is serialised and parsed as on a wire, so both ends see what they would see over one, and its size
    is the true one.

    Args:
        models: shared by any number of sessions.
        request: what a client would open it with.
        nominal_times: answers are counted as if their times took nominal values, so that equal settings give equal
            bytes.
    """

    def __init__(self, models: PerceptionModels, request: SessionRequest, *, nominal_times: bool = False) -> None:
        self._request = request
        self._nominal_times = nominal_times
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="decode")
        limits = SessionLimits(max_in_flight=1, max_frame_bytes=NO_LIMIT, max_pixels=NO_LIMIT)
        self._session = PerceptionSession(models, limits, self._executor)
        self._uplink: asyncio.Queue[bytes | None] = asyncio.Queue()
        self._downlink = self._session.run(self._requests())

    async def __aenter__(self) -> SessionInProcess:
        self._send(pb.StreamPerceptionRequest(hello=self._request.to_hello()))
        await self._next_message("welcome")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._uplink.put_nowait(None)
        async for _ in self._downlink:
            pass
        self._executor.shutdown(wait=True)

    async def exchange(self, frame: pb.VideoFrame) -> FrameAnswer:
        """Sends one frame and waits for its answer.

        Raises:
            FrameError: the session could not process the frame.
            RemoteError: it closed instead.
        """
        self._send(pb.StreamPerceptionRequest(frame=frame))
        response = await self._next_message("result", "frame_rejected")
        received_ns = time.monotonic_ns()
        size = nominal_size(response) if self._nominal_times else response.ByteSize()
        if response.WhichOneof("payload") == "frame_rejected":
            raise FrameError(response.frame_rejected.message)
        height, width = self._request.height, self._request.width
        return FrameAnswer.from_result(response.result, height, width, receive_time_ns=received_ns, message_bytes=size)

    def _send(self, request: pb.StreamPerceptionRequest) -> None:
        self._uplink.put_nowait(request.SerializeToString())

    async def _requests(self) -> AsyncIterator[pb.StreamPerceptionRequest]:
        while (data := await self._uplink.get()) is not None:
            yield pb.StreamPerceptionRequest.FromString(data)

    async def _next_message(self, *kinds: str) -> pb.StreamPerceptionResponse:
        """The next message of one of the kinds; heartbeats and hints that come before it are passed over."""
        async for sent in self._downlink:
            response = pb.StreamPerceptionResponse.FromString(sent.SerializeToString())
            kind = response.WhichOneof("payload")
            if kind in kinds:
                return response
            if kind == "closing":
                raise RemoteError(f"the session closed: {response.closing.status.message}")
        raise RemoteError("the session ended without an answer")


def nominal_size(response: pb.StreamPerceptionResponse) -> int:
    """Bytes of an answer whose times are replaced by nominal ones."""
    copy = pb.StreamPerceptionResponse()
    copy.CopyFrom(response)
    timing = copy.result.timing
    timing.receive_time_ns = timing.send_time_ns = NOMINAL_STAMP_NS
    timing.decode_wait_ns = timing.decode_ns = NOMINAL_DURATION_NS
    for stage in timing.stages:
        stage.wait_ns = stage.run_ns = NOMINAL_DURATION_NS
        if stage.start_time_ns:
            stage.start_time_ns = NOMINAL_STAMP_NS
    if copy.result.mask.HasField("prefill"):
        copy.result.mask.prefill.measured_ns = copy.result.mask.prefill.whole_ns = NOMINAL_DURATION_NS
    return copy.ByteSize()
