"""`cable-rpc doctor`: what this machine can do, and what is missing for each role."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Annotated

import typer
from cable_codecs import CodecProbe
from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from cable_rpc.cli.connection_options import (
    Tls,
    TlsCa,
    TlsCert,
    TlsKey,
    TlsServerName,
    TokenFile,
    client_security,
)
from cable_rpc.cli.machine import BackEnd, Extra, Hardware, MachineReport, Verdict, examine_machine
from cable_rpc.cli.server_report import ask_and_print

SCHEMA_VERSION = 1
STATE_STYLES = {"ready": "bold green", "partly": "bold yellow", "missing": "bold red"}
ABSENT = Text("not installed", style="dim")


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")] = False,
    server: Annotated[
        str | None,
        typer.Option(help="Ask this server who it is instead, and say what is in the way.", metavar="HOST:PORT"),
    ] = None,
    tls: Tls = False,
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    tls_server_name: TlsServerName = "",
    token_file: TokenFile = None,
) -> None:
    """Say what this machine can do as edge, as cloud and for studies.

    Opens every encoder once and reads the versions of what is installed; loads no model. The exit code is 0 also
    where something is missing.

    Example: [bold]cable-rpc doctor --json | jq '.verdicts'[/bold]

    Is that server there, and does it let me in? [bold]cable-rpc doctor --server grpcs://gpu-box:50051 --tls-ca ca.pem
    --token-file token[/bold]
    """
    if server is not None:
        security = client_security(
            tls=tls, ca=tls_ca, certificate=tls_cert, key=tls_key, server_name=tls_server_name, token_file=token_file
        )
        ask_and_print(server, security, as_json=as_json)
        return
    report = examine_machine()
    if as_json:
        print(json.dumps({"schema_version": SCHEMA_VERSION, **asdict(report)}, indent=2))
        return
    Console(highlight=False).print(render_report(report))


def render_report(report: MachineReport) -> RenderableType:
    """All tables, the verdicts last; fits 80 columns."""
    return Group(
        versions_table(report.versions, report.hardware),
        codecs_table(report.codecs),
        closed_encoders_table(report.codecs),
        back_ends_table(report.back_ends, report.inference_providers),
        extras_table(report.extras),
        verdict_table(report.verdicts),
    )


def new_table(title: str, *columns: str, last_wraps: bool = True) -> Table:
    """An empty table in the house style."""
    table = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        header_style="dim",
        pad_edge=False,
        show_header=any(name.strip() for name in columns),
    )
    for column in columns[:-1]:
        table.add_column(column, no_wrap=True)
    table.add_column(columns[-1], no_wrap=not last_wraps, overflow="fold")
    return table


def versions_table(versions: dict[str, str | None], hardware: Hardware) -> Table:
    """Machine and software."""
    table = new_table("This machine", "", "")
    table.add_row("system", hardware.system)
    table.add_row("processors", processors_text(hardware))
    table.add_row("memory", memory_text(hardware))
    table.add_row("NVIDIA driver", "loaded" if hardware.nvidia_driver else Text("none", style="dim"))
    libraries = [f"{name} {found}" for name, found in versions.items() if name.startswith(("libav", "libsw"))]
    for name, found in versions.items():
        if name == "FFmpeg":
            table.add_row(name, f"{found} ({', '.join(libraries)})")
        elif not name.startswith(("libav", "libsw")):
            table.add_row(name, found or ABSENT)
    return table


def processors_text(hardware: Hardware) -> str:
    """Processors of the machine, of this process and of OpenCV."""
    own = "" if hardware.usable_cpus == hardware.cpu_count else f", {hardware.usable_cpus} for this process"
    return f"{hardware.cpu_count}{own}; OpenCV uses {hardware.opencv_threads} threads"


def memory_text(hardware: Hardware) -> str:
    """Memory in GiB."""
    if hardware.memory_bytes is None:
        return "unknown on this system"
    total = f"{hardware.memory_bytes / 2**30:.1f} GiB"
    if hardware.available_memory_bytes is None:
        return total
    return f"{total}, {hardware.available_memory_bytes / 2**30:.1f} GiB available"


def codecs_table(codecs: Sequence[CodecProbe]) -> Table:
    """One row for each codec: encoders that open, and the decoder."""
    table = new_table("Codecs", "codec", "encoders that open here", "decoder", last_wraps=False)
    for codec in dict.fromkeys(probe.codec for probe in codecs):
        probes = [probe for probe in codecs if probe.codec == codec]
        usable = [
            f"{probe.encoder} (hardware)" if probe.hardware else probe.encoder for probe in probes if probe.usable
        ]
        decoder = probes[0].decoder
        table.add_row(
            codec,
            Text(", ".join(usable), style="green") if usable else Text("none", style="red"),
            decoder or Text("none", style="red"),
        )
    return table


def closed_encoders_table(codecs: Sequence[CodecProbe]) -> Table:
    """Encoders that don't open, those with the same reason together."""
    table = new_table("Encoders that don't open here", "encoders", "why")
    reasons: dict[str, list[str]] = {}
    for probe in codecs:
        if not probe.usable:
            reasons.setdefault(reason_text(probe), []).append(probe.encoder)
    for reason, encoders in reasons.items():
        for row, names in enumerate(in_rows(encoders, 36)):
            table.add_row(Text(names, style="dim"), reason if row == 0 else "")
    if not reasons:
        table.add_row("none", "")
    return table


def reason_text(probe: CodecProbe) -> str:
    """The reason without the encoder's name in front, so that equal reasons read equal."""
    reason = probe.reason or "unknown"
    return reason.removeprefix(probe.encoder).strip().removeprefix("doesn't open here:").strip().removeprefix("it ")


def in_rows(names: Sequence[str], width: int) -> Iterator[str]:
    """Names joined by commas in rows of at most ``width`` characters, one name to a row at least."""
    row = ""
    for name in names:
        if row and len(row) + 2 + len(name) > width:
            yield row + ","
            row = name
        else:
            row = f"{row}, {name}" if row else name
    if row:
        yield row


def back_ends_table(back_ends: Sequence[BackEnd], providers: Sequence[str]) -> Table:
    """Detectors and segmenters by name."""
    table = new_table("Back ends for cable-rpc serve", "kind", "name", "from")
    for back_end in back_ends:
        table.add_row(back_end.kind, back_end.name, f"{back_end.module} ({back_end.package})")
    if not back_ends:
        table.add_row("none", "", "")
    table.add_row("ONNX Runtime", "", ", ".join(providers) or ABSENT)
    return table


def extras_table(extras: Sequence[Extra]) -> Table:
    """Each extra: there, or what is missing and the command that brings it."""
    table = new_table("Extras", "extra", "state", "what is missing")
    for extra in extras:
        if not extra.requirements:
            table.add_row(extra.name, Text("installed", style="green"), Text("needs nothing", style="dim"))
        elif not extra.missing:
            table.add_row(extra.name, Text("installed", style="green"), "")
        else:
            share = f"{len(extra.requirements) - len(extra.missing)} of {len(extra.requirements)}"
            lacking = ", ".join(
                f"{requirement.package} ({requirement.installed} is too old, {requirement.wanted})"
                if requirement.installed
                else requirement.package
                for requirement in extra.missing
            )
            table.add_row(extra.name, Text(share, style="yellow"), Text(f"{lacking}\n→ {extra.command}"))
    if not extras:
        table.add_row("unknown", "", "cable-rpc runs without being installed: pip install -e .")
    return table


def verdict_table(verdicts: Sequence[Verdict]) -> Table:
    """A line for each role, and what to type where something is missing."""
    table = new_table("Verdict", "", "", "")
    for verdict in verdicts:
        table.add_row(
            Text(verdict.role, style="bold"),
            Text(verdict.state, style=STATE_STYLES[verdict.state]),
            Text(verdict.reason),
        )
        for remedy in verdict.remedies:
            table.add_row("", "", Text(f"→ {remedy}", style="cyan"))
    return table
