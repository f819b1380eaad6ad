"""Whether LISA++'s shortcuts hold on a user's own weights and pictures: every switch beside the published inference."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np
from cable_codecs.fill import FillMode, fill_blocks

from cable_rpc.cloud.backends import FrameContext
from cable_rpc.cloud.roi_crop import CropOptions, CropSegmenter
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.study.mask_agreement import Agreement, agreement
from cable_rpc.types import BoolMask, Detections, Frame, Image, RoiMask, Segmentation

if TYPE_CHECKING:
    from cable_models.lisa.options import LisaOptions
    from cable_models.lisa.pipeline import FrameAnswer, LisaPipeline

Shown = Literal["whole frame", "region"]
Prompt = str | Sequence[int]

REFERENCE = "published (generated)"
REGION_REFERENCE = "nothing left out"
FORCED = "forced"


@dataclass(frozen=True, slots=True)
class Variant:
    """One way to run the model."""

    name: str
    shown: Shown
    """What the model is given: the frame, or the frame with all but R_k blanked, as a cloud has it."""
    options: LisaOptions
    crop: bool = False
    """Shown only the box around R_k, by `CropSegmenter`."""
    independent: bool = False
    """Every frame is the first of a stream: its forced answer is checked, and never the model's own."""


@dataclass(frozen=True, slots=True)
class VariantRun:
    """One variant on one frame."""

    mask: BoolMask
    """bool [height, width], inside R_k."""
    wall_ns: int
    stage_ns: dict[str, int]
    image_tokens: int
    whole_image_tokens: int
    agrees: bool | None


@dataclass(frozen=True, slots=True)
class VariantResult:
    """One variant over all frames."""

    variant: Variant
    to_published: Agreement
    """Means, inside R_k, against the published inference on the whole frame."""
    to_region: Agreement
    """The same against the plain path on the region: what the switch alone costs."""
    worst: float
    """Lowest J of a frame against the plain path on the region."""
    wall_ms: float
    """Median."""
    stage_ms: dict[str, float]
    """Medians."""
    token_share: float
    """Image tokens that entered the language model, mean share of a whole frame's."""


@dataclass(frozen=True, slots=True)
class Verification:
    """Everything that was found out."""

    frames: int
    coverage: float
    """Mean share of the frames inside R_k."""
    forced_equal: int
    """Frames whose forced answer is what greedy decoding says, of `frames`."""
    forced_masks: Agreement
    """Whole frames, forced against generated."""
    answer: str
    """What greedy decoding said on the first frame."""
    wanted: float
    """Agreement that a recommended variant must have."""
    results: tuple[VariantResult, ...]
    recommended: Variant
    """The fastest variant on regions whose masks are as good as wanted; at worst the one that leaves nothing out."""


def variants() -> list[Variant]:
    """The published inference, the forced answer, then every switch alone and the two useful sums of them."""
    from cable_models.lisa.options import PLAIN

    forced = replace(PLAIN, decoding="forced", verify_frames=1, verify_interval=0)
    dropped = replace(forced, image_tokens="drop", sam_padding="drop")
    return [
        Variant(REFERENCE, "whole frame", PLAIN),
        Variant(FORCED, "whole frame", forced, independent=True),
        Variant(REGION_REFERENCE, "region", forced),
        Variant("image_tokens=drop", "region", replace(forced, image_tokens="drop")),
        Variant("image_tokens=compact", "region", replace(forced, image_tokens="compact")),
        Variant("clip_patches=drop", "region", replace(forced, image_tokens="drop", clip_patches="drop")),
        Variant("sam_padding=drop", "region", replace(forced, sam_padding="drop")),
        Variant("sam_windows=skip", "region", replace(forced, sam_windows="skip")),
        Variant("sam_windows=tokens", "region", replace(forced, sam_windows="tokens")),
        Variant("drop + skip", "region", replace(dropped, sam_windows="skip")),
        Variant("drop + tokens", "region", replace(dropped, sam_windows="tokens")),
        Variant("crop to the region", "region", forced, crop=True),
    ]


class Runner:
    """Runs one variant frame by frame."""

    def __init__(self, pipeline: LisaPipeline, variant: Variant, prompt: Prompt) -> None:
        self._pipeline = pipeline
        self._prompt = prompt
        self._variant = variant
        self._frames = 0
        self._answer: FrameAnswer | None = None
        self.name = variant.name
        self.revision = ""
        self.device = str(pipeline.loaded.model.device)
        self._cropped = CropSegmenter(self, CropOptions()) if variant.crop else None

    def run(self, image: Image, region: RoiMask) -> VariantRun:
        """The variant's mask inside a region, and what it took."""
        roi = region.pixels()
        context = FrameContext(0, Detections.empty())
        segment = self.segment if self._cropped is None else self._cropped.segment
        began_ns = time.perf_counter_ns()
        mask = segment(image, np.ones_like(roi) if self._variant.shown == "whole frame" else roi, "", context).mask
        wall_ns = time.perf_counter_ns() - began_ns
        answer = self._answer
        return VariantRun(
            mask & roi,
            wall_ns,
            dict(answer.stage_ns) if answer else {},
            answer.prefill.image_tokens if answer else 0,
            self._pipeline.loaded.architecture.image_tokens,
            answer.agrees if answer else None,
        )

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        """The `Segmenter` that the crop is shown to; asks the prompt of the verification."""
        from cable_models.lisa.pipeline import FrameRequest

        stream = f"frame {self._frames}" if self._variant.independent else "drive"
        self._frames += 1
        (self._answer,) = self._pipeline.segment([FrameRequest(image, roi, self._prompt, stream)])
        return Segmentation(np.asarray(self._answer.masks.any(axis=0)), 1.0)

    @property
    def text(self) -> str:
        """The last answer in words, or its ids."""
        return "" if self._answer is None else self._answer.text or str(self._answer.answer_ids)


def verify(
    pipeline_of: Callable[[LisaOptions], LisaPipeline],
    frames: Iterable[Frame],
    prompt: Prompt,
    *,
    wanted: float = 0.95,
    coverage: float | None = None,
    fill: FillMode = "grey",
    listener: Callable[[], None] = lambda: None,
) -> Verification:
    """Runs all variants side by side, on the regions that the edge would send.

    The edge's tracker is given the published inference's masks, frame by frame. Frames that it sends whole are not
    counted, for there every variant is the plain path; the first one warms the variants up.

    Args:
        pipeline_of: Makes a pipeline of the loaded model.
        frames: Some frames of one drive, in order.
        prompt: Question, or ids of a prompt.
        wanted: Mean J against the plain path on the region from which on a variant is recommended.
        coverage: Share of the frame in a fixed corridor across its middle, in place of the tracker's region.
        fill: What stands outside R_k.
        listener: Told when a frame is done.

    Raises:
        SourceError: no frame with a region.
        ConfigurationError: ``wanted`` or ``coverage`` is not in 0..1.
    """
    for name, share in (("wanted agreement", wanted), ("coverage", coverage)):
        if share is not None and not 0.0 <= share <= 1.0:
            raise ConfigurationError(f"the {name} is {share}; give 0..1")
    models = [(variant, Runner(pipeline_of(variant.options), variant, prompt)) for variant in variants()]
    tracker = RoiTracker(RoiConfig())
    runs: list[list[VariantRun]] = []
    coverages: list[float] = []
    for number, frame in enumerate(frames):
        proposal = tracker.propose(frame)
        roi = proposal.roi if coverage is None else corridor(*frame.size_hw, coverage)
        region = fill_blocks(frame.image, roi.blocks, roi.block_size, fill)
        done = {
            variant.name: runner.run(frame.image if variant.shown == "whole frame" else region, roi)
            for variant, runner in rotated(models, number)
        }
        tracker.update(frame.index, done[REFERENCE].mask)
        if number > 0 and roi.coverage < 1.0:
            runs.append([done[variant.name] for variant, _ in models])
            coverages.append(roi.coverage)
        listener()
    if not runs:
        raise SourceError(
            "no frame after the first had a region: the tracker found nothing in the model's masks to follow; take "
            "more frames, another source or prompt, or a fixed region with --coverage 0.25"
        )
    return summarised([variant for variant, _ in models], runs, coverages, models[0][1].text, wanted)


T = TypeVar("T")


def rotated(items: Sequence[T], by: int) -> list[T]:
    """The items from number ``by`` on, then those before: no variant always runs first on a warm cache."""
    start = by % len(items)
    return [*items[start:], *items[:start]]


def corridor(height: int, width: int, coverage: float, block_size: int = 8) -> RoiMask:
    """A band across the frame's middle, of the wanted share to within half a row of blocks."""
    roi = RoiMask.full(height, width, block_size)
    rows = max(1, round(coverage * len(roi.blocks)))
    top = (len(roi.blocks) - rows) // 2
    inside = np.zeros_like(roi.blocks)
    inside[top : top + rows] = True
    return RoiMask(inside, block_size, height, width)


def summarised(
    tried: Sequence[Variant],
    runs: Sequence[Sequence[VariantRun]],
    coverages: Sequence[float],
    answer: str,
    wanted: float,
) -> Verification:
    """Means and medians over frames, and the verdict."""
    places = {variant.name: index for index, variant in enumerate(tried)}
    columns = {name: [frame[place] for frame in runs] for name, place in places.items()}
    published, region = (columns[name] for name in (REFERENCE, REGION_REFERENCE))
    results = tuple(result_of(variant, columns[variant.name], published, region) for variant in tried)
    good = [
        result
        for result in results
        if result.variant.shown == "region" and result.to_region.region >= wanted and not result.variant.crop
    ]
    fastest = min(good, key=lambda result: result.wall_ms)
    forced = columns[FORCED]
    return Verification(
        frames=len(runs),
        coverage=fmean(coverages),
        forced_equal=sum(run.agrees is True for run in forced),
        forced_masks=mean_agreement([agreement(a.mask, b.mask) for a, b in zip(forced, published, strict=True)]),
        answer=answer,
        wanted=wanted,
        results=results,
        recommended=fastest.variant,
    )


def result_of(
    variant: Variant,
    runs: Sequence[VariantRun],
    published: Sequence[VariantRun],
    region: Sequence[VariantRun],
) -> VariantResult:
    """One variant's figures."""
    to_region = [agreement(run.mask, other.mask) for run, other in zip(runs, region, strict=True)]
    stages = {name for run in runs for name in run.stage_ns}
    return VariantResult(
        variant,
        mean_agreement([agreement(run.mask, other.mask) for run, other in zip(runs, published, strict=True)]),
        mean_agreement(to_region),
        min(one.region for one in to_region),
        median(run.wall_ns for run in runs) / 1e6,
        {name: median(run.stage_ns.get(name, 0) for run in runs) / 1e6 for name in sorted(stages)},
        fmean(run.image_tokens / run.whole_image_tokens for run in runs),
    )


def mean_agreement(values: Sequence[Agreement]) -> Agreement:
    """Mean of each measure over frames."""
    return Agreement(fmean(value.region for value in values), fmean(value.boundary for value in values))
