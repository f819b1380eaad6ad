"""Average precision and F1 of a detector over a labelled set; pure NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_models.detection import DetectedBoxes, Float32Array, Int32Array
from cable_models.rtdetr.postprocess import pairwise_iou

MATCH_IOU = 0.5


@dataclass(frozen=True, slots=True)
class Truth:
    """What is in one image."""

    boxes_xyxy: Float32Array
    """float32 [N, 4], pixels."""
    class_ids: Int32Array
    """int32 [N]."""
    counted: npt.NDArray[np.bool_]
    """bool [N]; finding an object that is not counted (too small, hidden) is neither right nor wrong."""


@dataclass(frozen=True, slots=True)
class ClassFigures:
    """Quality for one class."""

    objects: int
    ap50: float
    """Area under the precision-recall curve at IoU 0.5, all points; nan without objects."""
    precision: float
    recall: float
    f1: float
    """Precision, recall and F1 of the detections at or above the operating score."""


def class_figures(
    found: Sequence[DetectedBoxes], truth: Sequence[Truth], class_id: int, operating_score: float
) -> ClassFigures:
    """Scores one class over all images.

    Args:
        found: Detections of each image, down to a low score.
        truth: Objects of each image.
        class_id: The class to score.
        operating_score: Threshold at which precision, recall and F1 are taken.
    """
    hits: list[npt.NDArray[np.int8]] = []
    scores: list[Float32Array] = []
    objects = 0
    for detected, real in zip(found, truth, strict=True):
        mine = detected.select(detected.class_ids == class_id)
        same = real.class_ids == class_id
        objects += int((same & real.counted).sum())
        hits.append(judge(mine, real, same))
        scores.append(mine.scores)
    all_scores = np.concatenate([*scores, np.zeros(0, np.float32)])
    all_hits = np.concatenate([*hits, np.zeros(0, np.int8)])
    judged = all_hits >= 0
    order = np.argsort(-all_scores[judged], kind="stable")
    right, score = all_hits[judged][order], all_scores[judged][order]
    above = int((score >= operating_score).sum())
    correct = int(right[:above].sum())
    return ClassFigures(
        objects=objects,
        ap50=average_precision(right, objects),
        precision=correct / above if above else 0.0,
        recall=correct / objects if objects else 0.0,
        f1=2 * correct / (above + objects) if above + objects else 0.0,
    )


def judge(detected: DetectedBoxes, real: Truth, same_class: npt.NDArray[np.bool_]) -> npt.NDArray[np.int8]:
    """1 right, 0 wrong, -1 not judged, for each detection in order of falling score; one hit per object."""
    verdict = np.zeros(len(detected), np.int8)
    overlap = pairwise_iou(detected.boxes_xyxy, real.boxes_xyxy)
    free = same_class & real.counted
    for row in np.argsort(-detected.scores, kind="stable"):
        candidates = np.where(free, overlap[row], 0)
        if candidates.size and candidates.max() >= MATCH_IOU:
            verdict[row] = 1
            free[candidates.argmax()] = False
        elif np.any(overlap[row][~real.counted] >= MATCH_IOU):
            verdict[row] = -1
    return verdict


def average_precision(right: npt.NDArray[np.int8], objects: int) -> float:
    """Area under the precision envelope (PASCAL VOC 2010 and later, all points).

    Args:
        right: int8 [N], 1 where the detection is right, by falling score.
        objects: Number of objects to find.
    """
    if objects == 0:
        return float("nan")
    correct = np.cumsum(right, dtype=np.int64)
    precision = correct / np.arange(1, len(right) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    recall = np.concatenate([[0], correct / objects])
    return float((np.diff(recall) * envelope).sum())
