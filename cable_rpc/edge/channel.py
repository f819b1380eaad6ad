"""The edge's way to a server: plain or TLS, with or without a token, and what went wrong when there is none."""

from __future__ import annotations

import asyncio
import os
from dataclasses import dataclass, field
from pathlib import Path

import grpc

from cable_rpc.edge.tls_probe import diagnose
from cable_rpc.errors import ConfigurationError, RemoteError
from cable_rpc.wire.address import Target, is_loopback
from cable_rpc.wire.channel import client_options
from cable_rpc.wire.pem import load_authorities, load_key_pair, read_file

TOKEN_VARIABLE = "CABLE_RPC_TOKEN"  # noqa: S105 - the name of a variable
CLIENT_FLAGS = ("--tls-cert", "--tls-key")
AUTHORITIES_FLAG = "--tls-ca"
MOST_TOKEN_CHARACTERS = 4096

LOOK_INTERVAL_S = 0.25
"""How often a connection that does not come about is looked at."""

Metadata = tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class ClientSecurity:
    """How a client proves who it is, and checks who the server is."""

    tls: bool = False
    """True also where the target's scheme or one of the files says so."""
    authorities: Path | None = None
    """PEM of what the server's certificate must descend from; None = the well-known authorities."""
    certificate: Path | None = None
    """PEM chain to show; with `key`."""
    key: Path | None = None
    server_name: str = ""
    """What the server's certificate must be made out to; empty = the target's host."""
    token: str = field(default="", repr=False)
    """Bearer token; empty = none."""


PLAIN = ClientSecurity()


def read_token(path: Path | None) -> str:
    """The token in a file, or in the environment variable CABLE_RPC_TOKEN; empty where there is neither.

    Raises:
        ConfigurationError: the file can't be read, or holds no single word.
    """
    if path is None:
        text, where = os.environ.get(TOKEN_VARIABLE, ""), TOKEN_VARIABLE
        if not text.strip():
            return ""
    else:
        text, where = read_file(path, "--token-file").decode("utf-8", "replace"), f"--token-file {path}"
    token = text.strip()
    if not (0 < len(token) <= MOST_TOKEN_CHARACTERS and token.isascii() and token.isprintable() and " " not in token):
        raise ConfigurationError(
            f"{where} must hold one token: up to {MOST_TOKEN_CHARACTERS} printable ASCII characters without spaces"
        )
    return token


class SecureTarget:
    """A server and the way to it, checked.

    Args:
        text: ``grpcs://host:port``, ``grpc://host:port`` or ``host:port``.
        security: what was asked for.

    Raises:
        ConfigurationError: the target is none, a file can't be used, settings contradict each other, or the token
            would travel in plain text.
    """

    def __init__(self, text: str, security: ClientSecurity = PLAIN) -> None:
        target = Target.parse(text)
        self.address = target.address
        self._security = security
        given = [security.authorities, security.certificate, security.key]
        wanted = security.tls or bool(security.server_name) or any(path is not None for path in given)
        if wanted and target.tls is False:
            raise ConfigurationError(f"target {text} asks for plain text, the TLS settings for TLS; write grpcs://")
        self.tls = wanted or bool(target.tls)
        if (security.certificate is None) != (security.key is None):
            raise ConfigurationError(f"{' and '.join(CLIENT_FLAGS)} belong together; give both")
        if security.token and not self.tls and not is_loopback(self.address):
            raise ConfigurationError(
                f"the token would travel to {text} in plain text, where anybody on the way can take it; "
                f"use TLS: --target grpcs://{self.address}"
            )
        self._authorities = (
            None if security.authorities is None else load_authorities(security.authorities, AUTHORITIES_FLAG)
        )
        self._pair = (
            None
            if security.certificate is None or security.key is None
            else load_key_pair(security.certificate, security.key, CLIENT_FLAGS)
        )

    @property
    def metadata(self) -> Metadata:
        """To be sent with each call."""
        return (("authorization", f"Bearer {self._security.token}"),) if self._security.token else ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What should be mended soon."""
        return () if self._pair is None or self._pair.warning is None else (f"{CLIENT_FLAGS[0]}: {self._pair.warning}",)

    def open_channel(self, *, own_connection: bool = False) -> grpc.aio.Channel:
        """A channel of the running event loop.

        Args:
            own_connection: True keeps it from sharing a TCP connection with another of the same target.
        """
        options: list[tuple[str, int | str]] = [*client_options(own_connection=own_connection)]
        if not self.tls:
            return grpc.aio.insecure_channel(self.address, options=options)
        if self._security.server_name:
            options.append(("grpc.ssl_target_name_override", self._security.server_name))
        pair = self._pair
        credentials = grpc.ssl_channel_credentials(
            self._authorities, None if pair is None else pair.key, None if pair is None else pair.chain
        )
        return grpc.aio.secure_channel(self.address, credentials, options=options)

    async def wait_until_ready(self, channel: grpc.aio.Channel) -> None:
        """Waits for the connection, as long as it may still come about: a server that is not there yet may start.

        Raises:
            RemoteError: both ends will never agree: a certificate is refused, or only one of them speaks TLS.
        """
        ready = asyncio.ensure_future(channel.channel_ready())
        try:
            while not (await asyncio.wait({ready}, timeout=LOOK_INTERVAL_S))[0]:
                if channel.get_state() is grpc.ChannelConnectivity.TRANSIENT_FAILURE:
                    await self.explain_failure()
            await ready
        finally:
            ready.cancel()

    async def explain_failure(self) -> None:
        """Looks why a connection does not come about; returns where waiting may help.

        Raises:
            RemoteError: it will not.
        """
        security = self._security
        reason = await asyncio.to_thread(
            diagnose,
            self.address,
            tls=self.tls,
            server_name=security.server_name,
            authorities=security.authorities,
            pair=None if security.certificate is None or security.key is None else (security.certificate, security.key),
        )
        if reason is not None:
            raise RemoteError(f"{self.address} {reason}")
