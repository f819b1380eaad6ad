"""The gRPC face of the cloud: a thin servicer over `PerceptionSession`, and the server's life."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, aclosing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import grpc
from google.rpc import code_pb2, status_pb2
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from cable_rpc.cloud.admission import AdmissionControl
from cable_rpc.cloud.authentication import AuthenticationInterceptor, Authenticator, current_identity
from cable_rpc.cloud.frame_trace import StreamTracer
from cable_rpc.cloud.limits import ServerLimits
from cable_rpc.cloud.metrics import ServerMetrics
from cable_rpc.cloud.metrics_endpoint import MetricsEndpoint
from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.cloud.request_bounds import RequestBounds
from cable_rpc.cloud.server_info import clock_sample, server_info
from cable_rpc.cloud.session import PerceptionSession
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.cloud.session_store import SessionStore, StoreLimits
from cable_rpc.cloud.telemetry import NOBODY, Telemetry
from cable_rpc.cloud.tls import RenewingCredentials, TlsFiles
from cable_rpc.cloud.tokens import AccessFile
from cable_rpc.errors import ConfigurationError, Refusal
from cable_rpc.tracing.spans import SpanSink
from cable_rpc.wire.channel import MAX_MESSAGE_BYTES, server_options
from cable_rpc.wire.convert import status_of
from cable_rpc.wire.v1 import perception_pb2 as pb
from cable_rpc.wire.v1 import perception_pb2_grpc as pb_grpc

log = logging.getLogger(__name__)

SERVICE = pb.DESCRIPTOR.services_by_name["PerceptionService"].full_name
SPARE_RPCS = 16
"""Calls beside the streams: clocks, questions about the server, and streams that are told in band that it is full."""

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
    shares: ServerLimits = field(default_factory=ServerLimits)
    """What all clients together, and each of them, may use."""
    resume: StoreLimits = field(default_factory=StoreLimits)
    """How long a session waits for its client to come back."""
    tls: TlsFiles | None = None
    """None = plain text."""
    tokens: Path | None = None
    """File of who may come (`cable_rpc.cloud.tokens`); None = everybody who can connect."""
    write_timeout_s: float = 20.0
    """A client that takes none of its answers for so long is cut off."""
    access_check_s: float = 1.0
    """How often the token file is looked at."""
    alternative_target: str = ""
    """Where clients are sent when this server stops; empty = they come back here."""
    metrics_address: str = ""
    """host:port for Prometheus and HTTP probes; empty = none."""
    spans: SpanSink | None = None
    """Takes the spans of frames that clients trace; None = they are not traced here."""
    reflection: bool = True
    """The contract is told to those who ask for it by gRPC's server reflection."""


class PerceptionService(pb_grpc.PerceptionServiceServicer):
    """cable.v1.PerceptionService."""

    def __init__(self, models: PerceptionModels, config: ServerConfig, telemetry: Telemetry = NOBODY) -> None:
        self._models = models
        self._config = config
        self._telemetry = telemetry
        models.tell_batches(telemetry)
        self._decode_executor = ThreadPoolExecutor(config.decode_threads, thread_name_prefix="decode")
        self._admission = AdmissionControl(config.shares)
        self._store = SessionStore(config.resume, models.forget_stream)
        self._sessions: set[PerceptionSession] = set()
        self._idle = asyncio.Event()
        self._idle.set()

    async def StreamPerception(  # noqa: N802 - the wire name
        self, request_iterator: AsyncIterator[pb.StreamPerceptionRequest], context: Context
    ) -> None:
        """One camera's session."""
        session = PerceptionSession(
            self._models,
            self._config.limits,
            self._decode_executor,
            admission=self._admission,
            identity=current_identity.get(),
            telemetry=self._telemetry,
            store=self._store,
        )
        spans = self._config.spans
        tracer = None if spans is None else StreamTracer(request_iterator, spans)
        self._sessions.add(session)
        self._idle.clear()
        try:
            async with aclosing(session.run(tracer or request_iterator)) as responses:
                async for response in responses:
                    handed_over_ns = time.monotonic_ns()
                    async with asyncio.timeout(self._config.write_timeout_s):
                        await context.write(response)
                    if tracer is not None:
                        tracer.written(response, session.session_id, handed_over_ns)
        except TimeoutError:
            log.warning("session %s: the client takes no answers", session.session_id)
            await context.abort(grpc.StatusCode.DEADLINE_EXCEEDED, "answers were not taken in time")
        finally:
            self._sessions.discard(session)
            if not self._sessions:
                self._idle.set()

    async def GetServerInfo(  # noqa: N802
        self, request: pb.GetServerInfoRequest, context: Context
    ) -> pb.GetServerInfoResponse:
        """What this server is."""
        return server_info(self._models, self._config.limits)

    async def SyncClock(  # noqa: N802
        self, request: pb.SyncClockRequest, context: Context
    ) -> pb.SyncClockResponse:
        """One clock sample."""
        return clock_sample(request)

    def send_away_unknown(self, authenticator: Authenticator) -> None:
        """Ends the sessions of those who may no longer come."""
        for session in list(self._sessions):
            if not authenticator.still_known(session.identity):
                log.warning("session %s: %s has been taken off the list", session.session_id, session.identity.name)
                status = status_pb2.Status(
                    code=code_pb2.UNAUTHENTICATED, message="the token is not known here any more"
                )
                session.drain(status, pb.CLOSE_ACTION_STOP)
        self._store.keep_only(authenticator.still_known)

    async def drain(self) -> None:
        """Sends every client away, lets no new one in, and waits, bounded, until they have gone."""
        going = Refusal("the server is shutting down", self._config.drain_s)
        self._admission.close(going)
        elsewhere = self._config.alternative_target
        action = pb.CLOSE_ACTION_MOVE if elsewhere else pb.CLOSE_ACTION_RESUME
        for session in list(self._sessions):
            session.drain(status_of(going), action, elsewhere)
        try:
            async with asyncio.timeout(self._config.drain_s):
                await self._idle.wait()
        except TimeoutError:
            log.warning("%d sessions did not end in time", len(self._sessions))

    async def close(self) -> None:
        """Frees the sessions that wait for their clients, and the decoder threads."""
        await self._store.close()
        self._decode_executor.shutdown(wait=False, cancel_futures=True)


class PerceptionServer:
    """A listening server; `async with PerceptionServer(models, config) as server: ...`.

    Raises:
        ConfigurationError: a certificate, a key or the token file can't be used.
    """

    def __init__(self, models: PerceptionModels, config: ServerConfig, telemetry: Telemetry = NOBODY) -> None:
        self._config = config
        self._telemetry = telemetry
        self._credentials = None if config.tls is None else RenewingCredentials(config.tls).credentials()
        self._access = None if config.tokens is None else AccessFile(config.tokens)
        self._authenticator = Authenticator(self._access)
        self._service = PerceptionService(models, config, telemetry)
        self._health = health.aio.HealthServicer()
        self._server: grpc.aio.Server | None = None
        self._watch: asyncio.Task[None] | None = None
        self.port = 0
        self.is_serving = False

    async def __aenter__(self) -> PerceptionServer:
        """Starts listening.

        Raises:
            ConfigurationError: if the address can't be bound.
        """
        self._server = grpc.aio.server(
            interceptors=[AuthenticationInterceptor(self._authenticator, self._telemetry), RequestBounds()],
            options=server_options(self._config.max_message_bytes),
            maximum_concurrent_rpcs=self._config.shares.streams + SPARE_RPCS,
            compression=grpc.Compression.NoCompression,
        )
        pb_grpc.add_PerceptionServiceServicer_to_server(self._service, self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        if self._config.reflection:
            reflection.enable_server_reflection((SERVICE, health.SERVICE_NAME, reflection.SERVICE_NAME), self._server)
        try:
            if self._credentials is None:
                self.port = self._server.add_insecure_port(self._config.address)
            else:
                self.port = self._server.add_secure_port(self._config.address, self._credentials)
        except RuntimeError as error:
            raise ConfigurationError(
                f"can't listen on {self._config.address}: the port is taken or the address is not this "
                "machine's; choose another with --listen"
            ) from error
        await self._server.start()
        for name in ("", SERVICE):
            await self._health.set(name, health_pb2.HealthCheckResponse.SERVING)
        self.is_serving = True
        if self._access is not None:
            self._watch = asyncio.create_task(self._watch_access(self._access))
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        """Answers what is in flight, sends clients away, stops."""
        if self._watch is not None:
            self._watch.cancel()
        self.is_serving = False
        await self._health.enter_graceful_shutdown()
        await self._service.drain()
        if self._server is not None:
            await self._server.stop(grace=0.5)
        await self._service.close()

    async def _watch_access(self, access: AccessFile) -> None:
        while True:
            await asyncio.sleep(self._config.access_check_s)
            if access.refresh():
                self._service.send_away_unknown(self._authenticator)


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
    metrics = ServerMetrics() if config.metrics_address else None
    server = PerceptionServer(models, config, metrics or NOBODY)
    with ExitStack() as stack:
        # Metrics outlive the drain: what happens in it is counted too.
        if metrics is not None:
            endpoint = MetricsEndpoint(config.metrics_address, metrics.registry, lambda: server.is_serving)
            stack.enter_context(endpoint)
        async with server:
            announce(f"listening on {config.address.rpartition(':')[0]}:{server.port}")
            for model in (models.detector, models.segmenter):
                announce(f"  {model.name}  revision {model.revision}  on {model.device}")
            if metrics is not None:
                announce(f"  metrics on http://{config.metrics_address.rpartition(':')[0]}:{endpoint.port}/metrics")
            await stopped.wait()
            announce("stopping: answering what is in flight")
