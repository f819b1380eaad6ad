"""The ends that `overhead.py` measures, each for a process of its own: servers, and clients that load them."""

from __future__ import annotations

import asyncio
import cProfile
import pstats
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import grpc
import numpy as np
from cable_codecs import CodecParameters, create_encoder

from cable_rpc.cloud.backends import FrameContext, SegmentationRequest
from cable_rpc.cloud.model_settings import ModelSettings
from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.cloud.service import PerceptionServer, ServerConfig
from cable_rpc.edge.client import PerceptionClient, SessionRequest
from cable_rpc.types import BoolMask, Detections, Image, Segmentation
from cable_rpc.wire.channel import client_options, server_options
from cable_rpc.wire.v1 import perception_pb2 as pb
from cable_rpc.wire.v1 import perception_pb2_grpc as pb_grpc

WIDTH, HEIGHT = 96, 64
ECHO = "/bench.Echo/Stream"
MOST_IN_A_BATCH = 8
WARM_UP_S = 0.5
HOT_LINES = 40


@dataclass(frozen=True, slots=True)
class Load:
    """What one generator does."""

    client: str
    """"echo", "stub" (generated stub, nothing of ours) or "client" (`PerceptionClient`)."""
    target: str
    streams: int
    seconds: float
    frame_bytes: int


@dataclass(frozen=True, slots=True)
class LoadResult:
    """What one generator saw after its warm-up."""

    latencies_ms: np.ndarray
    """float64 [N]: from a frame at hand to its answer at hand."""
    frames_per_s: float


def padded_jpeg(size: int) -> bytes:
    """A small picture with an application segment that makes it ``size`` bytes, at most 65 000.

    Carrying it costs what carrying any frame of that size costs, decoding it next to nothing. Comments would not do:
    FFmpeg reads them byte by byte.
    """
    with create_encoder(CodecParameters("jpeg", WIDTH, HEIGHT)) as encoder:
        plain = encoder.encode(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)).data
    length = size - len(plain) - 2
    return plain[:2] + b"\xff\xef" + length.to_bytes(2, "big") + bytes(length - 2) + plain[2:]


class NullDetector:
    """Finds nothing, at once."""

    name = "null"
    revision = "1"
    device = "cpu"

    def detect(self, images: Sequence[Image]) -> list[Detections]:
        return [Detections.empty() for _ in images]


class NullSegmenter:
    """An empty mask, at once."""

    name = "null"
    revision = "1"
    device = "cpu"

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        return Segmentation(np.zeros(image.shape[:2], np.bool_), 1.0)

    def segment_batch(self, requests: Sequence[SegmentationRequest]) -> list[Segmentation]:
        return [self.segment(asked.image, asked.roi, asked.prompt, asked.context) for asked in requests]


# -- servers --------------------------------------------------------------------------------------------------------


def serve_null_models(announce: Connection, at_once: bool, profile_to: Path | None) -> None:
    """Our server with models that cost nothing, until the other end of ``announce`` says so.

    Args:
        announce: is told the port.
        at_once: True as `cable-rpc serve` does with models that are done sooner than a thread can be told; False hands
            them over to their threads, as it does with all others.
        profile_to: where the event loop's hot functions are written.
    """
    asyncio.run(_profiled(_serve_null_models(announce, at_once), profile_to))


async def _serve_null_models(announce: Connection, at_once: bool) -> None:
    policy = ModelSettings(detector_batch=MOST_IN_A_BATCH).detector_policy("cpu")
    if not at_once:
        policy = replace(policy, at_once_s=0.0)
    models = PerceptionModels.in_process(NullDetector(), NullSegmenter(), policy, policy)
    async with PerceptionServer(models, ServerConfig("127.0.0.1:0", drain_s=1.0)) as server:
        announce.send(server.port)
        await asyncio.to_thread(announce.recv)
    models.close()


def serve_echo(announce: Connection, answer_bytes: int) -> None:
    """A server that answers each message with as many bytes as ours does, and does nothing else."""
    asyncio.run(_serve_echo(announce, answer_bytes))


async def _serve_echo(announce: Connection, answer_bytes: int) -> None:
    answer = bytes(answer_bytes)

    async def echo(requests: AsyncIterator[bytes], context: Any) -> None:
        async for _ in requests:
            await context.write(answer)

    handler = grpc.stream_stream_rpc_method_handler(echo)
    server = grpc.aio.server(options=server_options(), compression=grpc.Compression.NoCompression)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("bench.Echo", {"Stream": handler}),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    announce.send(port)
    await asyncio.to_thread(announce.recv)
    await server.stop(0.2)


async def _profiled(work: Awaitable[None], profile_to: Path | None) -> None:
    if profile_to is None:
        return await work
    # cProfile sees the thread it is enabled in: the event loop's, which is the one that everybody waits for.
    profiler = cProfile.Profile()
    profiler.enable()
    await work
    profiler.disable()
    with profile_to.open("w") as text:
        for order in ("tottime", "cumulative"):
            pstats.Stats(profiler, stream=text).sort_stats(order).print_stats(HOT_LINES)
    return None


# -- clients --------------------------------------------------------------------------------------------------------

Ledger = list[tuple[float, float]]
"""When each frame was at hand, and when its answer."""


def generate(load: Load, report: Connection) -> None:
    """Loads a server and reports a `LoadResult`."""
    report.send(asyncio.run(_generate(load)))


async def _generate(load: Load) -> LoadResult:
    stream = {"echo": _echo_stream, "stub": _stub_stream, "client": _client_stream}[load.client]
    data = padded_jpeg(load.frame_bytes)
    stop_s = time.monotonic() + WARM_UP_S + load.seconds
    ledgers = await asyncio.gather(*(stream(load, data, stop_s) for _ in range(load.streams)))
    counted_from_s = stop_s - load.seconds
    latencies = [(end - start) * 1e3 for ledger in ledgers for start, end in ledger if end >= counted_from_s]
    return LoadResult(np.array(latencies), len(latencies) / load.seconds)


async def _paced(stop_s: float, send: Callable[[int], Awaitable[Any]], receive: Callable[[], Awaitable[Any]]) -> Ledger:
    """One frame after the other until ``stop_s``."""
    ledger: Ledger = []
    while (started_s := time.monotonic()) < stop_s:
        await send(len(ledger))
        await receive()
        ledger.append((started_s, time.monotonic()))
    return ledger


async def _echo_stream(load: Load, data: bytes, stop_s: float) -> Ledger:
    request = _frame(0, data).SerializeToString()
    async with grpc.aio.insecure_channel(load.target, options=client_options(own_connection=True)) as channel:
        call = channel.stream_stream(ECHO)()
        ledger = await _paced(stop_s, lambda number: call.write(request), call.read)
        await call.done_writing()
        return ledger


async def _stub_stream(load: Load, data: bytes, stop_s: float) -> Ledger:
    config = pb.CodecConfig(codec=pb.CODEC_JPEG, width=WIDTH, height=HEIGHT, frame_rate=1000)
    async with grpc.aio.insecure_channel(load.target, options=client_options(own_connection=True)) as channel:
        call = pb_grpc.PerceptionServiceStub(channel).StreamPerception()
        await call.write(pb.StreamPerceptionRequest(hello=pb.Hello(protocol_revision=1, codec_config=config)))
        await call.read()

        async def receive() -> None:
            while (response := await call.read()).WhichOneof("payload") != "result":
                if response is grpc.aio.EOF or response.WhichOneof("payload") != "flow_update":
                    raise RuntimeError(f"no result but {response}")

        ledger = await _paced(stop_s, lambda number: call.write(_frame(number, data)), receive)
        await call.done_writing()
        return ledger


async def _client_stream(load: Load, data: bytes, stop_s: float) -> Ledger:
    async with PerceptionClient(load.target, SessionRequest("jpeg", WIDTH, HEIGHT, 1000.0)) as session:
        answers = session.answers()

        async def send(number: int) -> None:
            await session.acquire_credit()
            await session.send(_frame(number, data).frame)

        async def receive() -> None:
            answer = await anext(answers)
            if answer.rejection is not None:
                raise RuntimeError(answer.rejection)
            session.release_credit()

        ledger = await _paced(stop_s, send, receive)
        with suppress(StopAsyncIteration):
            await session.finish()
            await anext(answers)
        return ledger


def _frame(number: int, data: bytes) -> pb.StreamPerceptionRequest:
    return pb.StreamPerceptionRequest(frame=pb.VideoFrame(sequence=number, data=data, keyframe=True))


def answer_size(target_port: int, frame_bytes: int) -> int:
    """Bytes of one Result of our server, for the echo to answer with as many."""

    async def ask() -> int:
        async with PerceptionClient(f"127.0.0.1:{target_port}", SessionRequest("jpeg", WIDTH, HEIGHT, 10.0)) as session:
            await session.acquire_credit()
            await session.send(_frame(0, padded_jpeg(frame_bytes)).frame)
            return (await anext(session.answers())).message_bytes

    return asyncio.run(ask())
