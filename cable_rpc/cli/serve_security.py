"""Options of `cable-rpc serve` about who may come and what each may use."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cable_rpc.errors import ConfigurationError
from cable_rpc.wire.address import is_loopback

TlsCert = Annotated[
    Path | None, typer.Option(help="PEM certificate chain of this server; with it, it speaks TLS.", metavar="FILE")
]
TlsKey = Annotated[Path | None, typer.Option(help="PEM key of --tls-cert, without a password.", metavar="FILE")]
TlsClientCa = Annotated[
    Path | None,
    typer.Option(help="PEM of authorities: every client must show a certificate of theirs.", metavar="FILE"),
]
Tokens = Annotated[
    Path | None,
    typer.Option(
        help="Who may come: lines NAME SHA256_OF_TOKEN [LIMIT=N ...], taken anew when the file changes.",
        metavar="FILE",
    ),
]
MaxStreams = Annotated[int, typer.Option(help="Streams of all clients together.", min=1)]
MaxPixelRate = Annotated[
    float | None, typer.Option(help="Announced pixels per second of all streams together, e.g. 500e6.", min=1)
]
IdentityStreams = Annotated[
    int | None, typer.Option(help="Streams of one identity that --tokens gives no limits of its own.", min=1)
]
IdentityFrameRate = Annotated[float | None, typer.Option(help="Frames per second of one such identity.", min=0.1)]
IdentityPixelRate = Annotated[float | None, typer.Option(help="Pixels per second of one such identity.", min=1)]
IdentityByteRate = Annotated[float | None, typer.Option(help="Coded bytes per second of one such identity.", min=1)]
DrainTo = Annotated[
    str, typer.Option(help="Where clients are sent when this server stops; empty = back here.", metavar="HOST:PORT")
]


def check_exposure(listen: str, *, tls: bool, proof: bool, insecure: bool) -> str | None:
    """What is to be said about listening there.

    Args:
        listen: HOST:PORT.
        tls: whether the server speaks TLS.
        proof: whether clients must prove who they are, by token or certificate.
        insecure: whether --insecure was given.

    Returns:
        A warning; None = nothing.

    Raises:
        ConfigurationError: plain text on an address that other machines reach, without --insecure.
    """
    if is_loopback(listen):
        return None
    if tls:
        return None if proof else "everybody who reaches this port can use it; add --tokens or --tls-client-ca"
    if not insecure:
        raise ConfigurationError(
            f"--listen {listen} is reachable from other machines and this server would speak plain text; "
            "give --tls-cert and --tls-key, or add --insecure if the network is trusted (a VPN or a lab), "
            "or listen on 127.0.0.1"
        )
    if proof:
        return "tokens over plain text can be taken by anybody on the way, so our clients won't send them; use TLS"
    return "everybody who reaches this port can use it and see what others stream (--insecure)"
