"""What `benchmarks/lisa.py` measures: the cases, the regions, and one timed run of a case."""

from __future__ import annotations

import resource
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from cable_models.lisa.flops import FrameFlops, blank_frame, count_forced, count_generated, count_original
from cable_models.lisa.mask_decoder import upsample_logits
from cable_models.lisa.model import LisaModel
from cable_models.lisa.options import LisaOptions
from cable_models.lisa.original import Question, original_frame
from cable_models.lisa.pipeline import FrameRequest, LisaPipeline
from cable_models.lisa.random_weights import random_loaded
from cable_models.lisa.stage_timer import StageTimer
from torch import nn

FORCED = {"decoding": "forced", "verify_frames": 0, "verify_interval": 0}
NOTHING = {"image_tokens": "all", "clip_patches": "all", "sam_padding": "keep", "sam_windows": "all"}
SWITCHES: dict[str, dict[str, Any]] = {
    "image tokens drop": {"image_tokens": "drop"},
    "+ CLIP patches drop": {"image_tokens": "drop", "clip_patches": "drop"},
    "SAM padding drop": {"sam_padding": "drop"},
    "SAM windows skip": {"sam_windows": "skip"},
    "SAM tokens": {"sam_windows": "tokens"},
    "all, SAM skip": {"image_tokens": "drop", "clip_patches": "drop", "sam_windows": "skip"},
    "all, SAM tokens": {"image_tokens": "drop", "clip_patches": "drop", "sam_windows": "tokens"},
}
ALL_SWITCHES = ("all, SAM skip", "all, SAM tokens")
REGIONS = ("compact", "corridor", "scattered")


@dataclass(frozen=True, slots=True)
class Case:
    """One row of the table."""

    decoding: str
    """original, cached or forced."""
    switch: str = ""
    """Key of `SWITCHES`; none = nothing is left out."""
    region: str = "whole"
    coverage: float = 1.0
    batch: int = 1
    """Frames at once, each of a stream of its own."""

    def options(self, answer: tuple[int, ...], bucket: int) -> LisaOptions:
        """The pipeline's switches."""
        decoding = FORCED if self.decoding == "forced" else {"decoding": "generate", "max_new_tokens": len(answer)}
        chosen = {**NOTHING, **decoding, **SWITCHES.get(self.switch, {})}
        return LisaOptions(**chosen, forced_ids=answer, token_bucket=bucket)

    def rois(self, frame_hw: tuple[int, int]) -> list[np.ndarray | None]:
        """Region of each frame of the batch; those after the first have other places and coverages."""
        if not self.switch:
            return [None] * self.batch
        coverages = (self.coverage, *(0.5, 0.1, 0.25, 0.4, 0.15, 0.3, 0.2))
        kinds = (self.region, *(kind for _ in range(3) for kind in REGIONS))
        return [region_of(kinds[i], coverages[i], frame_hw) for i in range(self.batch)]


def list_cases(coverages: Sequence[float], regions: Sequence[str], batches: Sequence[int]) -> list[Case]:
    """All rows, whole frames first."""
    cases = [Case("original"), Case("cached"), Case("forced")]
    cases += [Case("forced", switch, "whole") for switch in ALL_SWITCHES]
    cases += [
        Case("forced", switch, region, coverage)
        for region in regions
        for coverage in coverages
        if coverage < 1
        for switch in SWITCHES
    ]
    cases += [Case("forced", batch=batch) for batch in batches if batch > 1]
    cases += [
        Case("forced", switch, "corridor", 0.25, batch) for batch in batches if batch > 1 for switch in ALL_SWITCHES
    ]
    return cases


def region_of(kind: str, coverage: float, frame_hw: tuple[int, int]) -> np.ndarray | None:
    """A region of a stated share of the frame, bool [H, W]; None for all of it.

    "compact" is a rectangle of the frame's proportions in its middle, "corridor" a band of full width around 60 % of
    the height, where a vehicle's camera sees the road, "scattered" twelve rectangles on a 4 x 3 grid.
    """
    if coverage >= 1:
        return None
    height, width = frame_hw
    roi = np.zeros(frame_hw, np.bool_)
    if kind == "corridor":
        rows = round(height * coverage)
        top = min(max(round(0.6 * height) - rows // 2, 0), height - rows)
        roi[top : top + rows] = True
        return roi
    rows_of_cells, columns_of_cells = (3, 4) if kind == "scattered" else (1, 1)
    cell_height, cell_width = height / rows_of_cells, width / columns_of_cells
    rows, columns = round(cell_height * coverage**0.5), round(cell_width * coverage**0.5)
    for row in range(rows_of_cells):
        for column in range(columns_of_cells):
            top = round((row + 0.5) * cell_height - rows / 2)
            left = round((column + 0.5) * cell_width - columns / 2)
            roi[top : top + rows, left : left + columns] = True
    return roi


class Script:
    """Makes a language head say a given answer, once it has done its work: random weights would never stop."""

    def __init__(self, answer: tuple[int, ...]) -> None:
        self.answer = answer
        self.spoken = 0

    def __call__(self, _head: nn.Module, _inputs: object, logits: torch.Tensor) -> None:
        """Lifts the next word's logit above all others, in place."""
        logits[..., self.answer[self.spoken % len(self.answer)]] = torch.finfo(logits.dtype).max
        self.spoken += 1


@dataclass(slots=True)
class Record:
    """What was measured of one case."""

    wall_ms: list[float] = field(default_factory=list)
    stages_ms: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    peak_bytes: int = 0
    image_tokens: list[int] = field(default_factory=list)

    def add(self, wall_ns: int, stages_ns: Mapping[str, int]) -> None:
        """One run."""
        self.wall_ms.append(wall_ns / 1e6)
        for stage, duration in stages_ns.items():
            self.stages_ms[stage].append(duration / 1e6)

    def median(self) -> float:
        """Median milliseconds from frames to masks."""
        return float(np.median(self.wall_ms))


class Runner:
    """Runs cases on one model."""

    def __init__(self, model: LisaModel, question: Question, frame_hw: tuple[int, int], bucket: int) -> None:
        self.question = question
        self.frame_hw = frame_hw
        self.bucket = bucket
        self.script = Script(question.answer)
        model.lm_head.register_forward_hook(self.script)
        self.loaded = random_loaded(model)
        self.images = [picture(frame_hw, seed) for seed in range(8)]
        self._pipelines: dict[Case, LisaPipeline] = {}

    def run(self, case: Case, record: Record) -> None:
        """One run from frames in memory to masks in memory."""
        cuda = self.loaded.model.device.type == "cuda"
        self.script.spoken = 0
        if cuda:
            torch.cuda.synchronize()
            torch.cuda.reset_peak_memory_stats()
        started = time.perf_counter_ns()
        stages = self._original() if case.decoding == "original" else self._pipeline(case, record)
        if cuda:
            torch.cuda.synchronize()
        record.add(time.perf_counter_ns() - started, stages)
        record.peak_bytes = max(record.peak_bytes, torch.cuda.max_memory_allocated() if cuda else 0)

    def _original(self) -> Mapping[str, int]:
        model = self.loaded.model
        timer = StageTimer(model.device)
        with timer.stage("preprocess"):
            frame = blank_frame(model, self.frame_hw)
            pixels = [torch.as_tensor(each)[None].to(model.device) for each in (frame.clip_pixels, frame.sam_pixels)]
        masks = original_frame(model, *pixels, self.question, timer)
        with timer.stage("postprocess"):
            side = model.architecture.sam.vision_config.image_size
            upsample_logits(masks, frame.sam_hw, frame.frame_hw, side).cpu()
        return timer.durations_ns()

    def _pipeline(self, case: Case, record: Record) -> Mapping[str, int]:
        if case not in self._pipelines:
            self._pipelines[case] = LisaPipeline(self.loaded, case.options(self.question.answer, self.bucket))
        requests = [
            FrameRequest(self.images[i], roi, self.question.ids, f"stream {i}")
            for i, roi in enumerate(case.rois(self.frame_hw))
        ]
        answers = self._pipelines[case].segment(requests)
        record.image_tokens = [answer.prefill.image_tokens for answer in answers]
        return answers[0].stage_ns


def picture(frame_hw: tuple[int, int], seed: int) -> np.ndarray:
    """Smooth noise, uint8 [H, W, 3]."""
    random = np.random.default_rng(seed)
    coarse = random.integers(0, 256, (frame_hw[0] // 30 + 2, frame_hw[1] // 30 + 2, 3), np.uint8)
    return np.ascontiguousarray(coarse.repeat(30, 0).repeat(30, 1)[: frame_hw[0], : frame_hw[1]])


def count(case: Case, shapes: LisaModel, question: Question, frame_hw: tuple[int, int]) -> FrameFlops | None:
    """Operations of one frame of a case; None for batches, whose frames differ."""
    if case.batch > 1:
        return None
    options = case.options(question.answer, 0)
    frame = blank_frame(shapes, frame_hw, case.rois(frame_hw)[0], options)
    if case.decoding == "original":
        return count_original(shapes, frame, question)
    if case.decoding == "cached":
        return count_generated(shapes, frame, question)
    return count_forced(shapes, frame, question, clip_patches=options.clip_patches == "drop")


def resident_bytes() -> int:
    """Most memory this process has held so far."""
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return kilobytes * 1024
