"""COCO's average precision from matched and scored detections, exactly poolable over frames and sequences.

What AP needs of a frame is, for each detection, its score and at which IoU thresholds it was right or excused, and
the number of objects asked for. These lists are joined over frames, ranked by score, and read at 101 recalls, as
COCO's evaluation code does (Lin et al., ECCV 2014; pycocotools ``accumulate``). The class groups are its categories,
objects that aren't asked for its ignored ones, and ignored regions its ``iscrowd`` ones in every category.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_rpc.study.metrics.matching import FrameMatches
from cable_rpc.types import Float32Array

Float64Array = npt.NDArray[np.float64]

AP_IOU_THRESHOLDS = tuple(np.linspace(0.5, 0.95, 10).tolist())
"""The IoU thresholds over which AP is a mean; the first is that of AP50."""
RECALL_POINTS = np.linspace(0.0, 1.0, 101)
MAX_DETECTIONS = 100
"""Best detections of a class group in one frame that count, COCO's ``maxDets``."""


@dataclass(frozen=True, slots=True)
class RankedMatches:
    """Detections of one class group over any number of frames; join those of frames to pool them."""

    scores: Float32Array
    """float32 [D], frame after frame, falling in each."""
    correct: npt.NDArray[np.uint16]
    """uint16 [D], bit t is set where the detection was right at ``AP_IOU_THRESHOLDS[t]``."""
    excused: npt.NDArray[np.uint16]
    """uint16 [D], likewise where it was neither right nor wrong."""
    asked: int
    """Objects asked for."""


def ranked_matches(matches: FrameMatches) -> tuple[RankedMatches, ...]:
    """One frame's contribution to AP, by class group in the order of ``truth_selection.GROUPS``.

    Args:
        matches: at ``AP_IOU_THRESHOLDS``.
    """
    weights = (1 << np.arange(len(AP_IOU_THRESHOLDS))).astype(np.uint16)
    correct = (weights[:, None] * matches.correct).sum(axis=0).astype(np.uint16)
    excused = (weights[:, None] * matches.excused).sum(axis=0).astype(np.uint16)
    groups = []
    for group, asked in enumerate(matches.asked.tolist()):
        rows = np.flatnonzero(matches.groups == group)[:MAX_DETECTIONS]
        groups.append(RankedMatches(matches.scores[rows], correct[rows], excused[rows], asked))
    return tuple(groups)


def join_matches(parts: Sequence[RankedMatches]) -> RankedMatches:
    """One class group's detections of several frames or sequences as one list."""
    return RankedMatches(
        np.concatenate([np.zeros(0, np.float32), *(part.scores for part in parts)]),
        np.concatenate([np.zeros(0, np.uint16), *(part.correct for part in parts)]),
        np.concatenate([np.zeros(0, np.uint16), *(part.excused for part in parts)]),
        sum(part.asked for part in parts),
    )


def average_precision(groups: Sequence[RankedMatches]) -> Float64Array | None:
    """AP at each threshold, the mean over the class groups that have objects asked for.

    Args:
        groups: all detections of each class group.

    Returns:
        float64 [len(AP_IOU_THRESHOLDS)], 0..1; its mean is COCO's AP, its first entry AP50. None without any object.
    """
    if not any(group.asked for group in groups):
        return None
    return drawn_average_precision([[group] for group in groups], np.ones((1, 1), np.int64))[0]


def drawn_average_precision(
    groups: Sequence[Sequence[RankedMatches]], weights: npt.NDArray[np.int64], rows: slice = slice(None)
) -> Float64Array:
    """AP when every sequence counts as often as it is drawn, as if its frames were there that many times.

    Args:
        groups: by class group, then by sequence.
        weights: int64 [B, S], how often each sequence counts.
        rows: of ``AP_IOU_THRESHOLDS``.

    Returns:
        float64 [B, T], the mean over the class groups with objects; NaN where a draw has none at all.
    """
    per_group = np.array([group_average_precision(sequences, weights, rows) for sequences in groups])
    defined = ~np.isnan(per_group)
    count = defined.sum(axis=0)
    total = np.where(defined, per_group, 0.0).sum(axis=0)
    mean: Float64Array = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    return mean


def group_average_precision(
    sequences: Sequence[RankedMatches], weights: npt.NDArray[np.int64], rows: slice
) -> Float64Array:
    """`drawn_average_precision` of one class group, float64 [B, T]; NaN where a draw has no object of it."""
    joined = join_matches(sequences)
    owners = np.repeat(np.arange(len(sequences)), [len(sequence.scores) for sequence in sequences])
    order = np.argsort(-joined.scores, kind="stable")
    asked = weights @ np.array([sequence.asked for sequence in sequences])
    bits = range(len(AP_IOU_THRESHOLDS))[rows]
    found = np.full((len(weights), len(bits)), np.nan)
    present = asked > 0
    share = weights[present].astype(np.float64)
    for column, bit in enumerate(bits):
        correct = (joined.correct[order] >> bit & 1).astype(np.bool_)
        wrong = ~correct & ~(joined.excused[order] >> bit & 1).astype(np.bool_)
        # Precision only has to be known where recall grows.
        places = np.flatnonzero(correct)
        hits = counts_up_to(places, places, owners[order][places], len(sequences))
        mistakes = np.flatnonzero(wrong)
        faults = counts_up_to(places, mistakes, owners[order][mistakes], len(sequences))
        right = share @ hits
        found[present, column] = interpolated(right, right + share @ faults, asked[present])
    return found


def counts_up_to(
    places: npt.NDArray[np.int64], events: npt.NDArray[np.int64], owners: npt.NDArray[np.int64], sequences: int
) -> Float64Array:
    """How many events of each sequence have happened by each place, float64 [S, P].

    Args:
        places: int64 [P], rising ranks.
        events: int64 [E], rising ranks of the events.
        owners: int64 [E], the sequence of each.
        sequences: S.
    """
    counts = np.zeros((sequences, len(places) + 1))
    np.add.at(counts, (owners, np.searchsorted(places, events, side="left")), 1.0)
    return counts[:, :-1].cumsum(axis=1)


def interpolated(correct: Float64Array, ranked: Float64Array, asked: npt.NDArray[np.int64]) -> Float64Array:
    """Mean over ``RECALL_POINTS`` of the best precision at that recall or beyond, 0 at recalls never reached.

    Args:
        correct: float64 [B, P], correct detections so far in each draw.
        ranked: float64 [B, P], detections so far, the excused left out.
        asked: int64 [B], objects asked for, at least 1.

    Returns:
        float64 [B].
    """
    precision = np.divide(correct, ranked, out=np.zeros(correct.shape), where=ranked > 0.0)
    envelope = np.zeros((len(correct), correct.shape[1] + 1))
    envelope[:, :-1] = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    recall = correct / asked[:, None]
    places = np.array([np.searchsorted(row, RECALL_POINTS, side="left") for row in recall], np.int64)
    read: Float64Array = np.take_along_axis(envelope, places.reshape(len(correct), len(RECALL_POINTS)), axis=1)
    return read.sum(axis=1) / len(RECALL_POINTS)
