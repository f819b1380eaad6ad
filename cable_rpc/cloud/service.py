"""The gRPC face of the cloud: a thin servicer over `PerceptionSession`, and the server's life."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import grpc
from cable_codecs import available_codecs
from google.rpc import code_pb2, status_pb2

import cable_rpc
from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.cloud.session import PerceptionSession, SessionLimits, model_infos
from cable_rpc.errors import ConfigurationError
from cable_rpc.wire.channel import MAX_MESSAGE_BYTES, server_options
from cable_rpc.wire.convert import CODEC_NAMES, PROTOCOL_REVISION
from cable_rpc.wire.v1 import perception_pb2 as pb
from cable_rpc.wire.v1 import perception_pb2_grpc as pb_grpc

log = logging.getLogger(__name__)

Context = grpc.aio.ServicerContext[Any, Any]


@dataclass(frozen=True, slots=True)
class ServerConfig:
    """How a server listens and what it grants."""

    address: str = "127.0.0.1:50051"
    """host:port; port 0 picks a free one."""
    limits: SessionLimits = field(default_factory=SessionLimits)
    max_message_bytes: int = MAX_MESSAGE_BYTES
    decode_threads: int = max(1, (os.cpu_count() or 2) // 2)
    drain_s: float = 5.0


class PerceptionService(pb_grpc.PerceptionServiceServicer):
    """cable.v1.PerceptionService."""

    def __init__(self, models: PerceptionModels, config: ServerConfig) -> None:
        self._models = models
        self._config = config
        self._decode_executor = ThreadPoolExecutor(config.decode_threads, thread_name_prefix="decode")
        self._sessions: set[PerceptionSession] = set()
        self._idle = asyncio.Event()
        self._idle.set()

    async def StreamPerception(  # noqa: N802 - the wire name
        self, request_iterator: AsyncIterator[pb.StreamPerceptionRequest], context: Context
    ) -> AsyncIterator[pb.StreamPerceptionResponse]:
        """One camera's session."""
        session = PerceptionSession(self._models, self._config.limits, self._decode_executor)
        self._sessions.add(session)
        self._idle.clear()
        try:
            async for response in session.run(request_iterator):
                yield response
        finally:
            self._sessions.discard(session)
            if not self._sessions:
                self._idle.set()

    async def GetServerInfo(  # noqa: N802
        self, request: pb.GetServerInfoRequest, context: Context
    ) -> pb.GetServerInfoResponse:
        """What this server is."""
        return pb.GetServerInfoResponse(
            protocol_revision=PROTOCOL_REVISION,
            server_version=f"cable-rpc/{cable_rpc.__version__}",
            codecs=[number for number, name in CODEC_NAMES.items() if name in available_codecs()],
            models=model_infos(self._models),
            flow=self._config.limits.flow(),
            max_pixels=self._config.limits.max_pixels,
        )

    async def SyncClock(  # noqa: N802
        self, request: pb.SyncClockRequest, context: Context
    ) -> pb.SyncClockResponse:
        """One clock sample."""
        received_ns = time.monotonic_ns()
        return pb.SyncClockResponse(
            client_send_time_ns=request.client_send_time_ns,
            server_receive_time_ns=received_ns,
            server_send_time_ns=time.monotonic_ns(),
        )

    async def drain(self) -> None:
        """Sends every client away and waits, bounded, until they have gone."""
        status = status_pb2.Status(code=code_pb2.UNAVAILABLE, message="the server is shutting down")
        for session in list(self._sessions):
            session.drain(status, pb.CLOSE_ACTION_RESUME)
        try:
            async with asyncio.timeout(self._config.drain_s):
                await self._idle.wait()
        except TimeoutError:
            log.warning("%d sessions did not end in time", len(self._sessions))

    def close(self) -> None:
        """Frees the decoder threads."""
        self._decode_executor.shutdown(wait=False, cancel_futures=True)


class PerceptionServer:
    """A listening server; `async with PerceptionServer(models, config) as server: ...`."""

    def __init__(self, models: PerceptionModels, config: ServerConfig) -> None:
        self._config = config
        self._service = PerceptionService(models, config)
        self._server: grpc.aio.Server | None = None
        self.port = 0

    async def __aenter__(self) -> PerceptionServer:
        """Starts listening.

        Raises:
            ConfigurationError: if the address can't be bound.
        """
        self._server = grpc.aio.server(
            options=server_options(self._config.max_message_bytes), compression=grpc.Compression.NoCompression
        )
        pb_grpc.add_PerceptionServiceServicer_to_server(self._service, self._server)
        try:
            self.port = self._server.add_insecure_port(self._config.address)
        except RuntimeError as error:
            raise ConfigurationError(
                f"can't listen on {self._config.address}: the port is taken or the address is not this "
                "machine's; choose another with --listen"
            ) from error
        await self._server.start()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        """Answers what is in flight, sends clients away, stops."""
        await self._service.drain()
        if self._server is not None:
            await self._server.stop(grace=0.5)
        self._service.close()


async def serve_until_signal(models: PerceptionModels, config: ServerConfig, announce: Callable[[str], None]) -> None:
    """Serves until SIGINT or SIGTERM, then drains.

    Args:
        models: what answers.
        config: address and limits.
        announce: is told, line by line, where the server listens, what it hosts and when it stops.
    """
    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)
    async with PerceptionServer(models, config) as server:
        announce(f"listening on {config.address.rpartition(':')[0]}:{server.port}")
        for model in (models.detector, models.segmenter):
            announce(f"  {model.name}  revision {model.revision}  on {model.device}")
        await stopped.wait()
        announce("stopping: answering what is in flight")
