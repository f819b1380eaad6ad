"""The first message of a stream (rule R1 of the contract)."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

from cable_rpc.cloud.bounds import check_hello
from cable_rpc.errors import ProtocolError
from cable_rpc.wire.convert import PROTOCOL_REVISION
from cable_rpc.wire.v1 import perception_pb2 as pb


async def read_hello(requests: AsyncIterator[pb.StreamPerceptionRequest], timeout_s: float) -> pb.Hello:
    """Waits for the Hello and checks it.

    Raises:
        ProtocolError: none came in time, something else came, or it asks for what can't be.
    """
    try:
        async with asyncio.timeout(timeout_s):
            first = await anext(requests, None)
    except TimeoutError:
        raise ProtocolError(f"no Hello within {timeout_s:g} s") from None
    if first is None:
        raise ProtocolError("the stream ended before its Hello")
    kind = first.WhichOneof("payload")
    if kind != "hello":
        raise ProtocolError(f"the first message must be Hello with a CodecConfig, got {kind or 'nothing'}")
    hello = first.hello
    if hello.protocol_revision != PROTOCOL_REVISION:
        raise ProtocolError(
            f"the client speaks protocol revision {hello.protocol_revision}, this server {PROTOCOL_REVISION}; "
            "update the older one"
        )
    check_hello(hello)
    return hello
