"""Clips, variants and simulated runs of ``edge_quality.py``, one process a clip."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, replace
from queue import Empty
from typing import Any, get_args

import cv2
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from cable_rpc.data.source import open_source
from cable_rpc.edge.roi_config import PAPER, ROBUST, EgoModel, RoiConfig
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.study.loop_simulator import (
    FeedbackLink,
    SimulatedFrame,
    SimulationSummary,
    TruthCloud,
    simulate,
    summarise_simulation,
    whole_truth,
)
from cable_rpc.study.metrics import mask_iou
from cable_rpc.types import EgoMotion, Frame, RoiMask

PRESETS = {"paper": PAPER, "robust": ROBUST}
STRENGTHS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)
DELAYS = (1, 2, 4, 8)
ROUTES = ("streets", "turns", "straight")
TURNING_DPS, STRAIGHT_DPS = 20.0, 2.0
COMMON_GRID_PX = 4
"""Priors of all analysis scales are compared on this grid."""
CATCH_FRAMES = 3
ABLATION = "as paper: "
ABLATION_DELAY = 4
"""Answers are so late in the ablation's drives: in lock-step nearly every setting alone can be spared."""
STANDING = "standing"
"""Group of clips before a red light, where others come in from the sides; only for newcomers."""
EGO_NOISE_MPS = 0.02


@dataclass(frozen=True, slots=True)
class Variant:
    """One way to run a sequence."""

    label: str
    config: RoiConfig
    delay: int = 1
    isolated: bool = False
    """The prior is the whole true mask of the frame before, whatever was sent."""


@dataclass(frozen=True, slots=True)
class Clip:
    """What to render, and which variants to run on it."""

    group: str
    spec: str
    frame_count: int
    size: tuple[int, int]
    variants: tuple[Variant, ...]
    played_frames: int = 0
    """Above 0 the vehicle stands: that many frames are made of those, with noise on its velocity."""


@dataclass(frozen=True, slots=True)
class Run:
    """What one variant made of one sequence."""

    group: str
    clip: str
    label: str
    summary: SimulationSummary
    turning: tuple[float, ...]
    """Prior IoU of each turning frame."""
    straight: tuple[float, ...]
    newcomers: tuple[int | None, ...]
    """Frames until each was caught."""
    reasons: tuple[str, ...]
    """Of the keyframes, in order."""


class Collector:
    """Passes simulated frames on and keeps what the summary does not."""

    def __init__(self) -> None:
        self.turning: list[float] = []
        self.straight: list[float] = []
        self.reasons: list[str] = []
        self.sightings: dict[int, list[tuple[int, bool, float]]] = {}
        """Of each track, while visible: position, whether it touches a side of the frame, share sent."""

    def watch(self, frames: Iterable[SimulatedFrame]) -> Iterator[SimulatedFrame]:
        for position, simulated in enumerate(frames):
            self.note_prior(simulated)
            if simulated.proposal.keyframe:
                self.reasons.append(simulated.proposal.keyframe_reason or "?")
            truth, width = simulated.frame.truth, simulated.frame.size_hw[1]
            assert truth is not None
            for row in np.flatnonzero(simulated.visible):
                x0, _, x1, _ = truth.boxes_xyxy[row]
                sighting = (position, bool(x0 <= 1 or x1 >= width - 1), float(simulated.overlap_sent[row]))
                self.sightings.setdefault(int(truth.track_ids[row]), []).append(sighting)
            yield simulated

    def note_prior(self, simulated: SimulatedFrame) -> None:
        steps, ego = simulated.proposal.steps, simulated.frame.ego
        if steps is None or ego is None or COMMON_GRID_PX % steps.scale:
            return
        true_mask = RoiMask.from_pixels(whole_truth(simulated.frame, simulated.region).mask, COMMON_GRID_PX).blocks
        if not true_mask.any():
            return
        prior = RoiMask.from_pixels(steps.warped_prior, COMMON_GRID_PX // steps.scale).blocks
        yaw_dps = abs(np.degrees(ego.yaw_rate_radps))
        if yaw_dps >= TURNING_DPS:
            self.turning.append(mask_iou(prior, true_mask))
        elif yaw_dps < STRAIGHT_DPS:
            self.straight.append(mask_iou(prior, true_mask))

    def newcomers(self) -> tuple[int | None, ...]:
        """For each track that came in from a side and stayed: frames until it was caught, None if not soon enough."""
        waited: list[int | None] = []
        for sightings in self.sightings.values():
            first, at_side, _ = sightings[0]
            soon = [sighting for sighting in sightings if sighting[0] < first + CATCH_FRAMES]
            if first > 0 and at_side and len(soon) == CATCH_FRAMES:
                waited.append(next((at - first for at, _, share in soon if share >= 0.5), None))
        return tuple(waited)


def stronger(config: RoiConfig, strength: float) -> RoiConfig:
    """The same method with all its margins and its base dilation multiplied."""
    return replace(
        config,
        dilation_base_px=config.dilation_base_px * strength,
        top_margin=min(1.0, config.top_margin * strength),
        bottom_margin=min(1.0, config.bottom_margin * strength),
        side_margin_share=min(1.0, config.side_margin_share * strength),
        min_height_fraction=min(1.0, config.min_height_fraction * strength),
    )


def variants_of(figures: str, strengths: Sequence[float], delays: Sequence[int]) -> tuple[Variant, ...]:
    """All that the figures ask of one sequence, each run once."""
    found = [Variant(name, config) for name, config in PRESETS.items()]
    if "a" in figures:
        found.append(Variant("warp, paper mode", PAPER, isolated=True))
        found += [
            Variant(f"warp, {model}", replace(ROBUST, ego_model=model), isolated=True) for model in get_args(EgoModel)
        ]
    for name, config in PRESETS.items():
        if "b" in figures:
            found += [Variant(f"{name} x{s:g}", stronger(config, s)) for s in strengths if s != 1]
        if "d" in figures:
            found += [Variant(f"{name} d{delay}", config, delay) for delay in delays if delay != 1]
    return tuple(found)


def ablations(delay: int) -> tuple[Variant, ...]:
    """Both modes, and robust with each setting in turn as in the paper."""
    configs = {name: replace(ROBUST, **{name: getattr(PAPER, name)}) for name in ROBUST.changes_from(PAPER)}
    return tuple(Variant(f"{ABLATION}{name}", config, delay) for name, config in {**PRESETS, **configs}.items())


def render(spec: str, frame_count: int, size: tuple[int, int]) -> list[Frame]:
    """All frames of a source."""
    return list(open_source(spec, max_frames=frame_count, size=size))


def back_and_forth(frames: Sequence[Frame], count: int) -> list[Frame]:
    """Frames played forwards, backwards and so on; seamless where the camera stands."""
    turn = 2 * (len(frames) - 1)
    interval_ns = frames[1].capture_time_ns - frames[0].capture_time_ns
    played = []
    for index in range(count):
        position = index % turn
        frame = frames[min(position, turn - position)]
        played.append(replace(frame, index=index, capture_time_ns=index * interval_ns))
    return played


def with_ego_noise(frames: Iterable[Frame], sigma_mps: float) -> list[Frame]:
    """Frames whose ego velocity has Gaussian noise forwards and sideways."""
    random = np.random.default_rng(5)
    noisy = []
    for frame in frames:
        ego = frame.ego or EgoMotion(0.0)
        forward, lateral = random.normal(0.0, sigma_mps, 2)
        ego = replace(ego, speed_mps=ego.speed_mps + forward, lateral_mps=ego.lateral_mps + lateral)
        noisy.append(replace(frame, ego=ego))
    return noisy


class Worker:
    """State of a worker process."""

    report: Callable[[int], None] = staticmethod(lambda steps: None)


def prepare_worker(queue: Any) -> None:
    cv2.setNumThreads(1)
    Worker.report = queue.put


def measure(clip: Clip) -> list[Run]:
    """Render one sequence and run its variants; in a worker process."""
    frames = render(clip.spec, clip.frame_count, clip.size)
    if clip.played_frames:
        frames = with_ego_noise(back_and_forth(frames, clip.played_frames), EGO_NOISE_MPS)
    Worker.report(1)
    runs = []
    for variant in clip.variants:
        collector = Collector()
        tracker = RoiTracker(variant.config, block_size=8, keep_steps=True)
        cloud = whole_truth if variant.isolated else TruthCloud()
        loop = simulate(frames, tracker, cloud, FeedbackLink(variant.delay))
        summary = summarise_simulation(collector.watch(loop))
        turning, straight = tuple(collector.turning), tuple(collector.straight)
        newcomers, reasons = collector.newcomers(), tuple(collector.reasons)
        runs.append(Run(clip.group, clip.spec, variant.label, summary, turning, straight, newcomers, reasons))
        Worker.report(1)
    return runs


def measure_all(clips: Sequence[Clip], workers: int, console: Console) -> list[Run]:
    """All runs of all clips, over worker processes, with a bar."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        ProcessPoolExecutor(workers, context, prepare_worker, (queue,)) as pool,
        Progress(*columns, console=console) as progress,
    ):
        total = sum(1 + len(clip.variants) for clip in clips)
        task = progress.add_task("runs", total=total)
        futures: list[Future[list[Run]]] = [pool.submit(measure, clip) for clip in clips]
        while not all(future.done() for future in futures):
            try:
                progress.advance(task, queue.get(timeout=0.5))
            except Empty:
                continue
        return [run for future in futures for run in future.result()]
