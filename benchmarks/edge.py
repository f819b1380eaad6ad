"""Cost of the edge's region of interest, step by step: ``python benchmarks/edge.py``.

Times everything between camera frame and encoder input (prediction, block mask, background fill) in both modes,
against a literal full-frame NumPy version of the method and against the H.264 encode of the same frame, in one run,
interleaved frame by frame. One thread each. Memory is what one frame allocates at its peak, by tracemalloc.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import tracemalloc
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from cable_codecs import CodecParameters, create_encoder, fill_blocks
from rich.console import Console
from rich.progress import track
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "edge"))

import algorithm1_numpy as literal
from algorithm1_reference import PAPER

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.types import Frame

SIZES = ((1600, 900), (1280, 720), (1242, 375), (3840, 1280))
MODES = {"paper": RoiConfig.paper(), "robust": RoiConfig()}
LITERAL_FRAMES = 2


@dataclass
class Samples:
    """Milliseconds of each step, one entry a frame."""

    steps: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    coverage: list[float] = field(default_factory=list)
    peak_bytes: int = 0

    def add(self, step: str, since_ns: int) -> int:
        """Charge the time since a stamp to a step; returns the stamp of now."""
        now = time.perf_counter_ns()
        self.steps[step].append((now - since_ns) / 1e6)
        return now

    def median(self, step: str) -> float:
        """Median milliseconds."""
        return float(np.median(self.steps[step])) if self.steps[step] else 0.0


class RoiStage:
    """Tracker and fill, as the frame encoder runs them."""

    def __init__(self, config: RoiConfig, width: int, height: int) -> None:
        self.tracker = RoiTracker(config, block_size=8)
        self.canvas = np.empty((height, width, 3), np.uint8)
        self.samples = Samples()

    def run(self, frame: Frame, *, timed: bool) -> None:
        """One frame, with the truth's mask as the answer."""
        started = time.perf_counter_ns()
        proposal = self.tracker.propose(frame)
        proposed = time.perf_counter_ns()
        if proposal.keyframe:
            sent = np.ones(frame.size_hw, np.bool_)
        else:
            fill_blocks(frame.image, proposal.roi.blocks, proposal.roi.block_size, "zero", out=self.canvas)
        ended = time.perf_counter_ns()
        if not proposal.keyframe:
            sent = proposal.roi.pixels()
        answered = time.perf_counter_ns()
        self.tracker.update(frame.index, (frame.truth.instance_mask > 0) & sent)
        if timed and not proposal.keyframe:
            samples = self.samples
            for stage, duration_ns in proposal.timings.stages_ns.items():
                samples.steps[stage].append(duration_ns / 1e6)
            samples.steps["fill"].append((ended - proposed) / 1e6)
            samples.steps["total"].append((ended - started) / 1e6)
            samples.add("update", answered)
            samples.coverage.append(proposal.roi.coverage)

    def measure_memory(self, frame: Frame) -> None:
        """Peak of what one frame allocates."""
        tracemalloc.start()
        self.run(frame, timed=False)
        self.samples.peak_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()


def time_literal(before: Frame, now: Frame, samples: Samples) -> None:
    """The literal version of one frame, whose grey predecessor is at hand as it is for the tracker."""
    prior_mask = before.truth.instance_mask > 0
    picture_before = literal.grey(before.image)
    started = stamp = time.perf_counter_ns()
    picture = literal.grey(now.image)
    stamp = samples.add("grey", stamp)
    dt_s = (now.capture_time_ns - before.capture_time_ns) / 1e9
    shift = literal.shift_of(now.ego.speed_mps, now.ego.lateral_mps, now.intrinsics.fx, dt_s, 1e-6)
    prior = literal.warp_mask(prior_mask, shift)
    warped, valid = literal.warp_grey(picture_before, shift)
    stamp = samples.add("warp", stamp)
    motion = literal.residual(picture, warped, valid, PAPER["tau_e"])
    stamp = samples.add("residual", stamp)
    yaw_change_deg = math.degrees(now.ego.yaw_rate_radps * dt_s)
    radius = literal.dilation_radius(now.ego.speed_mps * dt_s, yaw_change_deg, PAPER)
    raw = literal.fuse(prior, literal.dilate(prior, radius), motion)
    stamp = samples.add("dilate", stamp)
    region = literal.corridor(raw, PAPER)
    stamp = samples.add("corridor", stamp)
    upload = now.image * region[..., None]
    samples.add("fill", stamp)
    samples.add("total", started)
    assert upload.shape == now.image.shape


def profile(width: int, height: int, count: int, console: Console, progress: Console) -> None:
    """Print one size's table."""
    source = SyntheticSource(SyntheticConfig(seed=4, width=width, height=height, frame_count=count + 2))
    frames = [source.frame(index) for index in track(range(count + 2), f"render {width}x{height}", console=progress)]
    stages = {name: RoiStage(config, width, height) for name, config in MODES.items()}
    whole, masked = Samples(), Samples()
    parameters = CodecParameters("h264", width, height, 10.0, threads=1)
    with create_encoder(parameters) as encoder, create_encoder(parameters) as roi_encoder:
        for index, frame in enumerate(frames[:-1]):
            for stage in stages.values():
                stage.run(frame, timed=index > 1)
            encoded = encoder.encode(frame.image)
            roi_encoded = roi_encoder.encode(stages["robust"].canvas)
            if index > 1:
                whole.steps["total"].append(encoded.duration_ns / 1e6)
                masked.steps["total"].append(roi_encoded.duration_ns / 1e6)
    for stage in stages.values():
        stage.measure_memory(frames[-1])
    slow = Samples()
    for index in range(-1 - LITERAL_FRAMES, -1):
        time_literal(frames[index], frames[index + 1], slow)
    console.print(table(width, height, stages, slow, whole, masked))


def table(
    width: int, height: int, stages: dict[str, RoiStage], slow: Samples, whole: Samples, masked: Samples
) -> Table:
    """One size's figures."""
    shown = Table(title=f"{width}x{height}: median milliseconds, one thread", title_justify="left")
    columns = ("grey", "warp", "residual", "dilate", "corridor", "entry", "decide", "fill", "total")
    for head in ("", *columns, "p95", "update", "coverage", "peak MiB"):
        shown.add_column(head, justify="left" if head == "" else "right")
    for name, stage in stages.items():
        samples = stage.samples
        shown.add_row(
            name,
            *(f"{samples.median(step):.2f}" for step in columns),
            f"{np.percentile(samples.steps['total'], 95):.2f}",
            f"{samples.median('update'):.2f}",
            f"{np.mean(samples.coverage):.3f}",
            f"{samples.peak_bytes / 2**20:.1f}",
        )
    shown.add_row("literal NumPy", *(f"{slow.median(step):.1f}" if slow.steps[step] else "" for step in columns))
    for name, samples in (("H.264 whole frame", whole), ("H.264 region only", masked)):
        shown.add_row(name, *[""] * 8, f"{samples.median('total'):.2f}")
    totals = {name: stage.samples.median("total") for name, stage in stages.items()}
    encode = whole.median("total")
    shown.caption = "; ".join(
        f"{name}: {slow.median('total') / total:.0f}x the literal version's speed, {total / encode:.0%} of the encode"
        for name, total in totals.items()
    )
    shown.caption_justify = "left"
    return shown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=40, help="timed frames per size (40)")
    parser.add_argument("--size", action="append", metavar="WxH", help="only these sizes; may be repeated")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    sizes = [tuple(map(int, size.lower().split("x"))) for size in arguments.size or ()] or list(SIZES)
    console = Console(width=None if sys.stdout.isatty() else 150)
    for width, height in sizes:
        profile(width, height, arguments.frames, console, Console(stderr=True))


if __name__ == "__main__":
    main()
