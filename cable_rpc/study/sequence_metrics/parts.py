"""Numerators and denominators of a sequence's figures; both add over sequences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import BYTE_LAYERS, GROUPS, RECOGNITION_THRESHOLDS, SIZE_BINS, TRUTH_VARIANTS, TruthVariant
from cable_rpc.study.sequence_metrics.perception import AP_ROWS, IOU_THRESHOLDS, PICTURES, REGIONS, Picture, Region
from cable_rpc.study.sequence_metrics.sequence import SequenceMetrics

Parts = tuple[npt.ArrayLike, npt.ArrayLike]
"""Numerator and denominator of one sequence, numbers or [K]; the figure is the mean over K of the pooled ratios."""

SCORE_NAMES = ("precision", "recall", "f1")


def recognition_parts(
    sequence: SequenceMetrics,
    *,
    threshold: float,
    region: Region,
    variant: TruthVariant,
    group: str | None = None,
    size: str | None = None,
) -> Parts:
    """Objects held at a threshold, and all of them.

    Raises:
        ConfigurationError: an unknown threshold, region, variant, group or size.
    """
    cell = (
        place_of(region, REGIONS),
        place_of(variant, TRUTH_VARIANTS),
        rows_of(group, GROUPS),
        rows_of(size, SIZE_BINS),
    )
    hits = sequence.recognition.hits[(*cell, place_of(threshold, RECOGNITION_THRESHOLDS))]
    return int(hits.sum()), int(sequence.recognition.objects[cell].sum())


def place_of(choice: object, choices: Sequence[object]) -> int:
    """Place of a choice.

    Raises:
        ConfigurationError: it is none of them.
    """
    if choice not in choices:
        raise ConfigurationError(f"there is no {choice!r} among the metrics; choose of {', '.join(map(str, choices))}")
    return choices.index(choice)


def rows_of(choice: str | None, choices: Sequence[str]) -> slice:
    """The row of a choice; None stands for all rows.

    Raises:
        ConfigurationError: it is none of them.
    """
    if choice is None:
        return slice(None)
    place = place_of(choice, choices)
    return slice(place, place + 1)


def threshold_rows(iou: float | None) -> slice:
    """Rows of ``IOU_THRESHOLDS``; None stands for all from 0.5 to 0.95.

    Raises:
        ConfigurationError: the threshold isn't among them.
    """
    if iou is None:
        return AP_ROWS
    nearest = int(np.argmin(np.abs(np.array(IOU_THRESHOLDS) - iou)))
    if abs(IOU_THRESHOLDS[nearest] - iou) > 1e-9:
        raise ConfigurationError(f"no detections were counted at IoU {iou}; choose of 0.3, 0.5, 0.55 ... 0.95")
    return slice(nearest, nearest + 1)


def match_counts(
    sequence: SequenceMetrics, picture: Picture, variant: TruthVariant, iou: float | None, group: str | None = None
) -> npt.NDArray[np.int64]:
    """True positives, false positives, false negatives, int64 [K, 3]."""
    counts = sequence.detection.counts[
        place_of(picture, PICTURES), place_of(variant, TRUTH_VARIANTS), threshold_rows(iou)
    ]
    return counts[:, rows_of(group, GROUPS)].sum(axis=1)


def micro_parts(
    sequence: SequenceMetrics,
    *,
    score: str,
    picture: Picture,
    variant: TruthVariant,
    iou: float | None = 0.5,
    group: str | None = None,
) -> Parts:
    """Pooled precision, recall or F1."""
    right, wrong, missed = match_counts(sequence, picture, variant, iou, group).T
    if score == "precision":
        return right, right + wrong
    if score == "recall":
        return right, right + missed
    return 2 * right, 2 * right + wrong + missed


def macro_parts(
    sequence: SequenceMetrics, *, score: str, picture: Picture, variant: TruthVariant, iou: float | None = 0.5
) -> Parts:
    """Precision, recall or F1 averaged over frames, which the paper does."""
    cell = place_of(picture, PICTURES), place_of(variant, TRUTH_VARIANTS), threshold_rows(iou), SCORE_NAMES.index(score)
    return sequence.detection.frame_scores[cell], sequence.detection.scored_frames[cell]


def byte_parts(sequence: SequenceMetrics, *, layer: str) -> Parts:
    """Bytes up, and those of the same frames sent whole."""
    tally = sequence.layers[BYTE_LAYERS.index(layer)]
    return tally.paired_up, tally.full_up


def retention_parts(sequence: SequenceMetrics, *, row: int) -> Parts:
    """Retained, and reference detections."""
    retained, reference, _ = sequence.retention[row]
    return retained, reference


def spurious_parts(sequence: SequenceMetrics, *, row: int) -> Parts:
    """Spurious, and all detections of the received frames."""
    retained, _, spurious = sequence.retention[row]
    return spurious, retained + spurious
