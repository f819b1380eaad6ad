"""gRPC settings that both ends must agree on."""

from __future__ import annotations

MAX_MESSAGE_BYTES = 16 << 20
"""Largest gRPC message accepted by either end; frames are refused by FlowUpdate.max_frame_bytes long before."""

ChannelOptions = list[tuple[str, int]]


def _common(max_message_bytes: int) -> ChannelOptions:
    # With data in flight the keepalive timeout acts as TCP_USER_TIMEOUT: it is the dead-link time.
    return [
        ("grpc.max_send_message_length", max_message_bytes),
        ("grpc.max_receive_message_length", max_message_bytes),
        ("grpc.keepalive_time_ms", 10_000),
        ("grpc.keepalive_timeout_ms", 4_000),
        ("grpc.keepalive_permit_without_calls", 1),
    ]


def server_options(max_message_bytes: int = MAX_MESSAGE_BYTES) -> ChannelOptions:
    """Options of a server."""
    # The smallest ping interval must lie below the clients' keepalive time, else they are sent away.
    return [
        *_common(max_message_bytes),
        ("grpc.http2.min_ping_interval_without_data_ms", 5_000),
        ("grpc.so_reuseport", 0),
        # Who connects and says nothing holds a socket; ours says something every 5 s on either connection.
        ("grpc.server_handshake_timeout_ms", 10_000),
        ("grpc.max_connection_idle_ms", 300_000),
    ]


def client_options(max_message_bytes: int = MAX_MESSAGE_BYTES, *, own_connection: bool = False) -> ChannelOptions:
    """Options of a channel.

    Args:
        max_message_bytes: largest message sent or received.
        own_connection: True keeps this channel from sharing a TCP connection with another of the same target.
    """
    return [
        *_common(max_message_bytes),
        ("grpc.http2.max_pings_without_data", 0),
        ("grpc.initial_reconnect_backoff_ms", 500),
        ("grpc.min_reconnect_backoff_ms", 500),
        ("grpc.max_reconnect_backoff_ms", 3_000),
        ("grpc.use_local_subchannel_pool", int(own_connection)),
    ]
