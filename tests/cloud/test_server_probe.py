"""`doctor --server`: the health that it shows is that of the standard service."""

from __future__ import annotations

import asyncio

import grpc
import pytest
from grpc_health.v1 import health_pb2

from cable_rpc.cli.server_report import report_lines
from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.cloud.service import PerceptionServer, ServerConfig
from cable_rpc.edge.channel import PLAIN, SecureTarget
from cable_rpc.edge.server_probe import HEALTH_ANSWERS, ask_server, health_of

from .conftest import BrightBoxDetector
from .secure_server import client


def test_answers_are_those_of_the_contract() -> None:
    for data, said in HEALTH_ANSWERS.items():
        status = health_pb2.HealthCheckResponse.FromString(data).status
        assert health_pb2.HealthCheckResponse.ServingStatus.Name(status) == said.replace(" ", "_").upper()


async def test_a_server_that_leaves_is_shown_to() -> None:
    models = PerceptionModels.in_process(BrightBoxDetector(), BoxSegmenter())
    server = PerceptionServer(models, ServerConfig("127.0.0.1:0", drain_s=5.0))
    await server.__aenter__()
    way = SecureTarget(f"127.0.0.1:{server.port}", PLAIN)
    async with client(way.address) as session:
        assert (await ask_server(way, 5)).health == "serving"
        stopping = asyncio.create_task(server.__aexit__(None, None, None))
        async with asyncio.timeout(10):
            while (report := await ask_server(way, 5)).health == "serving":
                await asyncio.sleep(0.01)
        assert "  health   not serving" in report_lines(report)
        await session.finish()
    await stopping
    models.close()


async def test_a_server_without_the_health_service_is_asked_all_the_same() -> None:
    server = grpc.aio.server()
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        assert await health_of(channel) == "unknown"
    await server.stop(None)


async def test_nobody_there_is_not_unknown_health(unused_tcp_port: int) -> None:
    async with grpc.aio.insecure_channel(f"127.0.0.1:{unused_tcp_port}") as channel:
        with pytest.raises(grpc.aio.AioRpcError):
            await health_of(channel)
