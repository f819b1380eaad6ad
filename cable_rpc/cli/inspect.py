"""`cable-rpc inspect`: one frame's way to its region of interest, as a picture."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated

import cv2
import typer
from rich.console import Console
from rich.progress import track

from cable_rpc.cli.roi_options import MODES, roi_config
from cable_rpc.cli.skip_bad import SkipBad, bad_frames_listed
from cable_rpc.cli.stream import camera_mount, centred_intrinsics, parse_size
from cable_rpc.cloud.backends import BackendOptions, load_detector
from cable_rpc.cloud.segmenters import RandomAccessSource
from cable_rpc.data.source import SOURCE_FORMS, FrameSource, open_source
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.inspect_loop import DetectorCloud, inspect_last
from cable_rpc.study.inspect_sheet import draw_sheet
from cable_rpc.study.loop_simulator import CloudModel, TruthCloud
from cable_rpc.types import Frame, Image

QUIET_FRAMES = 3
"""Runs of so few frames show no progress."""


def inspect(
    source: Annotated[str, typer.Option(help=f"{SOURCE_FORMS}.", metavar="SCHEME:...")],
    frame: Annotated[int, typer.Option(help="Number of the frame to show, from 0; counted after --fps.", min=0)],
    out: Annotated[Path, typer.Option(help="PNG file to write.")] = Path("out/inspect.png"),
    mode: Annotated[
        str,
        typer.Option(help="robust (ours) | paper (the published method to the letter) | both, one above the other."),
    ] = "both",
    roi: Annotated[
        list[str] | None,
        typer.Option(
            help="Change one switch of the robust mode, e.g. corridor=false; repeatable.", metavar="KEY=VALUE"
        ),
    ] = None,
    cloud: Annotated[
        str | None,
        typer.Option(
            help="Where the cloud's masks come from: truth (the source's exact masks, cut to what was sent) | detector "
            "(boxes of --detector on what was sent). Without: detector where one is given."
        ),
    ] = None,
    detector: Annotated[str | None, typer.Option(help="embedded | onnx:FILE, as in serve.")] = None,
    min_score: Annotated[float, typer.Option(help="Detections below are dropped.", min=0.0, max=1.0)] = 0.4,
    delay: Annotated[int, typer.Option(help="Frames until the cloud's answer is there; 1 is lock-step.", min=1)] = 1,
    lead_in: Annotated[
        int, typer.Option(help="Frames that the loop is run over beforehand; the first is sent whole.", min=0)
    ] = 12,
    size: Annotated[str | None, typer.Option(help="Resize to WIDTHxHEIGHT before anything else.")] = None,
    fps: Annotated[float | None, typer.Option(help="Thin a video to this rate; rate of an image folder.")] = None,
    ego_csv: Annotated[
        Path | None, typer.Option(help="Ego-motion of a video: CSV with speed_mps and yaw_rate_radps (left positive).")
    ] = None,
    focal: Annotated[
        float | None, typer.Option(help="Focal length of the video's camera in pixels, for the ego-motion warp.")
    ] = None,
    camera_height: Annotated[
        float | None, typer.Option(help="Metres from the road to the video's camera, for the ground-plane warp.")
    ] = None,
    camera_pitch: Annotated[float, typer.Option(help="Degrees by which that camera looks below the horizontal.")] = 0.0,
    block_size: Annotated[int, typer.Option(help="Grid that the region is grown to; 1 = exact.", min=1)] = 8,
    skip_bad: SkipBad = False,
) -> None:
    """Show how one frame's region of interest came about: every step of the method, labelled, on one sheet.

    Example: [bold]cable-rpc inspect --source synthetic:8 --frame 40 --out frame40.png[/bold]

    A real drive has no true masks; let a detector stand in for the cloud:
    [bold]cable-rpc inspect --source video:drive.mp4 --frame 120 --detector onnx:model.onnx[/bold]
    """
    if mode not in (*MODES, "both"):
        raise ConfigurationError(f"--mode is '{mode}'; use {', '.join(MODES)} or both")
    if out.suffix.lower() != ".png":
        raise ConfigurationError(f"--out is '{out}'; the sheet is a PNG, give a name that ends in .png")
    modes = ("paper", "robust") if mode == "both" else (mode,)
    configs = {name: roi_config(name) for name in modes}
    if roi and "robust" in configs:
        del configs["robust"]
        configs[f"robust with {', '.join(roi)}"] = roi_config("robust", roi)
    if roi and mode == "paper":
        raise ConfigurationError("--roi changes the robust mode, which --mode paper leaves out; use robust or both")
    answering, told = cloud_model(cloud, detector, min_score)
    with bad_frames_listed(skip_bad) as bad_frames:
        opened = open_source(
            source,
            ego_csv=ego_csv,
            size=parse_size(size),
            intrinsics=centred_intrinsics(focal, source, bad_frames),
            fps=fps,
            mount=camera_mount(camera_height, camera_pitch),
            bad_frames=bad_frames,
        )
        first = max(0, frame - lead_in)
        frames = window(opened, first, frame)
        if isinstance(answering, TruthCloud):
            frames = with_true_masks(frames)
        running = with_progress(frames, frame - first + 1)
        views = inspect_last(running, configs, answering, delay=delay, block_size=block_size)
        height, width = views[-1].frame.size_hw
        late = "1 frame" if delay == 1 else f"{delay} frames"
        subtitle = f"{width} \N{MULTIPLICATION SIGN} {height} px \N{MIDDLE DOT} cloud: {told}, {late} later"
        subtitle += f" \N{MIDDLE DOT} loop run from frame {first}"
        write_png(out, draw_sheet(views, f"Frame {frame} of {opened.name}", subtitle))
        print(f"wrote {out}")


def window(source: FrameSource, first: int, last: int) -> Iterator[Frame]:
    """Frames first .. last of a source.

    Raises:
        ConfigurationError: the source ends before.
    """
    count = source.frame_count
    if isinstance(source, RandomAccessSource) and count is not None:
        if last >= count:
            raise ConfigurationError(beyond_the_end(source, last, count))
        yield from (source.frame(index) for index in range(first, last + 1))
        return
    seen = 0
    for frame in itertools.islice(source, last + 1):
        seen += 1
        if frame.index >= first:
            yield frame
    if seen <= last:
        raise ConfigurationError(beyond_the_end(source, last, seen))


def beyond_the_end(source: FrameSource, wanted: int, count: int) -> str:
    """What to say of a frame that isn't there."""
    return f"--frame is {wanted}, but {source.name} has {count} frames: give 0 to {count - 1}"


def cloud_model(cloud: str | None, detector: str | None, min_score: float) -> tuple[CloudModel, str]:
    """What answers the frames, and how the sheet names it.

    Raises:
        ConfigurationError: the choice is unknown, or what it needs is missing.
    """
    chosen = cloud or ("truth" if detector is None else "detector")
    if chosen not in ("truth", "detector"):
        raise ConfigurationError(f"--cloud is '{cloud}'; use truth or detector")
    if chosen == "truth":
        return TruthCloud(min_visible_share=0.0), "exact masks of the truth, cut to what was sent"
    if detector is None:
        raise ConfigurationError("--cloud detector needs a detector; give --detector embedded or --detector onnx:FILE")
    try:
        loaded = load_detector(detector, BackendOptions(min_score=min_score))
    except ModuleNotFoundError as error:
        raise ConfigurationError("a detector needs the cloud extra: pip install 'cable-rpc[cloud]'") from error
    return DetectorCloud(loaded), f"boxes of {loaded.name} on what was sent"


def with_true_masks(frames: Iterable[Frame]) -> Iterator[Frame]:
    """The same frames, each of which must have them.

    Raises:
        ConfigurationError: one has none.
    """
    for frame in frames:
        if frame.truth is None or frame.truth.instance_mask is None:
            raise ConfigurationError(
                "the source has no true masks that could stand in for the cloud; give --detector embedded or "
                "--detector onnx:FILE, or inspect a synthetic source"
            )
        yield frame


def with_progress(frames: Iterable[Frame], count: int) -> Iterable[Frame]:
    """The same frames, with a progress bar on stderr that goes away."""
    if count <= QUIET_FRAMES:
        return frames
    return track(frames, "running the loop", total=count, console=Console(stderr=True), transient=True)


def write_png(path: Path, image: Image) -> None:
    """Write a picture, the whole file or none.

    Raises:
        ConfigurationError: the place can't be written to.
    """
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(cv2.imencode(".png", image)[1].tobytes())
        os.replace(part, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise ConfigurationError(f"can't write the sheet to {path}: {error.strerror or error}") from error
