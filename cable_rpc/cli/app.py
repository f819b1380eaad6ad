"""The command's root and its handling of errors: one line for people."""

from __future__ import annotations

import logging
import os
import sys
from typing import Annotated

import typer
from cable_codecs import CodecError

import cable_rpc
from cable_rpc.cli.codec_study import codec_study
from cable_rpc.cli.demo import demo
from cable_rpc.cli.doctor import doctor
from cable_rpc.cli.export import export_app
from cable_rpc.cli.figure import figure
from cable_rpc.cli.inspect import inspect
from cable_rpc.cli.report import report
from cable_rpc.cli.serve import serve
from cable_rpc.cli.stream import stream
from cable_rpc.cli.sweep import sweep
from cable_rpc.cli.tables import tables
from cable_rpc.cli.train import train_app
from cable_rpc.cli.train_segmenter import segmenter
from cable_rpc.cli.verify import verify_app
from cable_rpc.errors import CableError

app = typer.Typer(
    name="cable-rpc",
    help="Edge-cloud perception that sends only what matters, measured in true bytes, milliseconds and quality.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
app.command()(serve)
app.command()(stream)
app.command()(demo)
app.command()(inspect)
app.command()(figure)
app.command()(codec_study)
app.command()(tables)
app.command()(report)
app.command()(sweep)
app.command()(doctor)
app.add_typer(verify_app, name="verify")
app.add_typer(export_app, name="export")
train_app.command()(segmenter)
app.add_typer(train_app, name="train")


def _version(wanted: bool) -> None:
    if wanted:
        print(f"cable-rpc {cable_rpc.__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log what happens, on stderr.")] = False,
) -> None:
    """Edge-cloud perception that sends only what matters."""
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
        stream=sys.stderr,
    )


def main() -> None:
    """Entry point; errors raised on purpose become one line and exit code 2 (Typer makes Ctrl-C 130)."""
    os.environ.setdefault("GRPC_VERBOSITY", "ERROR")
    try:
        app()
    except (CableError, CodecError) as error:
        print(f"cable-rpc: {error}", file=sys.stderr)
        sys.exit(2)
