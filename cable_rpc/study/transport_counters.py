"""Transport bytes of a session, read from the kernel's counters of this process's own TCP connections.

Linux counts payload and segments of every connection (``struct tcp_info`` of ``linux/tcp.h``; segments as in RFC 4898,
bare acknowledgements included). Unlike an interface's counters they hold nobody else's traffic, and segments that
the network card cuts later are counted one by one.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import stat
import struct
import sys
from dataclasses import dataclass

from cable_rpc.study.transport_estimate import IPV4_HEADER_BYTES, TCP_HEADER_BYTES, TransportBytes

IPV6_HEADER_BYTES = 40
TCP_TIMESTAMP_OPTION_BYTES = 12
TCPI_OPT_TIMESTAMPS = 1
TCP_INFO_BYTES = 216
OPTIONS_OFFSET = 5
BYTES_RECEIVED_OFFSET = 128
SEGMENTS_OFFSET = 136
BYTES_SENT_OFFSET = 200
"""Linux 4.19 and later."""


@dataclass(frozen=True, slots=True)
class Connection:
    """One TCP connection at one moment."""

    local: str
    peer: str
    """IP address."""
    carried: TransportBytes
    """IP packets: payload, retransmissions of our own and headers; received duplicates count as headers only."""

    @property
    def is_link(self) -> bool:
        """False where both ends are the same machine."""
        return self.local != self.peer and not ipaddress.ip_address(self.peer).is_loopback


def measure_link(target: str) -> TransportBytes | None:
    """What this process's connections to a server have carried so far, all of them together.

    Args:
        target: ``HOST:PORT`` as gRPC was given it.

    Returns:
        None where there is no link (both ends on one machine: other segment sizes, no network) or nothing to
        read (not Linux, a proxy or a socket file between, connection closed).
    """
    connections = open_connections(target)
    if not connections or not all(connection.is_link for connection in connections):
        return None
    return TransportBytes(
        sum(connection.carried.uplink for connection in connections),
        sum(connection.carried.downlink for connection in connections),
    )


def open_connections(target: str) -> list[Connection]:
    """This process's TCP connections to ``HOST:PORT``; empty where they can't be read."""
    host, _, port = target.rpartition(":")
    if sys.platform != "linux" or not host or not port.isdecimal():
        return []
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)
        descriptors = [int(name) for name in os.listdir("/proc/self/fd")]
    except (OSError, UnicodeError, OverflowError):
        return []
    addresses = {plain_address(str(entry[4][0])) for entry in found}
    connections = (read_connection(descriptor, addresses, int(port)) for descriptor in descriptors)
    return [connection for connection in connections if connection is not None]


def read_connection(descriptor: int, addresses: set[str], port: int) -> Connection | None:
    """The connection behind a file descriptor; None where it is not one to these addresses and this port."""
    try:
        if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            return None
        connection = socket.socket(fileno=descriptor)
    except OSError:
        return None  # closed since it was listed
    try:
        if connection.family not in (socket.AF_INET, socket.AF_INET6) or connection.type != socket.SOCK_STREAM:
            return None
        peer, peer_port = connection.getpeername()[:2]
        if plain_address(peer) not in addresses or peer_port != port:
            return None
        local = plain_address(connection.getsockname()[0])
        info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_INFO_BYTES)
    except OSError:
        return None  # a listening socket, or one that broke meanwhile
    finally:
        connection.detach()  # the descriptor belongs to gRPC, which closes it
    if len(info) < BYTES_SENT_OFFSET + 8:
        return None
    return Connection(local, plain_address(peer), carried_bytes(info, ip_version=ipaddress.ip_address(local).version))


def carried_bytes(info: bytes, *, ip_version: int) -> TransportBytes:
    """Payload and headers from a ``struct tcp_info`` of 208 bytes or more."""
    (received,) = struct.unpack_from("=Q", info, BYTES_RECEIVED_OFFSET)
    segments_out, segments_in = struct.unpack_from("=II", info, SEGMENTS_OFFSET)
    (sent,) = struct.unpack_from("=Q", info, BYTES_SENT_OFFSET)
    header = TCP_HEADER_BYTES + (IPV4_HEADER_BYTES if ip_version == 4 else IPV6_HEADER_BYTES)
    if not info[OPTIONS_OFFSET] & TCPI_OPT_TIMESTAMPS:
        header -= TCP_TIMESTAMP_OPTION_BYTES
    return TransportBytes(sent + segments_out * header, received + segments_in * header)


def plain_address(address: str) -> str:
    """Without IPv6 scope, and IPv4 not dressed as IPv6, as a socket for both may report it."""
    parsed = ipaddress.ip_address(address.partition("%")[0])
    return str(getattr(parsed, "ipv4_mapped", None) or parsed)
