"""What a server tells those who look after it, asked for as they ask for it."""

from __future__ import annotations

import asyncio
import hashlib
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from prometheus_client.parser import text_string_to_metric_families

from cable_rpc.cloud.metrics import ServerMetrics
from cable_rpc.cloud.metrics_endpoint import MetricsEndpoint
from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.cloud.service import SERVICE, PerceptionServer, ServerConfig
from cable_rpc.errors import ConfigurationError
from cable_rpc.wire.v1 import perception_pb2 as pb

from .conftest import BrightBoxDetector
from .secure_server import serving
from .test_protocol import coded, frame, opened, read

Samples = Mapping[tuple[str, tuple[tuple[str, str], ...]], float]


def scraped(url: str) -> Samples:
    with urllib.request.urlopen(url, timeout=5) as response:
        text = response.read().decode()
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def value(samples: Samples, name: str, **labels: str) -> float:
    return samples[name, tuple(sorted(labels.items()))]


@pytest.fixture
def tokens(tmp_path: Path) -> Path:
    path = tmp_path / "tokens"
    path.write_text(f"car-7 {hashlib.sha256(b'secret').hexdigest()}\n")
    path.chmod(0o600)
    return path


async def health_of(target: str, service: str = SERVICE) -> str:
    async with grpc.aio.insecure_channel(target) as channel:
        stub: Any = health_pb2_grpc.HealthStub(channel)
        answer = await stub.Check(health_pb2.HealthCheckRequest(service=service))
    return health_pb2.HealthCheckResponse.ServingStatus.Name(answer.status)


async def test_health_follows_the_life_of_the_server_and_needs_no_token(tokens: Path) -> None:
    async with serving(tokens=tokens, drain_s=2.0) as server:
        target = f"127.0.0.1:{server.port}"
        assert [await health_of(target, name) for name in ("", SERVICE)] == ["SERVING", "SERVING"]
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await health_of(target, "another.Service")
        assert caught.value.code() == grpc.StatusCode.NOT_FOUND


async def test_a_draining_server_says_so_while_it_still_answers(stub_for: Any) -> None:
    models = PerceptionModels.in_process(BrightBoxDetector(), BoxSegmenter())
    server = PerceptionServer(models, ServerConfig("127.0.0.1:0", drain_s=5.0))
    await server.__aenter__()
    target = f"127.0.0.1:{server.port}"
    async with stub_for(target) as stub, grpc.aio.insecure_channel(target) as channel:
        health: Any = health_pb2_grpc.HealthStub(channel)
        watch = health.Watch(health_pb2.HealthCheckRequest(service=SERVICE))
        assert (await watch.read()).status == health_pb2.HealthCheckResponse.SERVING
        call = await opened(stub)
        stopping = asyncio.create_task(server.__aexit__(None, None, None))
        assert (await watch.read()).status == health_pb2.HealthCheckResponse.NOT_SERVING
        assert (await read(call)).WhichOneof("payload") == "closing"
        await call.done_writing()
        watch.cancel()
        await stopping
    models.close()


async def test_reflection_lists_the_contract_where_it_is_on() -> None:
    for on in (True, False):
        async with serving(reflection=on) as server, grpc.aio.insecure_channel(f"127.0.0.1:{server.port}") as channel:
            stub: Any = reflection_pb2_grpc.ServerReflectionStub(channel)
            call = stub.ServerReflectionInfo(iter([reflection_pb2.ServerReflectionRequest(list_services="")]))
            if on:
                names = {service.name for service in (await call.read()).list_services_response.service}
                assert {SERVICE, "grpc.health.v1.Health"} <= names
            else:
                with pytest.raises(grpc.aio.AioRpcError, match="UNIMPLEMENTED"):
                    await call.read()


async def test_reflection_is_behind_the_token(tokens: Path) -> None:
    async with (
        serving(tokens=tokens) as server,
        grpc.aio.insecure_channel(f"127.0.0.1:{server.port}") as channel,
    ):
        stub: Any = reflection_pb2_grpc.ServerReflectionStub(channel)
        call = stub.ServerReflectionInfo(iter([reflection_pb2.ServerReflectionRequest(list_services="")]))
        with pytest.raises(grpc.aio.AioRpcError, match="UNAUTHENTICATED"):
            await call.read()


async def test_metrics_are_what_a_client_counted(stub_for: Any) -> None:
    metrics = ServerMetrics()
    models = PerceptionModels.in_process(BrightBoxDetector(), BoxSegmenter())
    with MetricsEndpoint("127.0.0.1:0", metrics.registry, lambda: True) as endpoint:
        url = f"http://127.0.0.1:{endpoint.port}/metrics"
        async with (
            PerceptionServer(models, ServerConfig("127.0.0.1:0", drain_s=1.0), metrics) as server,
            stub_for(f"127.0.0.1:{server.port}") as stub,
        ):
            call = await opened(stub)
            assert value(await asyncio.to_thread(scraped, url), "cable_streams") == 1
            sent, answers = [], []
            for sequence, packet in enumerate(coded("jpeg", 4)):
                message = frame(sequence, packet, region=None if sequence else pb.Region(block_size=8))
                sent.append(message.frame)
                await call.write(message)
                answers.append(await read(call))
            call.cancel()
            while value(await asyncio.to_thread(scraped, url), "cable_streams"):
                await asyncio.sleep(0.01)
            samples = await asyncio.to_thread(scraped, url)
    models.close()
    results = [answer.result for answer in answers if answer.WhichOneof("payload") == "result"]
    assert len(results) == 3
    assert value(samples, "cable_frames_received_total") == 4
    assert value(samples, "cable_frames_total", outcome="result") == 3
    assert value(samples, "cable_frames_total", outcome="invalid_region") == 1
    assert value(samples, "cable_sessions_total", kind="new") == 1
    assert value(samples, "cable_uplink_bytes_total", layer="video") == sum(len(one.data) for one in sent)
    uplink = sum(value(samples, "cable_uplink_bytes_total", layer=layer) for layer in ("video", "region", "rest"))
    assert uplink == sum(one.ByteSize() for one in sent)
    masks = sum(len(one.mask.data) + len(one.mask.uncertainty) for one in results)
    assert value(samples, "cable_downlink_bytes_total", layer="mask") == masks
    for stage in ("decode", "detect", "segment", "server"):
        assert value(samples, "cable_stage_seconds_count", stage=stage) == 3
    decoded_s = sum(one.timing.decode_ns for one in results) / 1e9
    assert value(samples, "cable_stage_seconds_sum", stage="decode") == pytest.approx(decoded_s)
    assert value(samples, "cable_batch_frames_sum", model="detect") == 3
    assert value(samples, "cable_memory_bytes", kind="resident") > 10e6


async def test_metrics_tell_of_those_who_were_turned_away(tokens: Path, stub_for: Any) -> None:
    metrics = ServerMetrics()
    models = PerceptionModels.in_process(BrightBoxDetector(), BoxSegmenter())
    async with (
        PerceptionServer(models, ServerConfig("127.0.0.1:0", tokens=tokens, drain_s=1.0), metrics) as server,
        stub_for(f"127.0.0.1:{server.port}") as stub,
    ):
        for _ in range(2):
            with pytest.raises(grpc.aio.AioRpcError):
                await stub.GetServerInfo(pb.GetServerInfoRequest())
    models.close()
    assert metrics.registry.get_sample_value("cable_authentication_failures_total") == 2


def test_http_probes_tell_serving_from_leaving() -> None:
    serving_now = [True]
    with MetricsEndpoint("127.0.0.1:0", ServerMetrics().registry, lambda: serving_now[0]) as endpoint:
        url = f"http://127.0.0.1:{endpoint.port}"
        with urllib.request.urlopen(f"{url}/healthz", timeout=5) as response:
            assert response.status == 200
        serving_now[0] = False
        with pytest.raises(urllib.error.HTTPError, match="503"):
            urllib.request.urlopen(f"{url}/healthz", timeout=5)
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{url}/secrets", timeout=5)


@pytest.mark.parametrize("address", ["nowhere", "127.0.0.1:http", "127.0.0.1:99999"])
def test_an_unusable_metrics_address_is_told(address: str) -> None:
    with pytest.raises(ConfigurationError, match="no HOST:PORT"):
        MetricsEndpoint(address, ServerMetrics().registry, lambda: True)


def test_a_taken_metrics_port_is_told() -> None:
    registry = ServerMetrics().registry
    with (
        MetricsEndpoint("127.0.0.1:0", registry, lambda: True) as endpoint,
        pytest.raises(ConfigurationError, match="can't serve metrics on"),
    ):
        MetricsEndpoint(f"127.0.0.1:{endpoint.port}", registry, lambda: True)


def test_hostile_numbers_do_not_break_the_counting() -> None:
    metrics = ServerMetrics()
    metrics.response_sent(
        pb.StreamPerceptionResponse(
            result=pb.Result(timing=pb.ServerTiming(receive_time_ns=time.monotonic_ns(), send_time_ns=0))
        )
    )
    assert metrics.registry.get_sample_value("cable_frames_total", {"outcome": "result"}) == 1
