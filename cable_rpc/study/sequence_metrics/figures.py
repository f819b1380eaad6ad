"""The named figures of a data set: each a ratio of sums over sequences, so that it pools and can be resampled.

Names without a suffix are the headline; ``_paper`` marks the paper's own definition of the same thing where it differs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
import numpy.typing as npt

from cable_rpc.study.metrics import BYTE_LAYERS, RECOGNITION_THRESHOLDS, TRUTH_VARIANTS
from cable_rpc.study.prefill import PROMPT_TOKENS, VISUAL_TOKENS, prefill_flops
from cable_rpc.study.sequence_metrics.parts import (
    SCORE_NAMES,
    Parts,
    byte_parts,
    macro_parts,
    micro_parts,
    recognition_parts,
    retention_parts,
    spurious_parts,
)
from cable_rpc.study.sequence_metrics.perception import PICTURES, REGIONS, RETENTION_IOUS
from cable_rpc.study.sequence_metrics.sequence import SequenceMetrics

Float64Array = npt.NDArray[np.float64]
WHOLE_TOKENS = PROMPT_TOKENS + VISUAL_TOKENS


def same(ratio: Float64Array) -> Float64Array:
    """The ratio itself."""
    return ratio


def one_minus(ratio: Float64Array) -> Float64Array:
    """The rest."""
    return 1.0 - ratio


@dataclass(frozen=True, slots=True)
class Figure:
    """A ratio of sums."""

    meaning: str
    parts: Callable[[SequenceMetrics], Parts]
    transform: Callable[[Float64Array], Float64Array] = same
    """Applied to the pooled ratio."""


def coverage_figures() -> dict[str, Figure]:
    """Coverage, keyframes, and tokens and prefill as estimated from coverage."""
    return {
        "coverage_roi": Figure(
            "share of pixels in R_k, mean over all frames but the first (the paper's coverage)",
            lambda s: (s.coverage_roi.coverage, s.coverage_roi.frames),
        ),
        "coverage_tx": Figure(
            "share of pixels sent, keyframes and the first frame as 1",
            lambda s: (s.coverage_tx.coverage, s.coverage_tx.frames),
        ),
        "pixel_saving_paper": Figure(
            "1 - coverage_roi, the paper's BW Save; pixels, not bytes",
            lambda s: (s.coverage_roi.coverage, s.coverage_roi.frames),
            one_minus,
        ),
        "pixel_saving": Figure(
            "1 - coverage_tx; pixels, not bytes",
            lambda s: (s.coverage_tx.coverage, s.coverage_tx.frames),
            one_minus,
        ),
        "keyframe_rate": Figure(
            "share of frames sent whole, the first included", lambda s: (s.keyframes.keyframes, s.keyframes.frames)
        ),
        "refresh_rate": Figure(
            "share of the frames after the first that were sent whole",
            lambda s: (s.keyframes.refreshes, s.keyframes.later_frames),
        ),
        "token_reduction_paper": Figure(
            "1 - n_in / (n_p + n_v) for coverage_roi, (n_v, n_p) = (256, 94)",
            lambda s: (s.coverage_roi.token_reduction, s.coverage_roi.frames),
        ),
        "token_reduction": Figure(
            "1 - n_in / (n_p + n_v) for coverage_tx, (n_v, n_p) = (256, 94)",
            lambda s: (s.coverage_tx.token_reduction, s.coverage_tx.frames),
        ),
        "prefill_quadratic_paper": Figure(
            "mean over frames of ((n_p + n_v) / n_in)^2 for coverage_roi, the paper's prefill column",
            lambda s: (s.coverage_roi.quadratic, s.coverage_roi.frames),
        ),
        "prefill_quadratic_roi": Figure(
            "((n_p + n_v) / mean n_in)^2 for coverage_roi: the paper's estimate as a ratio of means",
            lambda s: (s.coverage_roi.frames * WHOLE_TOKENS, s.coverage_roi.tokens),
            np.square,
        ),
        "prefill_quadratic": Figure(
            "((n_p + n_v) / mean n_in)^2 for coverage_tx: the paper's estimate as a ratio of means, for what was sent",
            lambda s: (s.coverage_tx.frames * WHOLE_TOKENS, s.coverage_tx.tokens),
            np.square,
        ),
        "prefill_flops_paper": Figure(
            "mean over frames of the prefill's speed-up by operations for coverage_roi",
            lambda s: (s.coverage_roi.flops_speedup, s.coverage_roi.frames),
        ),
        "prefill_flops": Figure(
            "operations of whole frames' prefills over those of the frames for coverage_tx",
            lambda s: (s.coverage_tx.frames * prefill_flops(WHOLE_TOKENS), s.coverage_tx.flops),
        ),
    }


def model_figures() -> dict[str, Figure]:
    """Tokens and prefill by what entered the language model, and masks."""
    return {
        "token_reduction_model": Figure(
            "1 - tokens that entered the language model / tokens of whole frames, prompt in both",
            lambda s: (s.prefill.tokens, s.prefill.whole_tokens),
            one_minus,
        ),
        "prefill_quadratic_model_paper": Figure(
            "mean over frames of the paper's estimate for the tokens that entered",
            lambda s: (s.prefill.quadratic, s.prefill.frames),
        ),
        "prefill_quadratic_model": Figure(
            "the paper's estimate for the tokens that entered, work of whole frames over work done",
            lambda s: (s.prefill.whole_quadratic_work, s.prefill.quadratic_work),
        ),
        "prefill_flops_model": Figure(
            "operations of whole frames' prefills over those of the tokens that entered",
            lambda s: (s.prefill.whole_tokens, s.prefill.flops_work),
        ),
        "prefill_measured_paper": Figure(
            "the whole frame's prefill over the frame's, as timed, mean over frames",
            lambda s: (s.prefill.measured_speedup, s.prefill.timed_frames),
        ),
        "prefill_measured": Figure(
            "the whole frames' prefills over those of the frames, as timed, pooled",
            lambda s: (s.prefill.whole_ns, s.prefill.measured_ns),
        ),
        "mask_iou_frames": Figure(
            "IoU of the cloud's mask with that of the whole frame, mean over frames, 1 where both are empty",
            lambda s: (s.masks.iou, s.masks.frames),
        ),
        "mask_iou": Figure(
            "IoU of the cloud's mask with that of the whole frame, pixels pooled over frames",
            lambda s: (s.masks.intersection_px, s.masks.union_px),
        ),
    }


def recognition_figures() -> dict[str, Figure]:
    """Recognition at the paper's threshold and along the curve."""
    figures: dict[str, Figure] = {}
    for threshold, region, variant in product(RECOGNITION_THRESHOLDS, REGIONS, TRUTH_VARIANTS):
        percent = round(100 * threshold)
        suffix = ("" if region == "roi" else "_sent") + ("" if variant == "all" else "_visible")
        where = "R_k" if region == "roi" else "what was sent"
        figures[f"recognition_{percent:02d}{suffix}"] = Figure(
            f"{variant} objects of which {where} holds at least {percent} % of the box, pooled over objects",
            partial(recognition_parts, threshold=threshold, region=region, variant=variant),
        )
    return figures


def detection_figures() -> dict[str, Figure]:
    """Precision, recall and F1 at IoU 0.5, and pooled at other thresholds."""
    figures: dict[str, Figure] = {}
    for picture, variant, score in product(PICTURES, TRUTH_VARIANTS, SCORE_NAMES):
        where = f"{score} on the {'received' if picture == 'roi' else 'whole'} frame against {variant} objects"
        name = f"{picture}_{score}" + ("" if variant == "all" else "_visible")
        macro = partial(macro_parts, score=score, picture=picture, variant=variant)
        micro = partial(micro_parts, score=score, picture=picture, variant=variant)
        figures[f"{name}_paper"] = Figure(f"{where} at IoU 0.5, mean over frames", macro)
        figures[name] = Figure(f"{where} at IoU 0.5, pooled", micro)
        figures[f"{name}_iou30"] = Figure(f"{where} at IoU 0.3, pooled", partial(micro, iou=0.3))
        figures[f"{name}_iou50_95"] = Figure(
            f"{where}, pooled at each IoU of 0.5, 0.55 ... 0.95 and averaged", partial(micro, iou=None)
        )
    return figures


def retention_figures() -> dict[str, Figure]:
    """Detections kept and invented, against those on the whole frame."""
    figures: dict[str, Figure] = {}
    for row, iou in enumerate(RETENTION_IOUS):
        suffix = "" if row == 0 else f"_{round(100 * iou)}"
        figures[f"retention{suffix}"] = Figure(
            f"share of the whole frame's detections found again at IoU {iou}, pooled", partial(retention_parts, row=row)
        )
        figures[f"spurious_rate{suffix}"] = Figure(
            f"share of the received frame's detections that the whole frame has not at IoU {iou}, pooled",
            partial(spurious_parts, row=row),
        )
    return figures


def byte_figures() -> dict[str, Figure]:
    """Byte savings at the four layers."""
    return {
        f"byte_saving_{layer}": Figure(
            f"1 - bytes up / bytes of the same frames sent whole, {layer}", partial(byte_parts, layer=layer), one_minus
        )
        for layer in BYTE_LAYERS
    }


FIGURES: Mapping[str, Figure] = {
    **coverage_figures(),
    **model_figures(),
    **recognition_figures(),
    **detection_figures(),
    **retention_figures(),
    **byte_figures(),
}
"""Every named figure, in the order of a report."""
