"""What was measured of one frame under one strategy; the input of the sequence's metrics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cable_rpc.study.metrics import ByteLayers, MaskOverlap
from cable_rpc.types import Detections, GroundTruth, Segmentation

Float64Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FramePrefill:
    """Tokens and prefill of one frame's language model, by the tokens that really entered."""

    tokens_in: int
    """Visual tokens that entered."""
    tokens_full: int
    """Visual tokens of the whole frame."""
    prompt_tokens: int
    speedup_quadratic: float
    """The paper's estimate."""
    speedup_flops: float
    measured_ns: int = 0
    """This frame's prefill; 0 = not timed."""
    whole_ns: int = 0
    """The prefill of the same frame sent whole; 0 = not timed."""


def frame_prefill(ours: Segmentation | None, whole: Segmentation | None = None) -> FramePrefill | None:
    """Tokens and prefill that a segmenter tells; None where it has no language model or tells nothing of it.

    Args:
        ours: the answer to the frame as received.
        whole: the answer to the same frame sent whole; without it, what ``ours`` tells of whole frames it has seen.
    """
    if ours is None or ours.prefill is None or ours.tokens_full == 0:
        return None
    told = ours.prefill
    whole_ns = whole.prefill.measured_ns if whole is not None and whole.prefill is not None else told.whole_ns
    return FramePrefill(
        ours.tokens_in,
        ours.tokens_full,
        told.prompt_tokens,
        told.speedup_quadratic,
        told.speedup_flops,
        told.measured_ns,
        whole_ns,
    )


@dataclass(frozen=True, slots=True)
class MeasuredFrame:
    """One frame of one sequence under one strategy; None where a thing was not measured or can't exist."""

    index: int
    keyframe: bool
    """c_k: the frame was sent whole."""
    coverage_roi: float | None
    """Share of the frame in R_k, on keyframes too; None without R_k. That of a sequence's first frame isn't used."""
    coverage_tx: float
    """Share of the frame that was sent; a keyframe and the first frame count as 1 whatever is told."""
    staleness: int | None
    """Age of the prior in frames, 1 in lock-step."""
    truth: GroundTruth | None
    """None for a frame without annotation."""
    detections: Detections
    """On the received frame, low scores included (they matter to AP)."""
    full_detections: Detections
    """On the whole frame, likewise."""
    overlap_roi: Float64Array | None
    """float64 [N], share of each truth object's box inside R_k (`metrics.roi_overlap`); None without R_k or truth."""
    overlap_sent: Float64Array | None
    """The same for the region that was sent (all of it on keyframes); None without truth."""
    mask_overlap: MaskOverlap | None
    """The cloud's mask of the received frame against that of the whole frame (`metrics.mask_overlap`)."""
    bytes_up: ByteLayers
    bytes_down: ByteLayers
    full_bytes_up: ByteLayers | None
    """The same frame sent whole."""
    stage_ns: Mapping[str, int] = field(default_factory=dict)
    """Durations by stage; `cable_rpc.study.summary.STAGES` names the usual ones."""
    end_to_end_ns: int | None = None
    prefill: FramePrefill | None = None
