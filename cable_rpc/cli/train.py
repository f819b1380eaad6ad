"""`cable-rpc train`: make the embedded models anew."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, track
from rich.table import Table

from cable_rpc.errors import ConfigurationError

if TYPE_CHECKING:
    from cable_models.training.detector_evaluation import Evaluation
    from cable_models.training.train_rtdetr import StepReport, TrainConfig

    from cable_rpc.study.train_detector import DetectorFiles

train_app = typer.Typer(help="Train the models that ship with the package.", no_args_is_help=True)


class Step(StrEnum):
    """Parts of the making of a detector."""

    RENDER = "render"
    TRAIN = "train"
    EXPORT = "export"
    JUDGE = "judge"


@train_app.callback()
def train_root() -> None:
    """Train the models that ship with the package."""


@train_app.command()
def detector(
    work: Annotated[Path, typer.Argument(help="Folder for rendered frames, weights and state.", metavar="WORK_DIR")],
    minutes: Annotated[float, typer.Option(help="Training time in all, over all sittings.", min=0.01)] = 120.0,
    steps: Annotated[
        int | None, typer.Option(help="Length in steps instead of minutes; repeats exactly.", min=1)
    ] = None,
    frames: Annotated[int, typer.Option(help="Rendered frames to learn from.", min=1)] = 3000,
    held_out: Annotated[int, typer.Option(help="Rendered frames of other scenes to judge by.", min=1)] = 84,
    batch: Annotated[int, typer.Option(help="Images per step at full size.", min=1)] = 8,
    threads: Annotated[int, typer.Option(help="CPU threads.", min=1)] = 1,
    seed: Annotated[int, typer.Option(help="Seed of weights, order and augmentation.", min=0)] = 0,
    device: Annotated[str, typer.Option(help="torch device: cpu, cuda, cuda:1 ...")] = "cpu",
    resume: Annotated[
        bool, typer.Option("--resume/--fresh", help="Go on where the last sitting stopped, or start anew.")
    ] = True,
    initial: Annotated[
        Path | None, typer.Option(help="Weights of an earlier training to start from (safetensors).")
    ] = None,
    only: Annotated[
        list[Step] | None, typer.Option(help="Do this step alone, repeatable; all of them by default.")
    ] = None,
    clip: Annotated[
        list[str] | None,
        typer.Option(help="Judge on a labelled clip too: kitti-tracking:FOLDER | camvid:FOLDER; repeatable."),
    ] = None,
    target: Annotated[Path | None, typer.Option(help="ONNX file to write, in WORK_DIR by default.")] = None,
) -> None:
    """Render scenes, train the compact RT-DETR on them, export it to ONNX, prove the export and judge it.

    Stop with Ctrl-C whenever you like: the same command goes on from there, in a later sitting too.
    A longer --minutes prolongs a training that is done.

    Rendering and training can run side by side, since training takes up new frames as they appear:
    [bold]cable-rpc train detector WORK --only render &[/bold] and
    [bold]cable-rpc train detector WORK --only train --only export --only judge[/bold]
    """
    use_threads(threads)
    from cable_models.training.train_rtdetr import TrainConfig

    from cable_rpc.study.train_detector import DetectorFiles

    console = Console()
    files = DetectorFiles(work)
    wanted = set(only or Step)
    if Step.RENDER in wanted:
        render_frames(files, frames, held_out, console)
    if Step.TRAIN in wanted:
        if not resume:
            files.training.state.unlink(missing_ok=True)
        config = TrainConfig(minutes=minutes, steps=steps, batch=batch, seed=seed)
        finished = train_with_progress(files, config, device, initial, console)
        if not finished:
            console.print("stopped; the same command goes on from here", highlight=False)
            raise typer.Exit(130)
    onnx = target or files.onnx
    if Step.EXPORT in wanted:
        export(files, onnx, console)
    if Step.JUDGE in wanted:
        judge(files, onnx, clip or [], console)


def use_threads(threads: int) -> None:
    """Bounds the threads of torch and OpenCV.

    Raises:
        ConfigurationError: torch or transformers is not installed.
    """
    try:
        import cv2
        import torch
        import transformers  # noqa: F401 - only to see that it is there
    except ImportError as error:
        raise ConfigurationError(f"training needs {error.name}: pip install 'cable-rpc[cloud]'") from error
    cv2.setNumThreads(threads)
    torch.set_num_threads(threads)


def render_frames(files: DetectorFiles, frames: int, held_out: int, console: Console) -> None:
    """Renders what is missing of both sets."""
    from cable_rpc.study.rendered_frames import HELD_OUT_PLAN, TRAINING_PLAN, render_into

    sets = ((files.held_out_frames, HELD_OUT_PLAN, held_out), (files.train_frames, TRAINING_PLAN, frames))
    for folder, plan, count in sets:
        rendering = render_into(folder, plan, count)
        for _ in track(rendering, f"rendering {folder.name}", total=count, console=console):
            pass


def train_with_progress(
    files: DetectorFiles, config: TrainConfig, device: str, initial: Path | None, console: Console
) -> bool:
    """Trains and shows how it goes; False where it was interrupted."""
    from cable_models.training.train_rtdetr import share_gone

    from cable_rpc.study.train_detector import train_detector

    bar = Progress(
        TextColumn("training"), BarColumn(), TextColumn("{task.percentage:3.0f} %"), MofNCompleteColumn(),
        TimeElapsedColumn(), TextColumn("{task.fields[figures]}"), console=console,
    )  # fmt: skip
    losses: list[float] = []

    with stop_on_signals() as stopped, bar:
        task = bar.add_task("training", total=1000, figures="")

        def show(report: StepReport) -> None:
            losses.append(report.loss)
            recent = losses[-50:]
            figures = f"step {report.progress.step}  loss {sum(recent) / len(recent):.2f}"
            if report.progress.best >= 0:
                figures += f"  best AP50 {report.progress.best:.3f}"
            bar.update(task, completed=int(1000 * min(1.0, report.share_gone)), figures=figures)
            if report.evaluation is not None:
                bar.console.print(f"step {report.progress.step}: {one_line(report.evaluation)}", highlight=False)

        progress = train_detector(
            files, config, device=device, initial=initial, listener=show, should_stop=stopped.is_set
        )
    return share_gone(config, progress) >= 1


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set, so that a training stops between two steps with its state written."""
    stopped = threading.Event()
    before = {number: signal.signal(number, lambda *_: stopped.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def export(files: DetectorFiles, target: Path, console: Console) -> None:
    """Exports the best weights and prints how near the file is to torch."""
    from cable_rpc.study.train_detector import export_detector

    report = export_detector(files, target)
    console.print(
        f"wrote {report.path}, {report.bytes / 1e6:.1f} MB; ONNX Runtime within {report.worst_box_px:.4f} px "
        f"and {report.worst_score:.6f} of torch",
        highlight=False,
    )


def judge(files: DetectorFiles, target: Path, clips: Sequence[str], console: Console) -> None:
    """Prints the figures of the exported file on the held-out frames and on labelled clips."""
    from cable_models.training.detector_evaluation import EVERY_OBJECT, HALF_VISIBLE, Counted
    from cable_models.training.labelled_clips import read_clip

    from cable_rpc.study.train_detector import onnx_figures

    sets = {"held-out rendered frames": files.held_out(), **{name: read_clip(name) for name in clips}}
    for name, samples in sets.items():
        large, free, every = onnx_figures(target, samples, (Counted(), HALF_VISIBLE, EVERY_OBJECT))
        console.print(figures_table(f"{name}, objects of 6 % of the height and more", large))
        console.print(figures_table(f"{name}, those of them that are at least half visible", free))
        console.print(figures_table(f"{name}, smaller objects too", every))


def one_line(evaluation: Evaluation) -> str:
    """The groups' AP50."""
    parts = [f"{name} {figures.ap50:.3f}" for name, figures in evaluation.groups.items() if figures.objects]
    return f"held-out AP50 {evaluation.mean_ap50:.3f} ({', '.join(parts)})"


def figures_table(title: str, evaluation: Evaluation) -> Table:
    """Held-out figures by group and class."""
    from cable_models.rtdetr.labels import COCO80_NAMES

    table = Table(title=f"{title}: mean AP50 {evaluation.mean_ap50:.3f}", title_justify="left")
    for heading in ("", "objects", "AP50", "precision", "recall", "F1"):
        table.add_column(heading, justify="left" if not heading else "right")
    classes = {COCO80_NAMES[int(index)]: figures for index, figures in evaluation.classes.items()}
    for name, row in {**evaluation.groups, **classes}.items():
        figures = (row.ap50, row.precision, row.recall, row.f1)
        table.add_row(name, str(row.objects), *(f"{figure:.2f}" for figure in figures))
    return table
