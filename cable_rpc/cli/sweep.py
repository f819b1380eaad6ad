"""`cable-rpc sweep`: bitrate against quality over a grid of settings."""

from __future__ import annotations

import importlib.util
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from cable_rpc.cli.sweep_flags import AxisFlags, SweepFlags, text_of_flags, text_with_flags
from cable_rpc.errors import CableError, ConfigurationError
from cable_rpc.study.strategies import STRATEGIES
from cable_rpc.wire.convert import CODECS_BY_NAME

if TYPE_CHECKING:
    from cable_rpc.study.sweep.config import SweepConfig
    from cable_rpc.study.sweep.executors import Executor
    from cable_rpc.study.sweep.run_folder import SweepRun

LOG_WIDTH = 120
"""Columns where the output is no terminal."""
OUT = Path("out/sweep")
ENGINES = ("local", "ray")
LOCAL_WORKERS = 2
AXIS = "Axis: "


def sweep(
    config: Annotated[
        Path | None, typer.Argument(help="YAML file, see docs/sweep.md; none where options say it all.")
    ] = None,
    data: Annotated[
        list[str] | None,
        typer.Option(
            help=AXIS + "video:FILE, video:FOLDER of images, synthetic:SEED, SCHEME:ROOT#SEQUENCE, or SCHEME:ROOT for "
            "all sequences of a data set; repeatable, as every axis.",
            metavar="SCHEME:...",
        ),
    ] = None,
    strategy: Annotated[
        list[str] | None, typer.Option(help=AXIS + ", ".join(STRATEGIES) + ". Without: cable.", metavar="A,B")
    ] = None,
    treatment: Annotated[
        list[str] | None,
        typer.Option(
            help=AXIS + "how regions are treated before coding, as changes of what measured best, e.g. "
            "soft:fill=keep,quantiser_offset=0.4.",
            metavar="LABEL[:KEY=VALUE,...]",
        ),
    ] = None,
    codec: Annotated[list[str] | None, typer.Option(help=AXIS + ", ".join(CODECS_BY_NAME) + ". Without: h264.")] = None,
    quality: Annotated[
        list[str] | None,
        typer.Option(
            help=AXIS
            + "JPEG/WebP 1..100, video CRF, at least five for a BD-rate; CODEC=A,B,C for one of several codecs. "
            "Without: the usual ones.",
            metavar="A,B,C",
        ),
    ] = None,
    bitrate: Annotated[
        list[str] | None,
        typer.Option(help=AXIS + "target rates in kbit/s, besides or in place of qualities.", metavar="A,B,C"),
    ] = None,
    fps: Annotated[
        list[str] | None, typer.Option(help=AXIS + "frames per second sent; null = the source's own.", metavar="A,B")
    ] = None,
    upload_scale: Annotated[
        list[str] | None,
        typer.Option(help=AXIS + "sides of the picture sent, as a share of the camera's.", metavar="A,B"),
    ] = None,
    feedback_delay: Annotated[
        list[str] | None, typer.Option(help=AXIS + "frames after which an answer is there.", metavar="A,B")
    ] = None,
    link: Annotated[
        list[str] | None,
        typer.Option(
            help=AXIS + "a simulated link, e.g. thin:uplink_kbps=1000,delay_ms=40, or none.",
            metavar="LABEL[:KEY=VALUE,...]",
        ),
    ] = None,
    roi: Annotated[
        list[str] | None,
        typer.Option(
            help="Change the ROI settings, e.g. mode=paper or top_margin=0.2; repeatable.", metavar="KEY=VALUE"
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Of the sweep.")] = None,
    detector: Annotated[
        str | None, typer.Option(help="As in serve: embedded | onnx:FILE | rtdetr:FOLDER_OR_HUB_ID.")
    ] = None,
    segmenter: Annotated[
        str | None, typer.Option(help="As in serve: embedded | boxes | lisa:FOLDER_OR_HUB_ID | ...")
    ] = None,
    device: Annotated[str | None, typer.Option(help="auto | cpu | cuda.")] = None,
    threads: Annotated[int | None, typer.Option(help="CPU threads of each model.", min=1)] = None,
    prompt: Annotated[str | None, typer.Option(help="Sentence for an open-vocabulary segmenter.")] = None,
    truth: Annotated[
        str | None,
        typer.Option(
            help="What objects are judged by: annotated | detector (its finds on uncompressed frames) | auto."
        ),
    ] = None,
    max_frames: Annotated[int | None, typer.Option(help="Frames of each sequence at most.", min=1)] = None,
    size: Annotated[str | None, typer.Option(help="Resize to WIDTHxHEIGHT before anything else.")] = None,
    out: Annotated[Path | None, typer.Option(help=f"Folder of the run. Without: {OUT}/NAME.")] = None,
    store: Annotated[
        Path | None, typer.Option(help="File of cells, which sweeps share. Without: cells.sqlite beside the folder.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            help=f"Cells beside each other, each with its own models. Without: {LOCAL_WORKERS}; Ray: all CPUs.", min=1
        ),
    ] = None,
    engine: Annotated[
        str, typer.Option(help="local: processes | ray: tasks, on a cluster or on this machine.")
    ] = "local",
    cpus_per_cell: Annotated[float, typer.Option(help="That a Ray task asks for.")] = 1.0,
    gpus_per_cell: Annotated[float, typer.Option(help="That a Ray task asks for; parts of one are possible.")] = 0.0,
    ray_address: Annotated[
        str | None,
        typer.Option(help="Of a cluster: auto, HOST:6379 or ray://HOST:10001. Without: RAY_ADDRESS, or a Ray here."),
    ] = None,
    keep_clips: Annotated[
        bool, typer.Option("--keep-clips", help="Leave the decoded clips beside the store, for the next sweep.")
    ] = False,
    report: Annotated[bool, typer.Option(help="Write the HTML report at the end.")] = True,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Say how many cells there are, and how many of them are done; measure none."),
    ] = False,
) -> None:
    """Sweep bitrate against quality: sequences x strategies x treatments x codecs x qualities x rates x delays x links.

    Each cell is one sequence through the loop at one combination of settings, judged by what the
    same models find on uncompressed frames. Whole frames in H.264, the anchor, come by themselves.

    Example: [bold]cable-rpc sweep --data video:drive.mp4 --codec h264 --quality 20,24,28,32,36,40
    --treatment frozen --treatment soft:fill=keep,quantiser_offset=0.4[/bold]

    From a file, after a look at how much it is: [bold]cable-rpc sweep my.yaml --dry-run[/bold],
    [bold]cable-rpc sweep my.yaml --workers 4[/bold]

    Cells are kept as they come. Stop with Ctrl-C, or kill it, whenever you like: the same command
    goes on from there, and another sweep takes over the cells that it shares.
    """
    given = {
        "name": name, "detector": detector, "segmenter": segmenter, "device": device, "threads": threads,
        "prompt": prompt, "truth": truth, "max_frames": max_frames, "size": size,
    }  # fmt: skip
    axes = AxisFlags(
        data or (), strategy or (), treatment or (), codec or (), quality or (), bitrate or (), fps or (),
        upload_scale or (), feedback_delay or (), link or (), roi or (),
    )  # fmt: skip
    flags = SweepFlags(axes, {key: value for key, value in given.items() if value is not None})
    plan = configured(config, flags)
    folder = out or OUT / plan.name
    for note in plan.notes:
        print(f"cable-rpc: {note}", file=sys.stderr)
    console = Console(width=None if sys.stdout.isatty() else LOG_WIDTH)
    if dry_run:
        from cable_rpc.cli.sweep_plan import render_plan
        from cable_rpc.study.sweep.engine import STORE_FILE

        console.print(render_plan(plan, store or folder.parent / STORE_FILE, workers or LOCAL_WORKERS), highlight=False)
        return
    executor = chosen_executor(engine, workers, cpus_per_cell, gpus_per_cell, ray_address)
    done = run_with_progress(plan, folder, executor, store, keep_clips=keep_clips)
    tell_results(console, done, report=report)
    if not any(cell.result for cell in done.cells):
        raise typer.Exit(1)


def configured(path: Path | None, flags: SweepFlags) -> SweepConfig:
    """The configuration of a file, of options, or of both.

    Raises:
        ConfigurationError: it says what can't be done.
        SourceError: a data set's root can't be read.
    """
    from cable_rpc.study.sweep.config import config_from_text, read_text

    if path is None:
        # Its stem is the name of a sweep that was given none.
        return config_from_text(text_of_flags(flags), "sweep", numbered=False)
    return config_from_text(text_with_flags(read_text(path), str(path), flags), str(path), numbered=not flags.scalars)


def chosen_executor(engine: str, workers: int | None, cpus: float, gpus: float, address: str | None) -> Executor:
    """What measures cells beside each other.

    Raises:
        ConfigurationError: unknown engine, or unusable numbers.
    """
    from cable_rpc.study.sweep.local_executor import LocalExecutor
    from cable_rpc.study.sweep.ray_executor import RayExecutor

    if engine == "ray":
        return RayExecutor(address, workers=workers, cpus=cpus, gpus=gpus)
    if engine != "local":
        raise ConfigurationError(f"--engine is '{engine}'; use {' or '.join(ENGINES)}")
    return LocalExecutor(workers or LOCAL_WORKERS)


def run_with_progress(
    plan: SweepConfig, folder: Path, executor: Executor, store: Path | None, *, keep_clips: bool
) -> SweepRun:
    """Measure with a bar on stderr; Ctrl-C says what is kept.

    Raises:
        ConfigurationError: what the engine raises.
    """
    from cable_rpc.study.sweep.engine import STORE_FILE, run_sweep
    from cable_rpc.study.sweep.progress import SweepProgress

    command = shlex.join(["cable-rpc", *sys.argv[1:]])
    with SweepProgress() as progress:
        try:
            return run_sweep(
                plan, folder, executor=executor, store=store, listener=progress, keep_clips=keep_clips, command=command
            )
        except KeyboardInterrupt:
            kept = progress.found + progress.done - progress.failed
            where = store or folder.parent / STORE_FILE
    print(
        f"cable-rpc: stopped; {kept} of {len(plan.cells)} cells are kept in {where}; "
        "the same command goes on from there",
        file=sys.stderr,
    )
    raise typer.Exit(130)


def tell_results(console: Console, run: SweepRun, *, report: bool) -> None:
    """Print the table, what failed, and where the files are; write the report where it is wanted."""
    from cable_rpc.cli.sweep_summary import failures, render_methods
    from cable_rpc.study.sweep.run_folder import CELLS_FILE, RUN_FILE

    if any(cell.result for cell in run.cells):
        try:
            console.print(render_methods(run), highlight=False)
        except CableError as error:
            # All is measured and stored; where it lies must be told.
            print(f"cable-rpc: no table: {error}", file=sys.stderr)
    for line in failures(run):
        print(f"cable-rpc: {line}", file=sys.stderr)
    files = ", ".join(str(run.folder / name) for name in (CELLS_FILE, RUN_FILE))
    console.print(f"wrote {files}", highlight=False, soft_wrap=True)
    if report and any(cell.result for cell in run.cells):
        if missing := [name for name in ("plotly", "jinja2") if importlib.util.find_spec(name) is None]:
            console.print(f"no report without {' and '.join(missing)}: pip install 'cable-rpc\\[study]'")
        else:
            from cable_rpc.study.sweep_report import write_sweep_report

            console.print(f"report: {write_sweep_report(run)}", highlight=False, soft_wrap=True)
    console.print(
        f"the report again, from the same cells: cable-rpc report {run.folder}", highlight=False, soft_wrap=True
    )
