"""`cable-rpc codec-study`: what each treatment of the background and each codec costs at equal quality."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from cable_codecs import available_codecs
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from cable_rpc.cli.stream import parse_size
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.codec_compare import COMPARISON_FILE, StudyResults, write_comparisons
from cable_rpc.study.codec_study import QUALITIES, Cell, StudyPlan, run_study
from cable_rpc.study.codec_study_tables import clips_line, render_study
from cable_rpc.study.study_points import POINTS_FILE, ClipRequest, StudyPoint
from cable_rpc.study.study_treatments import TREATMENTS

LOG_WIDTH = 150
"""Columns where the output is no terminal."""


def codec_study(
    clips: Annotated[
        list[str],
        typer.Argument(help="video:FILE, video:FOLDER of images, or synthetic:SEED; several.", metavar="CLIP..."),
    ],
    frames: Annotated[int, typer.Option(help="Frames of each clip at most.", min=1)] = 60,
    codec: Annotated[
        list[str] | None, typer.Option(help="Codec to study, repeatable; 'all' takes every lossy one that opens here.")
    ] = None,
    treatment: Annotated[
        list[str] | None,
        typer.Option(help="Treatment to study, repeatable; all by default. Known: " + ", ".join(TREATMENTS) + "."),
    ] = None,
    quality: Annotated[
        list[str] | None,
        typer.Option(
            help="Qualities of one codec, at least five of them, e.g. h264=18,23,28,33,38; repeatable.",
            metavar="CODEC=A,B,...",
        ),
    ] = None,
    mask: Annotated[
        list[str] | None,
        typer.Option(
            help="Region to keep, repeatable. corridor: a fixed moving band with four boxes, 22 % of every picture, "
            "the same for all clips | loop: what the loop itself would send, its whole keyframes included."
        ),
    ] = None,
    detector: Annotated[
        str | None,
        typer.Option(
            help="Cloud of --mask loop for clips without true masks: embedded | onnx:FILE. Clips with them ignore it."
        ),
    ] = None,
    size: Annotated[str | None, typer.Option(help="Resize to WIDTHxHEIGHT before anything else.")] = None,
    fps: Annotated[float | None, typer.Option(help="Thin a video to this rate; rate of an image folder.")] = None,
    workers: Annotated[int, typer.Option(help="Processes; each holds one clip in memory.", min=1)] = 2,
    again: Annotated[bool, typer.Option("--again", help="Measure anew what the folder holds already.")] = False,
    out: Annotated[
        Path, typer.Option(help=f"Folder for {POINTS_FILE}, {COMPARISON_FILE} and codec_study.html.")
    ] = Path("out/codec-study"),
) -> None:
    """Measure what treating the background saves: true bytes at equal quality inside the region.

    Every treatment is coded and decoded at several qualities. Its curve of bytes, masks included,
    against luma PSNR inside the region is held against that of whole frames in H.264, as
    Bjontegaard's delta: a BD-rate of -60 % is the same quality for 40 % of the bytes. Bytes at the
    same encoder setting say less, since a blank background moves the quality of the region too.

    Treatments: alignN and pixel say how the region is grown before coding, then comes what stands
    outside (a colour, blur, freeze: old pixels) or what else is done (hold: blocks stay for 5 frames,
    compose: the far end keeps old background, rows and box: cropped, half: half the resolution).
    soft-X keeps the background and quantises it coarser, by X of the quantiser's scale.

    Example: [bold]cable-rpc codec-study video:drive.mp4 synthetic:1 --frames 30[/bold]

    With the loop's own regions, a detector standing in for the cloud where there is no truth:
    [bold]cable-rpc codec-study video:drive.mp4 --mask loop --detector onnx:model.onnx[/bold]

    Only some treatments, with two codecs:
    [bold]cable-rpc codec-study synthetic:1 --codec h264 --codec jpeg --treatment align8-zero --treatment align8-rows
    [/bold]

    Results are kept as they come. Stop with Ctrl-C whenever you like; the same command goes on from there.
    """
    check_extra()
    codecs = chosen_codecs(codec or [])
    frame_size = parse_size(size)
    requests = tuple(
        ClipRequest(clip, frames, kind, detector_for(kind, clip, detector), frame_size, fps)
        for clip in clips
        for kind in dict.fromkeys(mask or ["corridor"])
    )
    treatments = tuple(dict.fromkeys(treatment or TREATMENTS))
    plan = StudyPlan(requests, treatments, tuple(codecs), parse_qualities(quality or [], codecs))
    console = Console(width=None if sys.stdout.isatty() else LOG_WIDTH)
    points = run_with_progress(plan, out, workers, again)
    results = StudyResults(points)
    for view in results.views:
        console.print(clips_line(results, view), style="dim", highlight=False)
    console.print(render_study(results))
    write_comparisons(results, out / COMPARISON_FILE)
    figure = write_study_figure(results, out)
    console.print(f"wrote {out / POINTS_FILE}, {out / COMPARISON_FILE}, {figure}", highlight=False)


def check_extra() -> None:
    """See that what the end of a study needs is there before its beginning.

    Raises:
        ConfigurationError: It isn't.
    """
    for package in ("scipy", "plotly"):
        if importlib.util.find_spec(package) is None:
            raise ConfigurationError(f"a codec study needs {package}: pip install 'cable-rpc[study]'")


def write_study_figure(results: StudyResults, folder: Path) -> Path:
    """Draw the curves.

    Raises:
        ConfigurationError: The file can't be written.
    """
    from cable_rpc.study.codec_study_figure import FIGURE_FILE, write_figure

    write_figure(results, folder / FIGURE_FILE)
    return folder / FIGURE_FILE


def chosen_codecs(names: Sequence[str]) -> list[str]:
    """The codecs to study; H.264 where none is named."""
    if "all" in names:
        return [name for name in available_codecs() if name in QUALITIES]
    return list(dict.fromkeys(names)) or ["h264"]


def parse_qualities(texts: Sequence[str], codecs: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """``["h264=18,23"]`` as a mapping.

    Raises:
        ConfigurationError: A text isn't CODEC=A,B,..., or names a codec that isn't studied.
    """
    parsed: dict[str, tuple[int, ...]] = {}
    for text in texts:
        codec, separator, numbers = text.partition("=")
        try:
            values = tuple(dict.fromkeys(int(number) for number in numbers.split(",")))
        except ValueError:
            separator, values = "", ()
        if not separator:
            raise ConfigurationError(f"--quality '{text}': write CODEC=A,B,C,D,E with whole numbers")
        if codec not in codecs and codec != "h264":
            raise ConfigurationError(f"--quality '{text}': '{codec}' isn't studied; add --codec {codec}")
        parsed[codec] = values
    return parsed


def detector_for(kind: str, clip: str, detector: str | None) -> str | None:
    """The detector that a clip's loop needs; rendered clips have true masks."""
    return None if kind == "corridor" or clip.startswith("synthetic:") else detector


@dataclass
class CellProgress:
    """Shows which cell ended last."""

    progress: Progress

    def __call__(self, cell: Cell, points: Sequence[StudyPoint]) -> None:
        """One more cell is there."""
        task = self.progress.task_ids[0]
        self.progress.update(task, advance=1, last=f"{cell.request.clip} {cell.treatment} {cell.codec}")


def run_with_progress(plan: StudyPlan, folder: Path, workers: int, again: bool) -> list[StudyPoint]:
    """Run a study with a bar on stderr; Ctrl-C says what is kept.

    Raises:
        ConfigurationError: What the study raises.
    """
    columns = (TextColumn("coding"), BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn(),
               TimeRemainingColumn(), TextColumn("{task.fields[last]}", style="dim"))  # fmt: skip
    cells = plan.cells()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("coding", total=len(cells), last="")
        try:
            return run_study(plan, folder, workers=workers, again=again, listener=CellProgress(progress))
        except KeyboardInterrupt:
            done = int(progress.tasks[task].completed)
            progress.stop()
            print(
                f"stopped: {done} of {len(cells)} cells are kept in {folder / POINTS_FILE}; "
                "the same command goes on from there",
                file=sys.stderr,
            )
            raise typer.Exit(130) from None
