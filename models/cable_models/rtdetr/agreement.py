"""What a cheaper form of a detector costs: its answers against those of the form it was made from."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cable_models.detection import DetectedBoxes, Image
from cable_models.errors import ModelError
from cable_models.rtdetr.onnx_detector import OnnxDetector
from cable_models.rtdetr.postprocess import pairwise_iou
from cable_models.training.average_precision import Truth, class_figures

MATCH_IOU = 0.5
RANKED_SCORE = 0.01
"""Average precision needs the low scores too."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """A candidate's answers with the reference's taken for the truth."""

    images: int
    objects: int
    """Detections of the reference at or above the operating score."""
    ap50: float
    """Mean over the classes that the reference found, 0..1."""
    matched: float
    """Share of the reference's objects that the candidate reports too, same class, IoU at least 0.5."""
    extra: float
    """Objects that only the candidate reports, as a share of the reference's."""
    score_mean: float
    """Mean absolute difference of the scores of matched objects."""
    score_max: float
    box_px_mean: float
    """Mean over matched objects of the largest difference of a box side."""
    time_ratio: float
    """Median time of a detection by the candidate over the reference's, interleaved; below 1 is faster."""

    def summary(self) -> str:
        """One line."""
        return (
            f"{self.matched:.1%} of {self.objects} objects on {self.images} frames found again, {self.extra:.1%} more, "
            f"AP50 {self.ap50:.3f}, scores differ by {self.score_mean:.3f} (at most {self.score_max:.3f}), boxes by "
            f"{self.box_px_mean:.2f} px; {self.time_ratio:.2f} times the time"
        )


def measure_agreement(reference: OnnxDetector, candidate: OnnxDetector, images: Sequence[Image]) -> Agreement:
    """Compares two forms of one detector.

    Args:
        reference: The fp32 file, opened with ``min_score`` at the operating score.
        candidate: The other form, opened with ``min_score`` `RANKED_SCORE`.
        images: uint8 [height, width, 3] BGR; none that the candidate was calibrated on.

    Raises:
        ModelError: no images, or an inference failed.
    """
    if not images:
        raise ModelError("two detectors are compared on at least one frame, got none")
    operating = reference.settings.min_score
    truth, found = [], []
    slow: list[int] = []
    fast: list[int] = []
    for image in images:
        truth.append(timed(reference, image, slow))
        found.append(timed(candidate, image, fast))
    pairs = [matched_pairs(a, b.select(b.scores >= operating)) for a, b in zip(truth, found, strict=True)]
    objects = sum(len(boxes) for boxes in truth)
    confident = sum(int((boxes.scores >= operating).sum()) for boxes in found)
    matched = sum(len(p.score) for p in pairs)
    scores = np.concatenate([p.score for p in pairs])
    boxes_px = np.concatenate([p.box_px for p in pairs])
    return Agreement(
        images=len(images),
        objects=objects,
        ap50=mean_ap50(truth, found, operating),
        matched=matched / objects if objects else 1.0,
        extra=(confident - matched) / max(objects, 1),
        score_mean=float(scores.mean()) if matched else 0.0,
        score_max=float(scores.max()) if matched else 0.0,
        box_px_mean=float(boxes_px.mean()) if matched else 0.0,
        time_ratio=float(np.median(fast) / np.median(slow)),
    )


def timed(detector: OnnxDetector, image: Image, durations_ns: list[int]) -> DetectedBoxes:
    """Detects, and notes what it took."""
    started = time.perf_counter_ns()
    (boxes,) = detector.detect([image])
    durations_ns.append(time.perf_counter_ns() - started)
    return boxes


@dataclass(frozen=True, slots=True)
class Pairs:
    """Differences of matched objects, one entry each."""

    score: np.ndarray[tuple[int], np.dtype[np.float32]]
    box_px: np.ndarray[tuple[int], np.dtype[np.float32]]


def matched_pairs(reference: DetectedBoxes, candidate: DetectedBoxes) -> Pairs:
    """Matches one to one, best score of the reference first, to the free box of its class with the largest overlap."""
    overlap = pairwise_iou(reference.boxes_xyxy, candidate.boxes_xyxy)
    overlap = np.where(reference.class_ids[:, None] == candidate.class_ids[None], overlap, 0)
    score: list[float] = []
    box_px: list[float] = []
    for row in range(len(reference)):
        column = int(overlap[row].argmax()) if len(candidate) else -1
        if column < 0 or overlap[row, column] < MATCH_IOU:
            continue
        overlap[:, column] = 0
        score.append(abs(float(reference.scores[row] - candidate.scores[column])))
        box_px.append(float(np.abs(reference.boxes_xyxy[row] - candidate.boxes_xyxy[column]).max()))
    return Pairs(np.array(score, np.float32), np.array(box_px, np.float32))


def mean_ap50(truth: Sequence[DetectedBoxes], found: Sequence[DetectedBoxes], operating: float) -> float:
    """AP at IoU 0.5 with the reference's detections as truth, mean over their classes; 1 where there are none."""
    as_truth = [Truth(t.boxes_xyxy, t.class_ids, np.ones(len(t), np.bool_)) for t in truth]
    classes = sorted({int(index) for t in truth for index in t.class_ids})
    figures = [class_figures(found, as_truth, index, operating) for index in classes]
    return float(np.mean([f.ap50 for f in figures])) if figures else 1.0
