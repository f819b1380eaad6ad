"""`cable-rpc tables`: the paper's two tables, measured, with what they leave out beside them."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from cable_rpc.cli.roi_options import region_treatment, roi_config
from cable_rpc.cli.stream import parse_size
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.strategies import STRATEGIES
from cable_rpc.wire.convert import CODECS_BY_NAME

if TYPE_CHECKING:
    from cable_rpc.study.tables.cells import Cell
    from cable_rpc.study.tables.settings import RunSettings, SequenceRequest

LOG_WIDTH = 120
"""Columns where the output is no terminal."""
DEFAULT_STRATEGIES = "cable,open-loop,motion-only,no-corridor,full-frame"
TABLES = ("1", "2", "both")

PUBLISHED_TREATMENT = ("fill=zero", "refill=constant", "crop=none")
"""The paper's upload, as changes of the default treatment."""


def tables(
    data: Annotated[
        list[str],
        typer.Option(
            help="A sequence as SCHEME:ROOT#SEQUENCE, all sequences of a data set as SCHEME:ROOT, or synthetic:SEED, "
            "video:FILE; repeatable. Sequences of one scheme share a row.",
            metavar="SCHEME:...",
        ),
    ],
    strategies: Annotated[
        str,
        typer.Option(
            help="Strategies of table II, with commas; the first is the one of table I. Known: "
            + ", ".join(STRATEGIES)
            + "."
        ),
    ] = DEFAULT_STRATEGIES,
    reproduce: Annotated[
        bool,
        typer.Option(
            "--reproduce",
            help="The published method to the letter, black outside the region for codec and models, averaged over "
            "frames as the paper does. Without: the robust mode, counts pooled over frames.",
        ),
    ] = False,
    table: Annotated[str, typer.Option(help="1 (across data sets) | 2 (strategies) | both.")] = "both",
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for tables.md, table1.tex, table1.csv, table2.tex, table2.csv, figures.csv and the cells."
        ),
    ] = Path("out/tables"),
    workers: Annotated[int, typer.Option(help="Processes, each with its own models and one sequence.", min=1)] = 2,
    max_frames: Annotated[int | None, typer.Option(help="Frames of each sequence at most.", min=1)] = None,
    size: Annotated[str | None, typer.Option(help="Resize to WIDTHxHEIGHT before anything else.")] = None,
    fps: Annotated[float | None, typer.Option(help="Thin sequences of a higher rate to this one.")] = None,
    segmenter: Annotated[str, typer.Option(help="As in serve: embedded | boxes | lisa:FOLDER_OR_HUB_ID | ...")] = (
        "embedded"
    ),
    detector: Annotated[str, typer.Option(help="As in serve: embedded | onnx:FILE | rtdetr:FOLDER_OR_HUB_ID.")] = (
        "embedded"
    ),
    device: Annotated[str, typer.Option(help="auto | cpu | cuda.")] = "auto",
    threads: Annotated[int, typer.Option(help="CPU threads of each model.", min=1)] = 1,
    codec: Annotated[str, typer.Option(help=" | ".join(CODECS_BY_NAME) + "; whole frames are always h264.")] = "h264",
    quality: Annotated[
        int | None, typer.Option(help="JPEG/WebP quality 1..100 (75), video CRF (H.264: 0..51, 28; lower is better).")
    ] = None,
    treatment: Annotated[
        list[str] | None,
        typer.Option(
            help="Change how regions are treated before coding, as in stream; repeatable.", metavar="KEY=VALUE"
        ),
    ] = None,
    roi: Annotated[
        list[str] | None,
        typer.Option(help="Change one switch of the mode, e.g. ego_model=flow; repeatable.", metavar="KEY=VALUE"),
    ] = None,
    block_size: Annotated[int, typer.Option(help="Grid that the region is grown to; 1 = exact.", min=1)] = 8,
    prompt: Annotated[str, typer.Option(help="Sentence for an open-vocabulary segmenter.")] = "",
    skip_bad: Annotated[
        bool, typer.Option("--skip-bad", help="Leave damaged frames and label rows out, and list them.")
    ] = False,
    equal_quality: Annotated[
        bool,
        typer.Option(help="Code whole frames at six more CRFs, for the bytes saved at equal PSNR inside the region."),
    ] = True,
) -> None:
    """Make the paper's two tables on your data: pixels, true bytes, tokens, prefill, recognition, detection, latency.

    Every frame is sent whole, in H.264, and by each strategy, through the real encoder, messages, decoder
    and models, in lock-step and without a link.

    Example: [bold]cable-rpc tables --data nuscenes:/data/nuscenes --data kitti:/data/kitti --reproduce[/bold]

    Without any data set at hand: [bold]cable-rpc tables --data synthetic:90100 --data synthetic:90101
    --data synthetic:90102 --max-frames 60 --size 640x360[/bold]

    Cells are kept as they come. Stop with Ctrl-C whenever you like; the same command goes on from there.
    """
    if table not in TABLES:
        raise ConfigurationError(f"--table is '{table}'; use {', '.join(TABLES)}")
    if codec not in CODECS_BY_NAME:
        raise ConfigurationError(f"--codec is '{codec}'; use one of {', '.join(CODECS_BY_NAME)}")
    names = parse_strategies(strategies)
    from cable_rpc.study.tables.data_sets import sequence_requests
    from cable_rpc.study.tables.report import TableReport, write_report
    from cable_rpc.study.tables.settings import RunSettings

    settings = RunSettings(
        roi=roi_config("paper" if reproduce else "robust", roi or ()),
        codec=codec,
        quality=quality,
        treatment=region_treatment(codec, [*(PUBLISHED_TREATMENT if reproduce else ()), *(treatment or ())]),
        block_size=block_size,
        segmenter=segmenter,
        detector=detector,
        device=device,
        threads=threads,
        prompt=prompt,
        max_frames=max_frames,
        size=parse_size(size),
        fps=fps,
        skip_bad=skip_bad,
        equal_quality=equal_quality,
    )
    cells = run_with_progress(sequence_requests(data), names, settings, out, workers)
    report = TableReport(
        cells,
        names,
        settings,
        by_frame=reproduce,
        wanted=TABLES[:2] if table == "both" else (table,),
        workers=workers,
        command_line=shlex.join(["cable-rpc", *sys.argv[1:]]),
    )
    console = Console(width=None if sys.stdout.isatty() else LOG_WIDTH)
    console.print(report.draw(), highlight=False)
    console.print("wrote " + ", ".join(str(path) for path in write_report(report, out)), highlight=False)
    if report.failed:
        count = f"{len(report.failed)} of {len(cells)}"
        print(f"cable-rpc: {count} cells failed; the same command tries them again", file=sys.stderr)
        raise typer.Exit(1)


def parse_strategies(text: str) -> tuple[str, ...]:
    """ "cable,open-loop" as names, each once.

    Raises:
        ConfigurationError: a name is unknown, or there is none.
    """
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    kinds = {name.partition(":")[0] for name in STRATEGIES}
    for name in names:
        if name.partition(":")[0] not in kinds:
            raise ConfigurationError(f"--strategies: '{name}' is unknown; use {', '.join(STRATEGIES)}")
    if not names:
        raise ConfigurationError(f"--strategies is empty; use {', '.join(STRATEGIES)}")
    return names


def run_with_progress(
    requests: Sequence[SequenceRequest], strategies: Sequence[str], settings: RunSettings, out: Path, workers: int
) -> list[Cell]:
    """Measure with a bar on stderr; Ctrl-C says what is kept.

    Raises:
        ConfigurationError: what the engine raises.
    """
    from cable_rpc.study.tables.cells import CELLS_FOLDER
    from cable_rpc.study.tables.engine import run_cells
    from cable_rpc.study.tables.progress import CellProgress

    with CellProgress(len(requests) * len(strategies)) as progress:
        try:
            return run_cells(requests, strategies, settings, out, workers=workers, listener=progress.update)
        except KeyboardInterrupt:
            progress.stop()
            print(
                f"cable-rpc: stopped; {progress.done} of {progress.total} cells are kept in {out / CELLS_FOLDER}; "
                "the same command goes on from there",
                file=sys.stderr,
            )
            raise typer.Exit(130) from None
