"""Traces of single frames: options of both ends, and what they open."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from cable_rpc.edge.frame_trace import EdgeTracing
from cable_rpc.tracing.otlp import open_otlp
from cable_rpc.tracing.spans import SpanSink

PANEL = "Operations"
USUAL_INTERVAL = 30
"""With a collector but no number: a trace every second or so."""

Otlp = Annotated[
    str,
    typer.Option(
        "--otlp",
        help="OpenTelemetry collector (OTLP over gRPC) for traces of single frames, grpcs://HOST:PORT with TLS; needs "
        "the tracing extra.",
        metavar="HOST:PORT",
        rich_help_panel=PANEL,
    ),
]
TraceEvery = Annotated[
    int | None,
    typer.Option(
        "--trace-every",
        help=f"Trace one of so many frames through both ends; {USUAL_INTERVAL} with --otlp, else none. Without --otlp "
        "only the server tells of them.",
        min=1,
        rich_help_panel=PANEL,
    ),
]


@contextmanager
def server_spans(otlp: str) -> Iterator[SpanSink | None]:
    """Where the server's spans go; None without a collector.

    Raises:
        ConfigurationError: the address is none, or the extra is missing.
    """
    if not otlp:
        yield None
        return
    with open_otlp(otlp, "cable-rpc-server") as sink:
        yield sink


@contextmanager
def edge_tracing(otlp: str, every: int | None) -> Iterator[EdgeTracing]:
    """What the edge traces, and where its spans go.

    Raises:
        ConfigurationError: the address is none, or the extra is missing.
    """
    if not otlp:
        yield EdgeTracing(every or 0)
        return
    with open_otlp(otlp, "cable-rpc-edge") as sink:
        yield EdgeTracing(every or USUAL_INTERVAL, sink)
