"""What messages of known size cost as IP packets: an estimate, by the headers that standards prescribe.

One message becomes a length-prefixed gRPC message (5 bytes, "gRPC over HTTP2"), cut into DATA frames of at most
16 384 bytes (SETTINGS_MAX_FRAME_SIZE's initial value, RFC 9113 section 6.5.2) of which each has a header of 9 bytes
(section 4.1), cut into TCP segments. A segment carries 1448 bytes: an Ethernet MTU of 1500 less 20 bytes of IPv4
header (RFC 791) and 32 of TCP (20 of RFC 9293 section 3.1, 12 of time stamps and padding, RFC 7323 section 3.2).
The other direction carries one acknowledgement for every two segments, also of 52 bytes (RFC 9293 section 3.8.6.3:
at least every second full segment), and one WINDOW_UPDATE of 13 bytes for each message (RFC 9113 section 6.9).

Left out: connection set-up, HTTP/2 HEADERS, PING and clock samples (some kB a session), retransmissions, TLS,
tunnels, and the link's own framing (Ethernet 38 bytes a packet, more on radio). Every message is taken to start its
own segment, and no acknowledgement to ride on an answer.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

GRPC_PREFIX_BYTES = 5
HTTP2_FRAME_HEADER_BYTES = 9
HTTP2_MAX_FRAME_BYTES = 16384
WINDOW_UPDATE_BYTES = HTTP2_FRAME_HEADER_BYTES + 4
IPV4_HEADER_BYTES = 20
TCP_HEADER_BYTES = 32
"""With time stamps."""
PACKET_HEADER_BYTES = IPV4_HEADER_BYTES + TCP_HEADER_BYTES
MSS_BYTES = 1500 - PACKET_HEADER_BYTES
SEGMENTS_PER_ACKNOWLEDGEMENT = 2


@dataclass(frozen=True, slots=True)
class TransportBytes:
    """IP packets, headers included, edge to cloud and back."""

    uplink: int
    downlink: int

    def __add__(self, other: TransportBytes) -> TransportBytes:
        return TransportBytes(self.uplink + other.uplink, self.downlink + other.downlink)


def estimate_exchange(uplink_message: int, downlink_message: int) -> TransportBytes:
    """Packets of one request and its answer.

    Args:
        uplink_message: serialised protobuf message in bytes; 0 where none was sent.
        downlink_message: likewise of the answer; 0 where none came.
    """
    forward, forward_return = message_cost(uplink_message)
    backward, backward_return = message_cost(downlink_message)
    return TransportBytes(forward + backward_return, backward + forward_return)


def estimate_exchanges(messages: Iterable[tuple[int, int]]) -> TransportBytes:
    """Sum of `estimate_exchange` over (uplink, downlink) pairs."""
    return sum((estimate_exchange(uplink, downlink) for uplink, downlink in messages), TransportBytes(0, 0))


def message_cost(message_bytes: int) -> tuple[int, int]:
    """Bytes in packets that a message costs in its own direction and in the other one."""
    if message_bytes <= 0:
        return 0, 0
    prefixed = message_bytes + GRPC_PREFIX_BYTES
    stream = prefixed + HTTP2_FRAME_HEADER_BYTES * -(-prefixed // HTTP2_MAX_FRAME_BYTES)
    segments = -(-stream // MSS_BYTES)
    acknowledgements = -(-segments // SEGMENTS_PER_ACKNOWLEDGEMENT)
    return (
        stream + segments * PACKET_HEADER_BYTES,
        acknowledgements * PACKET_HEADER_BYTES + WINDOW_UPDATE_BYTES,
    )
