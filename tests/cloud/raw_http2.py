"""Just enough of HTTP/2 (RFC 9113) by hand to misbehave below what a gRPC library lets one do."""

from __future__ import annotations

import socket
import struct

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
DATA, HEADERS, RST_STREAM, SETTINGS = 0, 1, 3, 4
END_HEADERS = 4
INITIAL_WINDOW_SIZE = 4
CANCEL = 8
HEADER_FIELDS = {
    ":method": "POST",
    ":scheme": "http",
    ":path": "/cable.v1.PerceptionService/StreamPerception",
    ":authority": "localhost",
    "te": "trailers",
    "content-type": "application/grpc",
}


def http2_frame(kind: int, flags: int, stream: int, payload: bytes) -> bytes:
    """A frame of section 4.1."""
    return len(payload).to_bytes(3, "big") + bytes([kind, flags]) + stream.to_bytes(4, "big") + payload


def settings(window: int | None = None) -> bytes:
    """The first frame of a client; ``window`` is what the server may send on a stream before it is asked for more."""
    return http2_frame(SETTINGS, 0, 0, b"" if window is None else struct.pack(">HI", INITIAL_WINDOW_SIZE, window))


def headers(stream: int) -> bytes:
    """Opens a perception stream; literal fields that need no table (RFC 7541, 6.2.2), all shorter than 127 octets."""
    block = b"".join(
        b"\0" + bytes([len(name)]) + name.encode() + bytes([len(value)]) + value.encode()
        for name, value in HEADER_FIELDS.items()
    )
    return http2_frame(HEADERS, END_HEADERS, stream, block)


def message_start(length: int) -> bytes:
    """What precedes a message of ``length`` bytes in gRPC over HTTP/2: not compressed, and how much is to come."""
    return struct.pack(">BI", 0, length)


def connection(port: int, *, window: int | None = None) -> socket.socket:
    """A greeted connection that reads nothing by itself."""
    raw = socket.create_connection(("127.0.0.1", port), timeout=5)
    raw.sendall(PREFACE + settings(window))
    return raw
