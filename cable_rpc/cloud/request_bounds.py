"""Requests are measured before they are parsed: parsed, a list of empty texts takes sixteen times its bytes."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, TypeAlias

import grpc
from google.protobuf.message import DecodeError

from cable_rpc.errors import ProtocolError
from cable_rpc.wire.v1 import perception_pb2 as pb

MOST_CONTROL_BYTES = 64 << 10
"""Of everything but a frame. A frame holds no lists, and takes no more than its bytes."""
FRAME_TAG = pb.StreamPerceptionRequest.FRAME_FIELD_NUMBER << 3 | 2
STREAM_METHOD = "/cable.v1.PerceptionService/StreamPerception"

Handler: TypeAlias = "grpc.RpcMethodHandler[Any, Any]"


def parse_request(data: bytes) -> pb.StreamPerceptionRequest:
    """A request from its bytes.

    Raises:
        ProtocolError: it is damaged, or has more than 64 KiB beside the frame that it begins with.
    """
    beside = len(data) - leading_frame_bytes(data)
    if beside > MOST_CONTROL_BYTES:
        raise ProtocolError(f"a message has {beside} bytes that are no frame, at most {MOST_CONTROL_BYTES} are taken")
    try:
        return pb.StreamPerceptionRequest.FromString(data)
    except DecodeError as error:
        raise ProtocolError(f"a message of {len(data)} bytes is damaged: it can't be parsed") from error


def leading_frame_bytes(data: bytes) -> int:
    """Size of the frame at the beginning, with its tag and length; 0 where something else stands there."""
    if not data or data[0] != FRAME_TAG:
        return 0
    length = 0
    for position in range(1, min(len(data), 6)):
        length |= (data[position] & 0x7F) << 7 * (position - 1)
        if not data[position] & 0x80:
            return min(position + 1 + length, len(data))
    return 0


class RequestBounds(grpc.aio.ServerInterceptor):
    """Has the requests of a session parsed by `parse_request`."""

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Handler | None]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Handler | None:
        """See `grpc.aio.ServerInterceptor`."""
        handler = await continuation(handler_call_details)
        if handler is None or handler_call_details.method != STREAM_METHOD:
            return handler
        behaviour: Any = handler.stream_stream
        bounded: Handler = grpc.stream_stream_rpc_method_handler(
            behaviour, request_deserializer=parse_request, response_serializer=handler.response_serializer
        )
        return bounded
