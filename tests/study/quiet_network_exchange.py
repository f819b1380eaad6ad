"""Run in a network namespace of its own: exchanges messages over gRPC and prints what the kernel counted.

Usage: ``unshare --net --map-root-user python quiet_network_exchange.py UPLINK_BYTES DOWNLINK_BYTES``
"""

from __future__ import annotations

import asyncio
import ctypes
import fcntl
import json
import socket
import struct
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import grpc

from cable_rpc.study.transport_counters import open_connections
from cable_rpc.study.transport_estimate import TransportBytes
from cable_rpc.wire.channel import client_options, server_options

FRAMES = 40
FRAME_GAP_S = 0.02
SETTLE_S = 0.1
SIOCSIFFLAGS, SIOCSIFMTU, SIOCETHTOOL = 0x8914, 0x8922, 0x8946
IFF_UP_LOOPBACK_RUNNING = 0x1 | 0x8 | 0x40
ETHTOOL_STSO, ETHTOOL_SGSO, ETHTOOL_SGRO = 0x1F, 0x24, 0x2C


def make_loopback_an_ethernet() -> None:
    """Up, MTU 1500, and no segments joined behind the counters' back."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        fcntl.ioctl(control, SIOCSIFMTU, struct.pack("16si12x", b"lo", 1500))
        fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", IFF_UP_LOOPBACK_RUNNING))
        for command in (ETHTOOL_STSO, ETHTOOL_SGSO, ETHTOOL_SGRO):
            off = ctypes.create_string_buffer(struct.pack("II", command, 0))
            fcntl.ioctl(control, SIOCETHTOOL, struct.pack("16sP8x", b"lo", ctypes.addressof(off)))


def interface_bytes() -> int:
    for line in Path("/proc/net/dev").read_text().splitlines():
        name, _, counters = line.partition(":")
        if name.strip() == "lo":
            return int(counters.split()[0])
    raise RuntimeError("/proc/net/dev has no lo")


async def exchange(uplink_bytes: int, downlink_bytes: int) -> dict[str, int]:
    async def answer(requests: AsyncIterator[bytes], context: Any) -> AsyncIterator[bytes]:
        async for _ in requests:
            yield bytes(downlink_bytes)

    server = grpc.aio.server(options=server_options())
    stream = grpc.stream_stream_rpc_method_handler(answer)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("test", {"stream": stream}),))
    target = f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}"
    await server.start()
    async with grpc.aio.insecure_channel(target, options=client_options()) as channel:
        call: Any = channel.stream_stream("/test/stream")()

        async def exchange_frames(count: int) -> tuple[int, TransportBytes]:
            for _ in range(count):
                await call.write(bytes(uplink_bytes))
                await call.read()
                await asyncio.sleep(FRAME_GAP_S)
            await asyncio.sleep(SETTLE_S)
            (connection,) = open_connections(target)
            return interface_bytes(), connection.carried

        at_start, tcp_at_start = await exchange_frames(5)
        at_end, tcp_at_end = await exchange_frames(FRAMES)
        await call.done_writing()
    await server.stop(None)
    return {
        "frames": FRAMES,
        "interface": at_end - at_start,
        "tcp_uplink": tcp_at_end.uplink - tcp_at_start.uplink,
        "tcp_downlink": tcp_at_end.downlink - tcp_at_start.downlink,
    }


if __name__ == "__main__":
    try:
        make_loopback_an_ethernet()
    except OSError as error:
        print(f"this kernel does not let the loopback be set up: {error}", file=sys.stderr)
        sys.exit(3)
    print(json.dumps(asyncio.run(exchange(int(sys.argv[1]), int(sys.argv[2])))))
