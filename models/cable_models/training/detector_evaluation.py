"""Held-out figures of a detector: by class, and by the groups vehicle, pedestrian, cyclist."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cable_models.detection import DetectedBoxes, Image, Int32Array
from cable_models.rtdetr.labels import COCO_GROUP_OF
from cable_models.training.average_precision import ClassFigures, Truth, class_figures
from cable_models.training.samples import LabelledImage, learnable

OPERATING_SCORE = 0.4
LOWEST_SCORE = 0.01
GROUP_NAMES: Mapping[int, str] = {0: "pedestrian", 1: "cyclist", 2: "vehicle"}
"""Names of the groups of `COCO_GROUP_OF`."""

Detect = Callable[[Image], DetectedBoxes]
"""Detections of one image, uint8 [H, W, 3] BGR, down to `LOWEST_SCORE`."""


@dataclass(frozen=True, slots=True)
class Counted:
    """Which objects are scored; finding any other is neither right nor wrong."""

    min_height: float = 0.06
    """Smallest box height as a share of the image height."""
    min_visibility: float = 0.25
    """Smallest visible share."""


EVERY_OBJECT = Counted(min_height=12 / 540)
HALF_VISIBLE = Counted(min_visibility=0.5)
"""What quality figures of streams ask for."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Quality on held-out images."""

    classes: dict[str, ClassFigures]
    """By COCO class id, as text."""
    groups: dict[str, ClassFigures]
    """By group: a bus found as a truck is a vehicle found."""

    @property
    def mean_ap50(self) -> float:
        """Mean AP50 over the groups that occur."""
        values = [figures.ap50 for figures in self.groups.values() if figures.objects]
        return float(np.mean(values)) if values else 0.0

    def as_json(self) -> str:
        """One line of JSON."""
        rows = {name: figures_row(figures) for name, figures in {**self.groups, **self.classes}.items()}
        return json.dumps({"mean_ap50": round(self.mean_ap50, 4), **rows})


def figures_row(figures: ClassFigures) -> dict[str, float | int | None]:
    """One class or group, rounded."""
    return {
        "objects": figures.objects,
        "ap50": round(figures.ap50, 4) if figures.objects else None,
        "precision": round(figures.precision, 4),
        "recall": round(figures.recall, 4),
        "f1": round(figures.f1, 4),
    }


def evaluate(
    detect: Detect, held_out: Sequence[LabelledImage], class_ids: Sequence[int], counted: Counted | None = None
) -> Evaluation:
    """AP50 and figures at the operating score, on images as a user would give them.

    Args:
        detect: The detector.
        held_out: Labelled images of any size.
        class_ids: COCO classes to score.
        counted: Which objects count, those of 6 % of the height and more by default.
    """
    found = [detect(sample.image) for sample in held_out]
    return judge_all(found, held_out, class_ids, counted or Counted())


def judge_all(
    found: Sequence[DetectedBoxes], held_out: Sequence[LabelledImage], class_ids: Sequence[int], counted: Counted
) -> Evaluation:
    """Scores detections that are already there; arguments as for `evaluate`."""
    truth = [truth_of(sample, counted) for sample in held_out]
    classes = {str(index): class_figures(found, truth, index, OPERATING_SCORE) for index in class_ids}
    merged_found = [replace(boxes, class_ids=grouped(boxes.class_ids)) for boxes in found]
    merged_truth = [replace(boxes, class_ids=grouped(boxes.class_ids)) for boxes in truth]
    groups = {
        GROUP_NAMES[group]: class_figures(merged_found, merged_truth, group, OPERATING_SCORE)
        for group in sorted({COCO_GROUP_OF[index] for index in class_ids if index in COCO_GROUP_OF})
    }
    return Evaluation(classes, groups)


def truth_of(sample: LabelledImage, counted: Counted) -> Truth:
    """Labels with their mark of being scored."""
    scored = learnable(
        sample.boxes_xyxy, sample.visibility, sample.image.shape[0], counted.min_height, counted.min_visibility
    )
    return Truth(sample.boxes_xyxy, sample.class_ids, scored)


def grouped(class_ids: Int32Array) -> Int32Array:
    """COCO classes to road-user groups, int32 [N]; -1 outside them."""
    return np.array([COCO_GROUP_OF.get(int(index), -1) for index in class_ids], np.int32)
