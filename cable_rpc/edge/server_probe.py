"""Asking a server who it is, without opening a session."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from typing import Any

import grpc

from cable_rpc.edge.channel import SecureTarget
from cable_rpc.edge.transport_errors import connection_error
from cable_rpc.errors import RemoteError
from cable_rpc.wire.convert import CODEC_NAMES
from cable_rpc.wire.v1 import perception_pb2 as pb
from cable_rpc.wire.v1 import perception_pb2_grpc as pb_grpc

ROUND_TRIPS = 5

HEALTH_CHECK = "/grpc.health.v1.Health/Check"
HEALTH_ANSWERS = {b"\x08\x01": "serving", b"\x08\x02": "not serving"}
"""HealthCheckResponse as serialised; its stubs come with the cloud extra, which an edge box does not have."""


@dataclass(frozen=True, slots=True)
class ServerReport:
    """What a server says of itself."""

    address: str
    tls: bool
    version: str
    models: tuple[str, ...]
    codecs: tuple[str, ...]
    max_in_flight: int
    max_frame_bytes: int
    max_pixels: int
    round_trip_ms: float
    """Shortest of five small calls."""
    health: str
    """ "serving", "not serving" from the first moment of a drain, "unknown" where the server does not tell."""


async def ask_server(way: SecureTarget, timeout_s: float) -> ServerReport:
    """Asks a server.

    Raises:
        RemoteError: it can't be reached, or does not let us in.
    """
    async with way.open_channel() as channel:
        # Generated stubs carry no annotations.
        make_stub: Any = pb_grpc.PerceptionServiceStub
        stub = make_stub(channel)
        try:
            async with asyncio.timeout(timeout_s):
                await way.wait_until_ready(channel)
                info = await stub.GetServerInfo(pb.GetServerInfoRequest(), metadata=way.metadata)
                health = await health_of(channel)
                trips_ns = [await round_trip_ns(stub, way) for _ in range(ROUND_TRIPS)]
        except TimeoutError:
            raise RemoteError(f"no answer from {way.address} within {timeout_s:g} s") from None
        except grpc.aio.AioRpcError as error:
            raise connection_error(way.address, error) from error
    return ServerReport(
        way.address,
        way.tls,
        info.server_version,
        tuple(model.name for model in info.models),
        tuple(CODEC_NAMES[codec] for codec in info.codecs if codec in CODEC_NAMES),
        info.flow.max_in_flight,
        info.flow.max_frame_bytes,
        info.max_pixels,
        min(trips_ns) / 1e6,
        health,
    )


async def health_of(channel: grpc.aio.Channel) -> str:
    """What gRPC's standard health service says of the whole server."""
    check: Any = channel.unary_unary(HEALTH_CHECK)
    try:
        return HEALTH_ANSWERS.get(await check(b""), "unknown")
    except grpc.aio.AioRpcError as error:
        if error.code() in {grpc.StatusCode.UNIMPLEMENTED, grpc.StatusCode.NOT_FOUND}:
            return "unknown"
        raise


async def round_trip_ns(stub: Any, way: SecureTarget) -> int:
    """Duration of one small call."""
    started_ns = time.monotonic_ns()
    await stub.SyncClock(pb.SyncClockRequest(client_send_time_ns=started_ns), metadata=way.metadata)
    return time.monotonic_ns() - started_ns
