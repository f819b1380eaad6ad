"""Clients that hold a connection with next to nothing: those who write a byte now and then, those who never read."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import grpc
import pytest

from cable_rpc.cloud.limits import ServerLimits
from cable_rpc.cloud.session_limits import SessionLimits

from .raw_http2 import CANCEL, DATA, RST_STREAM, connection, headers, http2_frame, message_start
from .secure_server import serving
from .server_process import server_process
from .test_abuse import STREAM, memory_stays_within
from .test_protocol import coded, frame, hello, opened, read, serves_a_frame

CONNECTIONS = 16
WITHIN_S = 8.0
IMPATIENT = SessionLimits(hello_timeout_s=0.4, close_timeout_s=0.4, heartbeat_s=0.1, idle_timeout_s=0.5)


@asynccontextmanager
async def trickling(sockets: list[socket.socket], data: bytes) -> AsyncIterator[None]:
    """Sends ``data`` on each connection, a byte every 20 ms, for as long as the block runs."""

    async def trickle() -> None:
        for byte in data:
            for raw in sockets:
                with suppress(OSError):
                    raw.sendall(http2_frame(DATA, 0, 1, bytes([byte])))
            await asyncio.sleep(0.02)

    task = asyncio.create_task(trickle())
    try:
        yield
    finally:
        task.cancel()
        for raw in sockets:
            raw.close()


async def all_gone(server: Any) -> None:
    """Every stream has been ended, and no more of them come."""
    quiet = 0
    async with asyncio.timeout(WITHIN_S):
        while quiet < 5:
            await asyncio.sleep(0.02)
            quiet = 0 if server._service._admission.streams or server._service._sessions else quiet + 1


async def opened_by(server: Any, count: int) -> None:
    async with asyncio.timeout(WITHIN_S):
        while len(server._service._sessions) < count:
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("opening", [b"", hello().SerializeToString()], ids=["before the Hello", "after the Hello"])
async def test_who_writes_byte_by_byte_is_sent_away(stub_for: Any, opening: bytes) -> None:
    """A frame of a megabyte at 50 bytes a second holds a place for no longer than silence would."""
    first = message_start(len(opening)) + opening if opening else b""
    async with serving(limits=IMPATIENT) as server, stub_for(f"127.0.0.1:{server.port}") as other:
        sockets = [connection(server.port) for _ in range(CONNECTIONS)]
        for raw in sockets:
            raw.sendall(headers(1) + http2_frame(DATA, 0, 1, first + message_start(1 << 20)))
        await opened_by(server, CONNECTIONS)
        async with trickling(sockets, bytes(1000)):
            await serves_a_frame(other)
            await all_gone(server)
        await serves_a_frame(other)


async def test_who_never_opens_the_window_is_cut_off(stub_for: Any) -> None:
    """Not even the Welcome may be sent to one who lets no byte through."""
    opening = hello().SerializeToString()
    frames = [frame(number, packet).SerializeToString() for number, packet in enumerate(coded("jpeg", 2))]
    async with (
        serving(write_timeout_s=0.5) as server,
        stub_for(f"127.0.0.1:{server.port}") as other,
    ):
        sockets = [connection(server.port, window=0) for _ in range(CONNECTIONS)]
        for raw in sockets:
            messages = b"".join(message_start(len(message)) + message for message in (opening, *frames))
            raw.sendall(headers(1) + http2_frame(DATA, 0, 1, messages))
        await opened_by(server, CONNECTIONS)
        await serves_a_frame(other)
        await all_gone(server)
        for raw in sockets:
            raw.close()


@pytest.mark.parametrize("length", [(1 << 32) - 1, 15 << 20], ids=["4 GiB", "15 MiB"])
async def test_announced_bytes_that_never_come_take_no_memory(stub_for: Any, length: int) -> None:
    async with serving(limits=IMPATIENT) as server, stub_for(f"127.0.0.1:{server.port}") as other:
        await serves_a_frame(other)
        with memory_stays_within(30):
            sockets = [connection(server.port) for _ in range(CONNECTIONS)]
            for raw in sockets:
                raw.sendall(headers(1) + http2_frame(DATA, 0, 1, message_start(length) + bytes(100)))
            await asyncio.sleep(0.3)
            await serves_a_frame(other)
        await all_gone(server)
        for raw in sockets:
            raw.close()


async def test_streams_that_are_reset_at_once_leave_nothing(stub_for: Any) -> None:
    """Rapid reset (CVE-2023-44487): many streams on one connection, each taken back in the next frame.

    A stream that is there is served meanwhile; new ones may find the server full until the flood has ebbed away.
    """
    packet = coded("jpeg", 1)[0]
    async with serving(shares=ServerLimits(streams=20)) as server, stub_for(f"127.0.0.1:{server.port}") as other:
        served = await opened(other)
        with memory_stays_within(40):
            raw = connection(server.port)
            for number in range(10):
                with suppress(OSError):
                    for stream in range(400 * number + 1, 400 * (number + 1), 2):
                        raw.sendall(headers(stream) + http2_frame(RST_STREAM, 0, stream, CANCEL.to_bytes(4, "big")))
                await served.write(frame(number, packet))
                assert (await read(served)).result.sequence == number
            await served.done_writing()
            await all_gone(server)
            await serves_a_frame(other)
            raw.close()


async def test_compressed_bombs_are_not_inflated() -> None:
    """128 MiB in an eighth of a megabyte: gRPC inflates up to the largest message, and ends that stream."""
    with server_process() as server:
        options = [("grpc.max_send_message_length", -1)]
        async with grpc.aio.insecure_channel(server.target, options=options) as channel:
            call = channel.stream_stream(STREAM)()
            await call.write(hello().SerializeToString())
            await call.read()
            before_mb = server.memory_mb()
            grown_mb = 0.0
            bomb = channel.stream_stream(STREAM)(compression=grpc.Compression.Gzip)
            await bomb.write(hello().SerializeToString())
            await bomb.read()
            sending = asyncio.create_task(bomb.write(bytes(128 << 20)))
            async with asyncio.timeout(30):
                while not bomb.done():
                    grown_mb = max(grown_mb, server.memory_mb() - before_mb)
                    await asyncio.sleep(0.005)
            await asyncio.gather(sending, return_exceptions=True)
            assert await bomb.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
            assert grown_mb < 60
            await call.write(frame(0, coded("jpeg", 1)[0]).SerializeToString())
            assert await call.read() is not grpc.aio.EOF
            await call.done_writing()
            call.cancel()
        assert server.streams_left() == 0
