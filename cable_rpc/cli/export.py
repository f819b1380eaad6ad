"""`cable-rpc export`: a published model into the file that the cloud serves."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from cable_rpc.cli.stream import parse_size
from cable_rpc.data.source import open_source
from cable_rpc.data.synthetic import SyntheticSource
from cable_rpc.errors import ConfigurationError, ModelError
from cable_rpc.types import Image

if TYPE_CHECKING:
    from cable_models.rtdetr.detector_file import MadeFile

LOG_WIDTH = 130
"""Columns where the output is no terminal."""
DEFAULT_VERIFY = "synthetic:7"
SPREAD_FRAMES = 120
"""Frames of a source that is long or endless over which the chosen ones are spread."""

export_app = typer.Typer(help="Turn a published model into the file that the cloud serves.", no_args_is_help=True)


@export_app.callback()
def root() -> None:
    """Turn a published model into the file that the cloud serves."""


@export_app.command()
def rtdetr(
    checkpoint: Annotated[
        str,
        typer.Option(
            help="Folder of save_pretrained, id on the Hugging Face hub (PekingU/rtdetr_r50vd), or a compact "
            "checkpoint (its .safetensors, or the folder with it).",
            metavar="FOLDER|ID|FILE",
        ),
    ],
    out: Annotated[Path, typer.Option(help="ONNX file to write.", metavar="FILE.onnx")],
    revision: Annotated[str | None, typer.Option(help="Commit, tag or branch on the hub.")] = None,
    size: Annotated[
        str | None, typer.Option(help="Input of the network, WIDTHxHEIGHT in multiples of 32; its own by default.")
    ] = None,
    postprocess: Annotated[
        bool,
        typer.Option("--postprocess", help="Answer labels, boxes and scores (the original repository's signature)."),
    ] = False,
    batch: Annotated[int | None, typer.Option(help="Fixed batch size; any by default.", min=1)] = None,
    opset: Annotated[int, typer.Option(help="ONNX operator set.", min=16, max=20)] = 17,
    fp16: Annotated[bool, typer.Option("--fp16", help="Half precision: half the file, faster on GPUs.")] = False,
    int8: Annotated[
        bool, typer.Option("--int8", help="8-bit convolutions, calibrated on --calibrate; half the file, faster.")
    ] = False,
    verify: Annotated[
        str,
        typer.Option(help="Frames to compare with torch and to measure --fp16 and --int8 on; 'none' leaves it out."),
    ] = DEFAULT_VERIFY,
    verify_frames: Annotated[int, typer.Option(help="How many of them, spread over the source.", min=1)] = 4,
    calibrate: Annotated[
        str | None,
        typer.Option(help="Frames like those that the detector will see, for --int8: video:FILE, synthetic:SEED, ..."),
    ] = None,
    calibrate_frames: Annotated[int, typer.Option(help="How many of them.", min=8)] = 64,
    provider: Annotated[
        str, typer.Option(help="Where --fp16 and --int8 are measured: cpu | cuda | tensorrt | openvino | auto.")
    ] = "cpu",
) -> None:
    """Export RT-DETR to ONNX, and prove that the file answers as torch does.

    The file gets its name only if boxes agree within 0.5 px and scores within 0.001. It holds the labels, the
    preprocessing, the revision and this command in its metadata; serve it with --detector onnx:FILE.

    Example: [bold]cable-rpc export rtdetr --checkpoint PekingU/rtdetr_r50vd --out rtdetr_r50vd.onnx[/bold]

    8 bits, calibrated on your camera and judged on another drive:
    [bold]cable-rpc export rtdetr --checkpoint PekingU/rtdetr_r18vd --out r18_int8.onnx --int8
    --calibrate video:monday.mp4 --verify video:tuesday.mp4 --verify-frames 100[/bold]
    """
    if fp16 and int8:
        raise ConfigurationError("--fp16 and --int8 exclude each other; choose one")
    if int8 and calibrate is None:
        raise ConfigurationError(
            "--int8 is calibrated on frames like those that the detector will see; add --calibrate video:FILE"
        )
    if calibrate is not None and not int8:
        raise ConfigurationError("--calibrate is for --int8; add that, or leave it out")
    if calibrate is not None and calibrate == verify:
        raise ConfigurationError(
            f"--calibrate and --verify are both '{verify}'; what 8 bits cost must be measured on other frames"
        )
    if out.suffix != ".onnx":
        raise ConfigurationError(f"--out is '{out}'; give a file that ends in .onnx")
    try:
        from cable_models.errors import ModelError as ExportError
        from cable_models.rtdetr.checkpoints import load_checkpoint
        from cable_models.rtdetr.detector_file import make_file
        from cable_models.rtdetr.file_plan import FilePlan, GraphOptions
    except ModuleNotFoundError as error:
        raise ConfigurationError("exporting needs the cloud extra: pip install 'cable-rpc[cloud]'") from error

    console = Console(width=None if sys.stdout.isatty() else LOG_WIDTH, highlight=False)
    verify_images = [] if verify == "none" else spread_frames(verify, verify_frames)
    calibration = [] if calibrate is None else spread_frames(calibrate, calibrate_frames)
    check_apart(calibration, verify_images)
    try:
        plan = FilePlan(
            GraphOptions(postprocess, batch, opset),
            "fp16" if fp16 else "int8" if int8 else "fp32",
            parse_size(size),
            provider,
            {"command": shlex.join(["cable-rpc", *sys.argv[1:]])},
        )
        loaded = load_checkpoint(checkpoint, revision)
        made = make_file(
            loaded, out, plan, verify_images, calibration, say=lambda step: console.print(step, style="dim")
        )
    except ExportError as error:
        raise ModelError(str(error)) from error
    console.print(render(made, loaded.notes.get("revision", "")))


def spread_frames(spec: str, count: int) -> list[Image]:
    """Frames spread evenly over a source, uint8 [H, W, 3] BGR each.

    Raises:
        ConfigurationError: unknown scheme, or the source has no frames.
        SourceError: it can't be read.
    """
    source = open_source(spec)
    available = source.frame_count or SPREAD_FRAMES
    wanted = sorted({round(index) for index in np.linspace(0, available - 1, min(count, available))})
    if isinstance(source, SyntheticSource):
        return [source.frame(index).image for index in wanted]
    images = [frame.image for frame in islice(source, wanted[-1] + 1) if frame.index in wanted]
    if not images:
        raise ConfigurationError(f"'{spec}' has no frames")
    return images


def check_apart(calibration: Sequence[Image], verify: Sequence[Image]) -> None:
    """See that nothing is measured on what it was calibrated on.

    Raises:
        ConfigurationError: a frame is in both.
    """
    seen = {image.tobytes() for image in calibration}
    if any(image.tobytes() in seen for image in verify):
        raise ConfigurationError("--calibrate and --verify share frames; take another drive for one of them")


def render(made: MadeFile, revision: str) -> Table:
    """What was written and what it proved."""
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_row("file", f"{made.path}, {made.path.stat().st_size / 1e6:.1f} MB")
    table.add_row("revision", revision)
    if made.check is None:
        table.add_row("verified", "no: --verify none")
    else:
        check = made.check
        table.add_row(
            "against torch",
            f"{check.compared} detections on {check.images} frames: boxes within {check.box_px:.4f} px, "
            f"scores within {check.score:.6f}",
        )
    if made.agreement is not None:
        table.add_row("against fp32", made.agreement.summary())
    table.add_row("serve", f"cable-rpc serve --detector onnx:{made.path}")
    return table
