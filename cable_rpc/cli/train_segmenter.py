"""`cable-rpc train segmenter`: make the embedded segmenter anew."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, track
from rich.table import Table

if TYPE_CHECKING:
    from cable_models.training.segmentation_evaluation import MaskFigures
    from cable_models.training.segmentation_stages import SegmenterTraining, Stage
    from cable_models.training.segmentation_trainer import StageConfig, StageProgress

    from cable_rpc.study.train_segmenter import SegmenterFigures


class SegmenterStage(StrEnum):
    """Parts of the making of a segmenter."""

    RENDER = "render"
    ENCODER = "encoder"
    DECODER = "decoder"
    LANGUAGE = "language"
    EXPORT = "export"


def segmenter(
    work: Annotated[Path, typer.Argument(help="Folder for rendered frames and checkpoints.", metavar="WORK_DIR")],
    minutes: Annotated[float, typer.Option(help="Training time in all, over all sittings.", min=0.01)] = 240.0,
    steps: Annotated[
        int | None, typer.Option(help="Length of each stage in steps instead of minutes; repeats exactly.", min=1)
    ] = None,
    frames: Annotated[int, typer.Option(help="Rendered frames to learn from.", min=1)] = 3000,
    held_out: Annotated[int, typer.Option(help="Rendered frames of other scenes to judge by.", min=1)] = 36,
    batch: Annotated[int, typer.Option(help="Images per step.", min=1)] = 8,
    threads: Annotated[int, typer.Option(help="CPU threads.", min=1)] = 1,
    seed: Annotated[int, typer.Option(help="Seed of weights, order and augmentation.", min=0)] = 0,
    stages: Annotated[
        list[SegmenterStage] | None,
        typer.Option("--stage", help="Do this stage alone, repeatable; all of them by default."),
    ] = None,
    target: Annotated[
        Path | None, typer.Option(help="Checkpoint folder to write, new or empty; in WORK_DIR by default.")
    ] = None,
    camvid: Annotated[
        Path | None, typer.Option(help="Folder of CamVid with images and labels, to judge the result by too.")
    ] = None,
) -> None:
    """Render scenes, train the compact LISA on them, save it in LISA++'s own layout and judge it.

    Three stages: the image encoder under a dense head, the mask decoder from one token per concept, the
    language side that has to say that token. Stop with Ctrl-C whenever you like: the same command goes on
    from there. A longer --minutes prolongs a training that is done.

    Rendering and training can run side by side, since training takes up new frames as they appear:
    [bold]cable-rpc train segmenter WORK --stage render &[/bold] and
    [bold]cable-rpc train segmenter WORK --stage encoder --stage decoder --stage language --stage export[/bold]
    """
    from cable_rpc.cli.train import use_threads

    use_threads(threads)
    from cable_models.training.segmentation_stages import STAGES, SegmenterTraining
    from cable_models.training.segmentation_trainer import StageConfig

    from cable_rpc.study.region_fills import FILLS
    from cable_rpc.study.train_segmenter import CHECKPOINT_FOLDER

    console = Console()
    wanted = set(stages or SegmenterStage)
    training = SegmenterTraining(work, batch=batch, fills=FILLS, seed=seed)
    if SegmenterStage.RENDER in wanted:
        render_sets(work, frames, held_out, console)
    learnt = [stage for stage in STAGES if SegmenterStage(stage) in wanted]
    if learnt and not train_with_progress(training, learnt, StageConfig(minutes, steps, seed=seed), console):
        console.print("stopped; the same command goes on from here", highlight=False)
        raise typer.Exit(130)
    if SegmenterStage.EXPORT in wanted:
        save_and_judge(training, target or work / CHECKPOINT_FOLDER, camvid, console)


def render_sets(work: Path, frames: int, held_out: int, console: Console) -> None:
    """Renders what is missing of both sets."""
    from cable_rpc.study.rendered_frames import render_into
    from cable_rpc.study.train_segmenter import HELD_OUT_PLAN, TRAINING_PLAN, write_segmented

    for name, plan, count in (("held_out", HELD_OUT_PLAN, held_out), ("train", TRAINING_PLAN, frames)):
        rendering = render_into(work / name, plan, count, write_segmented)
        for _ in track(rendering, f"rendering {name}", total=count, console=console):
            pass


def train_with_progress(
    training: SegmenterTraining, stages: list[Stage], config: StageConfig, console: Console
) -> bool:
    """Trains and shows how it goes; False where it was interrupted."""
    from cable_rpc.cli.train import stop_on_signals
    from cable_rpc.study.train_segmenter import train_segmenter

    bar = Progress(
        TextColumn("{task.description:<9}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(),
        console=console,
    )  # fmt: skip
    with stop_on_signals() as stopped, bar:
        tasks = {stage: bar.add_task(stage, total=1.0) for stage in stages}

        def show(stage: Stage, progress: StageProgress, figures: MaskFigures | None) -> None:
            bar.update(tasks[stage], completed=progress.gone)
            losses = ", ".join(f"{name} {value:.3f}" for name, value in progress.losses.items())
            masks = "" if figures is None else f"; held-out IoU {iou_line(figures)}"
            bar.console.print(f"{stage} step {progress.step}: loss {losses}{masks}", highlight=False)

        return train_segmenter(training, stages, config, show, stopped.is_set)


def save_and_judge(training: SegmenterTraining, folder: Path, camvid: Path | None, console: Console) -> None:
    """Writes the checkpoint folder and prints its figures on held-out and, where given, on real frames."""
    from cable_rpc.study.train_segmenter import camvid_frames, held_out, judge_segmenter, save_segmenter

    judged = {"held out": held_out(training.work)} | ({} if camvid is None else {"CamVid": camvid_frames(camvid)})
    save_segmenter(training, folder)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    console.print(f"wrote {folder}, {size / 1e6:.1f} MB", highlight=False)
    for name, images in judged.items():
        console.print(figures_table(f"{name}, {len(images)} frames: pooled IoU", judge_segmenter(folder, images)))


def figures_table(title: str, figures: SegmenterFigures) -> Table:
    """IoU by concept, of whole frames and of their regions."""
    table = Table(title=title, title_justify="left")
    for heading in ("", "whole frames", "region only"):
        table.add_column(heading, justify="left" if not heading else "right")
    masked = figures.masked.as_dict()
    for name, value in figures.whole.as_dict().items():
        table.add_row(name, f"{value:.3f}", f"{masked[name]:.3f}")
    return table


def iou_line(figures: MaskFigures) -> str:
    """All concepts on one line."""
    return ", ".join(f"{name} {value:.3f}" for name, value in figures.as_dict().items())
