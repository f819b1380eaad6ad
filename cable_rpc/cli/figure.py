"""`cable-rpc figure`: example frames of several drives, strategy by strategy, as a figure of a paper."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from cable_rpc.cli.roi_options import roi_config
from cable_rpc.cli.skip_bad import SkipBad, bad_frames_listed
from cable_rpc.cli.stream import parse_size
from cable_rpc.cloud.backends import BackendOptions, Detector, Segmenter, load_detector, load_segmenter
from cable_rpc.data.source import open_source
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.qualitative_figure import FigureRow, FigureSettings, figure_rows
from cable_rpc.study.strategies import STRATEGIES
from cable_rpc.wire.convert import CODECS_BY_NAME


def figure(
    sources: Annotated[
        list[str], typer.Argument(help="Drives as in stream --source, a row for each; several.", metavar="SOURCE...")
    ],
    out: Annotated[Path, typer.Option(help="PNG or PDF file to write.")] = Path("out/figure.png"),
    frames: Annotated[
        str | None,
        typer.Option(
            help="Numbers of the frames to show of each drive, e.g. 0,40,80. Without: the first from frame 30 on that "
            "is not sent whole.",
            metavar="N,N,...",
        ),
    ] = None,
    strategy: Annotated[
        list[str] | None,
        typer.Option(
            help="A column for each, repeatable; motion-only and cable by default. The last one's region is shown as "
            "a mask too. Known: " + ", ".join(STRATEGIES) + "."
        ),
    ] = None,
    mode: Annotated[
        str, typer.Option(help="robust: made for the road | paper: the published method to the letter.")
    ] = "robust",
    roi: Annotated[
        list[str] | None,
        typer.Option(help="Change one switch of the mode, e.g. corridor=false; repeatable.", metavar="KEY=VALUE"),
    ] = None,
    codec: Annotated[str, typer.Option(help=" | ".join(CODECS_BY_NAME) + ".")] = "h264",
    quality: Annotated[int | None, typer.Option(help="As in stream; the codec's default without.")] = None,
    segmenter: Annotated[str, typer.Option(help="As in serve.")] = "embedded",
    detector: Annotated[str, typer.Option(help="As in serve.")] = "embedded",
    device: Annotated[str, typer.Option(help="auto | cpu | cuda.")] = "auto",
    threads: Annotated[int, typer.Option(help="CPU threads of one model.", min=1)] = 1,
    prompt: Annotated[str, typer.Option(help="Sentence for an open-vocabulary segmenter.")] = "",
    min_score: Annotated[float, typer.Option(help="Detections below are dropped.", min=0.0, max=1.0)] = 0.4,
    size: Annotated[str | None, typer.Option(help="Resize to WIDTHxHEIGHT before anything else.")] = None,
    fps: Annotated[float | None, typer.Option(help="Thin drives to this rate; rate of image folders.")] = None,
    skip_bad: SkipBad = False,
) -> None:
    """Show example frames: original, whole frame, each strategy's region with its detections, region mask.

    Every strategy runs over the drive from its beginning through the real loop in lock-step, coded and decoded by the
    real codec, so that a frame looks as it does in a run.

    Example: [bold]cable-rpc figure synthetic:8 video:drive.mp4 --frames 40 --out fig5.pdf[/bold]
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigurationError("a figure needs matplotlib: pip install 'cable-rpc[study]'")
    from cable_rpc.study.qualitative_figure_drawing import check_suffix, write_figure

    check_suffix(out)
    if codec not in CODECS_BY_NAME:
        raise ConfigurationError(f"--codec is '{codec}'; use one of {', '.join(CODECS_BY_NAME)}")
    chosen = tuple(dict.fromkeys(strategy or ("motion-only", "cable")))
    settings = FigureSettings(chosen, roi_config(mode, roi or ()), codec, quality, prompt, min_score)
    numbers = frame_numbers(frames)
    rows: list[FigureRow] = []
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn())
    with bad_frames_listed(skip_bad) as bad_frames:
        opened = [open_source(source, size=parse_size(size), fps=fps, bad_frames=bad_frames) for source in sources]
        models = load_models(detector, segmenter, BackendOptions(device, threads, min_score))
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            for source in opened:
                task = progress.add_task(source.name, total=max(numbers) + 1 if numbers else None)
                rows += figure_rows(source, numbers, settings, *models, FrameProgress(progress, task))
        write_figure(rows, out)
        print(f"wrote {out}")


@dataclass
class FrameProgress:
    """Shows how far a drive is."""

    progress: Progress
    task: TaskID

    def __call__(self, index: int) -> None:
        """One more frame is done."""
        self.progress.update(self.task, completed=index + 1)


def frame_numbers(text: str | None) -> tuple[int, ...]:
    """``"0,40,80"`` as numbers without repeats; none for None.

    Raises:
        ConfigurationError: it is anything else.
    """
    if text is None:
        return ()
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise ConfigurationError(f"--frames is '{text}'; write numbers from 0 on, joined by commas, e.g. 0,40,80")
    return tuple(dict.fromkeys(int(part) for part in parts))


def load_models(detector: str, segmenter: str, options: BackendOptions) -> tuple[Detector, Segmenter]:
    """What perceives.

    Raises:
        ConfigurationError: unknown back end, or its extra is not installed.
        ModelError: a model can't be loaded.
    """
    try:
        return load_detector(detector, options), load_segmenter(segmenter, options)
    except ModuleNotFoundError as error:
        raise ConfigurationError(f"{error.name} is missing: pip install 'cable-rpc[cloud]'") from error
