"""`cable-rpc report`: a finished run as one HTML file, and a sweep's figures and tables for papers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.run_record import FRAMES_FILE, SUMMARY_FILE

SWEEP_FILE = "run.json"


def report(
    run: Annotated[
        Path, typer.Argument(help="Folder of a run, as sweep --out or stream --out named it.", metavar="RUN")
    ],
    quality: Annotated[
        str | None, typer.Option(help="What a sweep's report opens with, e.g. retention; the configuration's first.")
    ] = None,
    anchor: Annotated[
        str | None,
        typer.Option(help="Method that all others are compared with, named as in the report.", metavar="METHOD"),
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(help="Show these methods alone, named as in the report; repeatable.", metavar="METHOD"),
    ] = None,
    draws: Annotated[int, typer.Option(help="Bootstrap draws for the intervals; 0 for none.", min=0)] = 2000,
    export: Annotated[
        bool, typer.Option("--export/--no-export", help="PNG, PDF, LaTeX, Markdown and CSV in RUN/export.")
    ] = True,
    store: Annotated[
        Path | None, typer.Option(help="Where a sweep's cells lie now, if they were moved.", metavar="FILE")
    ] = None,
) -> None:
    """Make a run's report: curves, BD-rates, examples and settings in one HTML file that needs no network.

    A sweep that was stopped is reported as far as it went.

    Example: [bold]cable-rpc report out/sweep/night[/bold]
    """
    if (run / SWEEP_FILE).is_file():
        print(f"wrote {sweep_report(run, quality, anchor, method or (), draws, export=export, store=store)}")
    elif (run / FRAMES_FILE).is_file() and (run / SUMMARY_FILE).is_file():
        from cable_rpc.study.report import write_report

        print(f"wrote {write_report(run)}")
    else:
        raise ConfigurationError(
            f"{run} holds no run: a sweep leaves {SWEEP_FILE} there, a stream {FRAMES_FILE} and {SUMMARY_FILE}; name "
            "such a folder"
        )


def sweep_report(
    folder: Path,
    quality: str | None,
    anchor: str | None,
    methods: Sequence[str],
    draws: int,
    *,
    export: bool,
    store: Path | None,
) -> Path:
    """Report a sweep.

    Raises:
        ConfigurationError: it can't be read or written, or the ``study`` extra is not installed.
    """
    from cable_rpc.study.metrics import Bootstrap
    from cable_rpc.study.sweep.run_folder import read_run
    from cable_rpc.study.sweep_report import EXPORT_FOLDER, write_sweep_report

    bootstrap = Bootstrap(draws) if draws else None
    sweep = read_run(folder, store)
    with Console(stderr=True).status(f"comparing methods over {draws} draws of sequences"):
        path = write_sweep_report(
            sweep, quality=quality, anchor=anchor, only=methods, bootstrap=bootstrap, export=export
        )
    if export:
        print(f"wrote {folder / EXPORT_FOLDER}")
    return path
