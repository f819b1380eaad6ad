"""Options of every command that connects to a server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cable_rpc.edge.channel import TOKEN_VARIABLE, ClientSecurity, read_token

Tls = Annotated[bool, typer.Option("--tls", help="Speak TLS; so does --target grpcs://HOST:PORT.")]
TlsCa = Annotated[
    Path | None,
    typer.Option(help="PEM of the authority that the server's certificate must descend from.", metavar="FILE"),
]
TlsCert = Annotated[
    Path | None, typer.Option(help="PEM chain to show to a server that asks for a certificate.", metavar="FILE")
]
TlsKey = Annotated[Path | None, typer.Option(help="PEM key of --tls-cert, without a password.", metavar="FILE")]
TlsServerName = Annotated[
    str, typer.Option(help="Name that the server's certificate is made out to, where that is not the target's host.")
]
TokenFile = Annotated[
    Path | None,
    typer.Option(help=f"File with the token to send; without it, the variable {TOKEN_VARIABLE}.", metavar="FILE"),
]


def client_security(
    *, tls: bool, ca: Path | None, certificate: Path | None, key: Path | None, server_name: str, token_file: Path | None
) -> ClientSecurity:
    """What the options ask for.

    Raises:
        ConfigurationError: the token can't be read.
    """
    return ClientSecurity(tls, ca, certificate, key, server_name, read_token(token_file))
