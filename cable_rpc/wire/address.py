"""Where a server is: the spellings of an address that both ends understand."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

from cable_rpc.errors import ConfigurationError

SECURE_SCHEME, PLAIN_SCHEME = "grpcs://", "grpc://"


@dataclass(frozen=True, slots=True)
class Target:
    """A server as a client names it."""

    address: str
    """As gRPC takes it: "host:port", "[::1]:port" or "unix:path"."""
    tls: bool | None
    """What the scheme asks for; None = it was not given."""

    @classmethod
    def parse(cls, text: str) -> Target:
        """Reads ``grpcs://host:port``, ``grpc://host:port`` or ``host:port``.

        Raises:
            ConfigurationError: if there is no port, or another scheme.
        """
        for scheme, tls in ((SECURE_SCHEME, True), (PLAIN_SCHEME, False)):
            if text.startswith(scheme):
                return cls(checked_address(text.removeprefix(scheme).rstrip("/"), text), tls)
        if "://" in text:
            raise ConfigurationError(f"target '{text}': the scheme must be {SECURE_SCHEME} or {PLAIN_SCHEME}")
        return cls(checked_address(text, text), None)


def checked_address(address: str, shown: str) -> str:
    """The address, if it is one.

    Raises:
        ConfigurationError: otherwise.
    """
    if address.startswith("unix:"):
        return address
    host, port = split_address(address)
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigurationError(f"target '{shown}' is not HOST:PORT, e.g. gpu-box:50051 or grpcs://gpu-box:50051")
    return address


def split_address(address: str) -> tuple[str, str]:
    """Host, without the brackets of an IPv6 address, and port."""
    host, _, port = address.rpartition(":")
    return host.strip("[]"), port


def is_loopback(address: str) -> bool:
    """True when HOST:PORT can only be reached from this machine."""
    host, _ = split_address(address)
    if host == "localhost" or address.startswith("unix:"):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
