"""`cable-rpc doctor --server`: what a server says of itself, and how far away it is."""

from __future__ import annotations

import asyncio
import json
import sys
from dataclasses import asdict

from rich.console import Console

from cable_rpc.edge.channel import ClientSecurity, SecureTarget
from cable_rpc.edge.server_probe import ServerReport, ask_server

PROBE_TIMEOUT_S = 5.0


def ask_and_print(target: str, security: ClientSecurity, *, as_json: bool) -> None:
    """Asks a server and prints what it says.

    Raises:
        ConfigurationError: target, certificates or token can't be used.
        RemoteError: it can't be reached, or does not let us in.
    """
    way = SecureTarget(target, security)
    for warning in way.warnings:
        print(f"cable-rpc: {warning}", file=sys.stderr)
    report = asyncio.run(ask_server(way, PROBE_TIMEOUT_S))
    if as_json:
        print(json.dumps(asdict(report), indent=2))
        return
    console = Console(highlight=False)
    for line in report_lines(report):
        console.print(line, markup=False)


def report_lines(report: ServerReport) -> list[str]:
    """The report for people."""
    return [
        f"{report.address}: {report.version}, {'TLS' if report.tls else 'plain text'}, "
        f"{report.round_trip_ms:.1f} ms there and back",
        f"  health   {report.health}",
        f"  models   {', '.join(report.models) or 'none'}",
        f"  codecs   {', '.join(report.codecs) or 'none'}",
        f"  grants   {report.max_in_flight} frames in flight of up to {report.max_frame_bytes} bytes "
        f"and {report.max_pixels / 1e6:.1f} Mpixel",
    ]
