"""What `serve` tells those who look after it: options."""

from __future__ import annotations

from typing import Annotated

import typer

PANEL = "Operations"

MetricsListen = Annotated[
    str,
    typer.Option(
        "--metrics-listen",
        help="HOST:PORT for Prometheus (/metrics) and plain HTTP probes (/healthz), e.g. 127.0.0.1:9464; unencrypted "
        "and open to everybody who reaches it. Off by default.",
        metavar="HOST:PORT",
        rich_help_panel=PANEL,
    ),
]
Reflection = Annotated[
    bool | None,
    typer.Option(
        "--reflection/--no-reflection",
        help="Tell the contract to tools such as grpcurl. By default where only this machine can ask, or only those "
        "who prove who they are.",
        rich_help_panel=PANEL,
    ),
]
