"""Sessions in Ray Serve replicas: a real cluster on this machine, real streams, a replica killed under load."""

from __future__ import annotations

import asyncio
import hashlib
import os
import signal
import socket
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cable_codecs import CodecParameters, create_encoder

from cable_rpc.cloud.cluster.settings import ClusterSettings, ReplicaSettings
from cable_rpc.cloud.model_settings import ModelSettings
from cable_rpc.cloud.service import PerceptionServer, ServerConfig
from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.edge.channel import ClientSecurity
from cable_rpc.edge.client import PerceptionClient, SessionRequest
from cable_rpc.edge.resuming_client import ResumingClient
from cable_rpc.errors import ConnectionLost, RemoteError
from cable_rpc.wire.answers import FrameAnswer
from cable_rpc.wire.v1 import perception_pb2 as pb

ray = pytest.importorskip("ray", reason="needs the ray extra: pip install 'cable-rpc[cloud,ray]'")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

WIDTH, HEIGHT = 320, 192
MODELS = ModelSettings(segmenter="boxes")
APPLICATION = "cable-rpc"
REPLICA = "ServeReplica:cable-rpc:PerceptionIngress"


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.fixture(scope="module")
def target() -> Iterator[str]:
    """HOST:PORT of a cluster without an application."""
    from ray import serve
    from ray.serve.config import gRPCOptions

    from cable_rpc.cloud.cluster.application import SERVICER

    port = free_port()
    ray.init(
        num_cpus=6, object_store_memory=100 << 20, include_dashboard=False, log_to_driver=False, logging_level="warning"
    )
    serve.start(
        grpc_options=gRPCOptions(port=port, grpc_servicer_functions=[SERVICER]),
        http_options={"host": "127.0.0.1", "port": free_port()},
    )
    yield f"127.0.0.1:{port}"
    serve.shutdown()
    ray.shutdown()


def deploy(settings: ClusterSettings) -> None:
    """Puts the application in place of the one that is there."""
    from ray import serve

    from cable_rpc.cloud.cluster.application import application

    serve.run(application(settings), name=APPLICATION, route_prefix="/cable-rpc")


def replica_pids() -> list[int]:
    """Processes of the ingress replicas, as they name themselves."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                title = (folder / "cmdline").read_bytes().decode(errors="replace")
            except OSError:
                continue
            if REPLICA in title:
                found.append(int(folder.name))
    return found


def pictures(count: int) -> list[bytes]:
    source = SyntheticSource(SyntheticConfig(seed=4, width=WIDTH, height=HEIGHT, frame_count=count))
    with create_encoder(CodecParameters("jpeg", WIDTH, HEIGHT)) as encoder:
        return [encoder.encode(frame.image).data for frame in source]


def request() -> SessionRequest:
    return SessionRequest("jpeg", WIDTH, HEIGHT, 10.0)


async def answers_of(target: str, packets: list[bytes], **settings: Any) -> list[FrameAnswer]:
    """One frame after the other."""
    answers = []
    async with PerceptionClient(target, request(), connect_timeout_s=30.0, **settings) as client:
        stream = client.answers()
        for sequence, data in enumerate(packets):
            await client.acquire_credit()
            await client.send(pb.VideoFrame(sequence=sequence, data=data, keyframe=True))
            answers.append(await anext(stream))
            client.release_credit()
    return answers


@asynccontextmanager
async def in_process() -> AsyncIterator[str]:
    models = MODELS.load()
    async with PerceptionServer(models, ServerConfig("127.0.0.1:0", drain_s=1.0)) as server:
        yield f"127.0.0.1:{server.port}"
    models.close()


def assert_alike(ours: list[FrameAnswer], theirs: list[FrameAnswer]) -> None:
    assert [one.rejection for one in theirs] == [None] * len(ours)
    assert sum(len(one.detections) for one in ours) > 0
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(other.detections.boxes_xyxy, one.detections.boxes_xyxy, atol=0.01)
        assert other.mask_data == one.mask_data


@pytest.mark.parametrize("own_deployment", [False, True])
async def test_answers_are_those_of_a_server_of_its_own(target: str, own_deployment: bool) -> None:
    own = ReplicaSettings(cpus=0.5) if own_deployment else None
    deploy(ClusterSettings(MODELS, ReplicaSettings(cpus=0.5), detector=own, segmenter=own))
    packets = pictures(5)
    async with in_process() as ours:
        expected = await answers_of(ours, packets)
    assert_alike(expected, await answers_of(target, packets))
    many = await asyncio.gather(*(answers_of(target, packets) for _ in range(4)))
    for one in many:
        assert_alike(expected, one)


async def test_a_token_is_wanted_where_there_is_a_list(target: str, tmp_path: Path) -> None:
    tokens = tmp_path / "tokens"
    tokens.write_text(f"car-7 {hashlib.sha256(b'good').hexdigest()}\n")
    tokens.chmod(0o600)
    deploy(ClusterSettings(MODELS, ReplicaSettings(cpus=0.5), tokens=str(tokens)))
    packets = pictures(1)
    for security in (ClientSecurity(), ClientSecurity(token="bad")):  # noqa: S106
        with pytest.raises(RemoteError, match=r"does not let us in|UNAUTHENTICATED"):
            await answers_of(target, packets, security=security)
    assert len(await answers_of(target, packets, security=ClientSecurity(token="good"))) == 1  # noqa: S106


@pytest.mark.parametrize("replicas", [2, 1])
async def test_a_killed_replica_costs_its_clients_a_pause(
    target: str, replicas: int, record_property: pytest.RecordProperty
) -> None:
    """With a spare replica the way back is one reconnect; with one it waits for Ray to start another."""
    deploy(ClusterSettings(MODELS, ReplicaSettings(replicas, cpus=0.5)))
    packets = pictures(4)
    until_s = time.monotonic() + 25.0
    killed_s = asyncio.get_running_loop().create_future()

    async def stream() -> tuple[int, int, float]:
        """Answered, lost, and the longest time without an answer after the kill."""
        answered = lost = sent = 0
        last_s, pause_s = time.monotonic(), 0.0
        client = ResumingClient(target, request(), connect_timeout_s=8.0, reconnect_s=60.0, report=lambda line: None)
        async with client:

            async def send() -> None:
                nonlocal sent
                while time.monotonic() < until_s:
                    await client.acquire_credit()
                    message = pb.VideoFrame(sequence=sent, data=packets[sent % len(packets)], keyframe=True)
                    with suppress(ConnectionLost):  # between the credit and here
                        await client.send(message)
                        sent += 1
                    await asyncio.sleep(0.1)
                await client.finish()

            sender = asyncio.create_task(send())
            async for answer in client.answers():
                if answer.is_lost:
                    lost += 1
                    continue
                answered += 1
                if killed_s.done():
                    pause_s = max(pause_s, time.monotonic() - max(last_s, killed_s.result()))
                last_s = time.monotonic()
                client.release_credit()
            await sender
        assert answered + lost == sent
        return answered, lost, pause_s

    async def kill_one() -> None:
        await asyncio.sleep(6.0)
        pids = replica_pids()
        assert len(pids) == replicas
        os.kill(pids[0], signal.SIGKILL)
        killed_s.set_result(time.monotonic())

    *streams, _ = await asyncio.gather(*(stream() for _ in range(4)), kill_one())
    assert all(answered > 20 for answered, _, _ in streams)
    assert all(lost <= 2 for _, lost, _ in streams)
    pauses = sorted(pause_s for _, _, pause_s in streams)
    record_property("longest pauses, s", pauses)
    print(f"{replicas} replicas: longest pause of each stream, s: {', '.join(f'{one:.2f}' for one in pauses)}")
