"""Damaged and impossible messages over real sockets: the server answers or closes, and serves the others meanwhile."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

import grpc
import pytest
from hypothesis import HealthCheck, given, settings

from .hostile_messages import CODECS, damaged, good_session, sessions
from .secure_server import client, one_frame
from .server_process import ServerProcess, server_process
from .test_abuse import STREAM

MESSAGES_PER_STREAM = 8
MOST_GROWTH_MB = 50.0


async def hostile_stream(channel: grpc.aio.Channel, messages: list[bytes]) -> int:
    """Sends everything, takes what comes, and must see the end; how many messages went before it."""
    call = channel.stream_stream(STREAM)()
    written = 0
    try:
        async with asyncio.timeout(30):
            for message in messages:
                await call.write(message)
                written += 1
            await call.done_writing()
            while await call.read() is not grpc.aio.EOF:
                pass
    except asyncio.InvalidStateError:
        pass  # the server ended first
    except grpc.aio.AioRpcError as error:
        # A call that the server ends while the client writes may look broken (grpc #36066); nothing else may.
        if error.code() not in (grpc.StatusCode.INTERNAL, grpc.StatusCode.UNKNOWN):
            raise
    finally:
        # Answers that nobody reads would keep the call, and its memory, at this end.
        call.cancel()
    return written


@dataclass
class Attack:
    """Streams of hostile messages to a server, beside a client that must always be served."""

    server: ServerProcess
    runner: asyncio.Runner
    stack: AsyncExitStack = field(default_factory=AsyncExitStack)
    messages: int = 0
    streams: int = 0
    served: int = 0

    async def open(self) -> None:
        self.channel = await self.stack.enter_async_context(grpc.aio.insecure_channel(self.server.target))
        self.bystander = await self.stack.enter_async_context(client(self.server.target))

    def stream(self, messages: list[bytes]) -> None:
        self.runner.run(self._stream(messages))

    async def _stream(self, messages: list[bytes]) -> None:
        self.messages += await hostile_stream(self.channel, messages)
        if self.streams % 20 == 0:
            assert (await one_frame(self.bystander, self.streams)).rejection is None
            self.served += 1
        self.streams += 1


@contextmanager
def attack() -> Iterator[Attack]:
    """Afterwards no stream is left, and the bystander has had all its answers."""
    with server_process() as server, asyncio.Runner() as runner:
        running = Attack(server, runner)
        runner.run(running.open())
        yield running
        assert running.served == -(-running.streams // 20)
        runner.run(running.stack.aclose())
        assert server.streams_left() == 0


def growth_mb(running: Attack, streams: int, one: Callable[[], Any]) -> float:
    """What the server's memory grows by after the first fifth of the streams."""
    before_mb = 0.0
    for number in range(streams):
        one()
        if number == streams // 5:
            before_mb = running.server.memory_mb()
    return running.server.memory_mb() - before_mb


def send_damaged(streams: int, seed: int) -> tuple[int, float]:
    """Messages sent, and what the server grew by in MB."""
    source = random.Random(seed)
    good = {codec: [request.SerializeToString() for request in good_session(codec)] for codec in CODECS}
    with attack() as running:

        def one() -> None:
            first, *others = good[source.choice(list(CODECS))]
            opening = first if source.random() < 0.8 else damaged(first, source)
            chosen = [source.choice(others) for _ in range(MESSAGES_PER_STREAM)]
            running.stream(
                [opening, *(damaged(message, source) if source.random() < 0.9 else message for message in chosen)]
            )

        grown_mb = growth_mb(running, streams, one)
    return running.messages, grown_mb


def send_impossible(streams: int) -> tuple[int, float]:
    """Messages sent, and what the server grew by in MB. Hypothesis may run a few streams fewer or more."""
    good = {codec: good_session(codec) for codec in CODECS}
    with attack() as running:
        memory_mb: list[float] = []

        @settings(max_examples=streams, database=None, derandomize=True, suppress_health_check=list(HealthCheck))
        @given(sessions(good))
        def send(messages: list[bytes]) -> None:
            running.stream(messages)
            if running.streams == streams // 5:
                memory_mb.append(running.server.memory_mb())

        send()
        grown_mb = running.server.memory_mb() - memory_mb[0]
    return running.messages, grown_mb


def test_damaged_messages() -> None:
    assert send_damaged(60, seed=1)[1] < MOST_GROWTH_MB


def test_impossible_messages() -> None:
    assert send_impossible(15)[1] < MOST_GROWTH_MB


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_many_damaged_messages() -> None:
    """Those that gRPC took before a stream's end; the end of many a stream is the first that breaks a rule."""
    messages, grown_mb = send_damaged(6000, seed=2)
    print(f"{messages} damaged messages, the server grew by {grown_mb:.1f} MB")
    assert messages >= 20_000
    assert grown_mb < MOST_GROWTH_MB


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_many_impossible_messages() -> None:
    messages, grown_mb = send_impossible(5000)
    print(f"{messages} impossible messages, the server grew by {grown_mb:.1f} MB")
    assert messages >= 20_000
    assert grown_mb < MOST_GROWTH_MB
