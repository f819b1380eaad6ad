"""Milliseconds and bytes of every codec, and how many frames a second the edge makes: ``python benchmarks/codecs.py``.

The first table codes the same frames whole with each codec at its default quality. The second runs the edge's whole
way from camera frame to packets (region of interest, background fill, coded mask, H.264) on a rendered drive whose
true masks answer, and says how many frames a second one core makes of it, taking in the answers included. CPU is
the same total without the time that other processes took. One thread each unless told otherwise.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from cable_codecs import CodecParameters, available_codecs, create_decoder, create_encoder, encode_mask, roi_psnr
from cable_codecs.region_sender import RegionSender
from cable_codecs.treatment import RegionTreatment
from rich.console import Console
from rich.progress import track
from rich.table import Table

from cable_rpc.data.source import open_source
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.study.loop_simulator import TruthCloud
from cable_rpc.types import Frame

SIZES = ((960, 540), (1280, 720), (1242, 375))
EDGE_SIZES = ((1280, 720), (1600, 900))
EDGE_STAGES = ("region", "fill + mask", "encode", "update")
WANTED_FPS = 60.0


def read_frames(spec: str, count: int, size: tuple[int, int], console: Console) -> list[Frame]:
    """The first frames of a source, resized."""
    source = open_source(spec, max_frames=count, size=size)
    title = f"reading {source.name} as {size[0]}x{size[1]}"
    return list(track(source, title, total=count, console=console, transient=True))


def codec_table(frames: Sequence[Frame], names: Iterable[str], threads: int) -> Table:
    """A row for each codec."""
    height, width = frames[0].size_hw
    table = Table(title=f"{len(frames)} whole frames of {width}x{height}, {threads} thread(s)", title_justify="left")
    for heading in ("codec", "made by", "encode ms", "worst", "decode ms", "bytes/frame", "luma dB"):
        table.add_column(heading, justify="left" if heading in ("codec", "made by") else "right")
    for name in names:
        table.add_row(*codec_row(frames, name, threads))
    return table


def codec_row(frames: Sequence[Frame], name: str, threads: int) -> list[str]:
    """Median and worst times, mean size and fidelity of one codec at its default quality."""
    height, width = frames[0].size_hw
    parameters = CodecParameters(name, width, height, threads=threads)
    everywhere = np.ones((height, width), np.bool_)
    encode_ms, decode_ms, sizes, errors = [], [], [], []
    with create_encoder(parameters) as encoder, create_decoder(parameters) as decoder:
        for frame in frames:
            encoded = encoder.encode(frame.image)
            started = time.perf_counter()
            decoded = decoder.decode(encoded.data)
            decode_ms.append((time.perf_counter() - started) * 1e3)
            encode_ms.append(encoded.duration_ns / 1e6)
            sizes.append(len(encoded.data))
            errors.append(10 ** (-roi_psnr(frame.image, decoded, everywhere) / 10))
        made_by = encoder.implementation
    fidelity = f"{-10 * np.log10(np.mean(errors)):.2f}" if any(errors) else "exact"
    return [
        name,
        made_by,
        f"{statistics.median(encode_ms):.2f}",
        f"{max(encode_ms):.2f}",
        f"{statistics.median(decode_ms):.2f}",
        f"{statistics.mean(sizes):.0f}",
        fidelity,
    ]


def edge_times(frames: Sequence[Frame], threads: int, preset: str | None) -> tuple[dict[str, list[float]], list[float]]:
    """Milliseconds of each stage of the edge and the coverage, frame by frame; frames sent whole are left out."""
    height, width = frames[0].size_hw
    tracker, sender, cloud = RoiTracker(), RegionSender(RegionTreatment(), height, width), TruthCloud()
    times: dict[str, list[float]] = defaultdict(list)
    coverages: list[float] = []
    with create_encoder(CodecParameters("h264", width, height, threads=threads, preset=preset)) as encoder:
        for frame in frames:
            worked = time.process_time()
            stamps = [time.perf_counter()]
            proposal = tracker.propose(frame)
            stamps.append(time.perf_counter())
            region = proposal.roi
            treated = sender.treat(frame.image, None if proposal.keyframe else region.blocks, region.block_size)
            if treated.blocks is not None:
                encode_mask(treated.blocks)
            stamps.append(time.perf_counter())
            encoder.encode(treated.image)
            stamps.append(time.perf_counter())
            worked = time.process_time() - worked
            answer = cloud(frame, region)
            worked -= time.process_time()
            answered = time.perf_counter()
            tracker.update(frame.index, answer.mask, confidence=answer.confidence)
            update_ms = (time.perf_counter() - answered) * 1e3
            worked += time.process_time()
            if not proposal.keyframe:
                stages = [
                    *(1e3 * (after - before) for before, after in pairwise(stamps)),
                    update_ms,
                ]
                for stage, duration in zip(EDGE_STAGES, stages, strict=True):
                    times[stage].append(duration)
                times["total"].append(sum(stages))
                times["CPU"].append(1e3 * worked)
                coverages.append(region.coverage)
    return times, coverages


def edge_table(clips: Sequence[Sequence[Frame]], threads: int, preset: str | None) -> Table:
    """A row for each size."""
    setting = f"x264 {preset or 'as by default'}, {threads} thread(s)"
    title = f"edge: region, fill, mask and H.264 ({setting}); median ms, without whole frames"
    table = Table(title=title, title_justify="left")
    for heading in ("size", "coverage", *EDGE_STAGES, "total", "p95", "CPU", "frames/s", f"{WANTED_FPS:.0f} fps"):
        table.add_column(heading, justify="right")
    for frames in clips:
        times, coverages = edge_times(frames, threads, preset)
        height, width = frames[0].size_hw
        rate = 1e3 / statistics.mean(times["total"])
        table.add_row(
            f"{width}x{height}",
            f"{100 * statistics.mean(coverages):.0f} %",
            *(f"{statistics.median(times[stage]):.2f}" for stage in (*EDGE_STAGES, "total")),
            f"{np.percentile(times['total'], 95):.2f}",
            f"{statistics.median(times['CPU']):.2f}",
            f"{rate:.0f}",
            "yes" if rate >= WANTED_FPS else "no",
        )
    return table


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clip", type=Path, help="video file for the first table; a rendered drive without")
    parser.add_argument("--frames", type=int, default=30, help="of each clip, default 30")
    parser.add_argument("--size", type=int, nargs=2, action="append", metavar=("WIDTH", "HEIGHT"), help="repeatable")
    parser.add_argument("--codec", action="append", help="repeatable; all by default")
    parser.add_argument("--threads", type=int, default=1, help="of each encoder, default 1")
    parser.add_argument("--preset", help="of x264 at the edge, e.g. superfast; the codec's default without")
    parser.add_argument("--seed", type=int, default=1, help="of the rendered drive")
    parser.add_argument("--part", choices=("codecs", "edge", "both"), default="both")
    return parser.parse_args()


def main() -> None:
    options = parse()
    console = Console()
    if not console.is_terminal:
        console = Console(width=120)
    cv2.setNumThreads(1)
    rendered = f"synthetic:{options.seed}"
    spec = rendered if options.clip is None else f"video:{options.clip}"
    if options.part != "edge":
        for size in options.size or SIZES:
            frames = read_frames(spec, options.frames, tuple(size), console)
            console.print(codec_table(frames, options.codec or available_codecs(), options.threads))
    if options.part != "codecs":
        clips = [read_frames(rendered, options.frames, tuple(size), console) for size in options.size or EDGE_SIZES]
        console.print(edge_table(clips, options.threads, options.preset))


if __name__ == "__main__":
    main()
