"""Precision, recall and F1 of match counts: pooled, and averaged over frames as the paper does."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from cable_rpc.study.metrics.matching import MatchCounts
from cable_rpc.study.metrics.statistics import mean_or_none


@dataclass(frozen=True, slots=True)
class Scores:
    """Precision, recall and F1, each 0..1; None where undefined."""

    precision: float | None
    recall: float | None
    f1: float | None


def scores_of(counts: MatchCounts) -> Scores:
    """Precision, recall and F1 of one set of counts: pooled over a run (``micro``) or of one frame.

    Nothing to find and nothing found scores 1 throughout. Nothing to find but something found: precision and
    F1 are 0, recall is undefined. Something to find and nothing found: all 0.
    """
    found = counts.true_positives + counts.false_positives
    wanted = counts.true_positives + counts.false_negatives
    if wanted == 0:
        return Scores(1.0, 1.0, 1.0) if found == 0 else Scores(0.0, None, 0.0)
    precision = counts.true_positives / found if found else 0.0
    return Scores(precision, counts.true_positives / wanted, 2.0 * counts.true_positives / (found + wanted))


def macro_frame(frames: Iterable[MatchCounts]) -> Scores:
    """Mean of the per-frame scores, undefined values skipped; this is how the paper averages."""
    per_frame = [scores_of(counts) for counts in frames]
    return Scores(
        mean_or_none(frame.precision for frame in per_frame),
        mean_or_none(frame.recall for frame in per_frame),
        mean_or_none(frame.f1 for frame in per_frame),
    )
