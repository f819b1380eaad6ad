"""Proves that an exported file answers as torch does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from cable_models.detection import DetectedBoxes, Image
from cable_models.errors import ModelError
from cable_models.rtdetr.checkpoints import Checkpoint
from cable_models.rtdetr.onnx_detector import OnnxDetector, RawDetections
from cable_models.rtdetr.postprocess import decode_logits
from cable_models.rtdetr.preprocess import fill_input
from cable_models.rtdetr.providers import SessionSettings

BOX_TOLERANCE_PX = 0.5
SCORE_TOLERANCE = 1e-3
COMPARED_SCORE = 0.1
FEWEST_COMPARED = 10


@dataclass(frozen=True, slots=True)
class ExportCheck:
    """How far ONNX Runtime is from torch."""

    images: int
    compared: int
    """Detections of torch that were looked for in ONNX Runtime's answer, and the other way round."""
    lowest_score: float
    """Of the detections compared."""
    box_px: float
    """Largest difference of a box side, in pixels of the original image."""
    score: float
    """Largest difference of a score."""

    @property
    def passed(self) -> bool:
        """Within 0.5 px and 0.001."""
        return self.box_px <= BOX_TOLERANCE_PX and self.score <= SCORE_TOLERANCE


def check_export(checkpoint: Checkpoint, path: Path, images: Sequence[Image]) -> ExportCheck:
    """Compares detections of torch and of ONNX Runtime on the CPU, nearest to nearest.

    Order is not compared: equal scores leave it to chance. Detections above 0.1 are, or the ten best of each image
    where there are fewer (an untrained network).

    Args:
        checkpoint: What was exported.
        path: The ONNX file.
        images: uint8 [height, width, 3] BGR, run as one batch by ONNX Runtime and one by one by torch.

    Raises:
        ModelError: no images, or the file can't be run.
    """
    if not images:
        raise ModelError("an export is verified on at least one image, got none")
    detector = OnnxDetector(path, SessionSettings(provider="cpu"))
    answers = onnx_answers(detector, images)
    worst_box = worst_score = 0.0
    lowest, compared = 1.0, 0
    for image, answer in zip(images, answers, strict=True):
        expected = torch_answer(checkpoint, image)
        floor = min(COMPARED_SCORE, float(np.sort(expected.scores)[-FEWEST_COMPARED:][0]))
        lowest = min(lowest, floor)
        for wanted, offered in ((expected, answer), (answer, expected)):
            looked_for = wanted.select(wanted.scores >= floor)
            compared += len(looked_for)
            # a margin below the floor, so that no detection is missed for lying on it
            box, score = largest_difference(looked_for, offered.select(offered.scores >= floor - 2 * SCORE_TOLERANCE))
            worst_box, worst_score = max(worst_box, box), max(worst_score, score)
    return ExportCheck(len(images), compared, lowest, worst_box, worst_score)


def require(check: ExportCheck, path: Path) -> None:
    """Refuses a file that differs from torch.

    Raises:
        ModelError: by how much it differs, and what is allowed.
    """
    if not check.passed:
        raise ModelError(
            f"{path} differs from torch by {check.box_px:.3f} px and {check.score:.5f} in score; "
            f"allowed are {BOX_TOLERANCE_PX} px and {SCORE_TOLERANCE}. Don't ship it"
        )


def onnx_answers(detector: OnnxDetector, images: Sequence[Image]) -> list[DetectedBoxes]:
    """All of the network's answers to one batch, with its own class numbers; boxes not clipped."""
    step = detector.layout.fixed_batch or len(images)
    answers: list[DetectedBoxes] = []
    for start in range(0, len(images), step):
        part = images[start : start + step]
        tensor = detector.input_tensor(step)
        fill_input(part, tensor, detector.recipe)
        answers += [as_boxes(raw) for raw in detector.infer(tensor, [(i.shape[1], i.shape[0]) for i in part])]
    return answers


def torch_answer(checkpoint: Checkpoint, image: Image) -> DetectedBoxes:
    """The same of one image by torch."""
    width, height = checkpoint.recipe.size_wh
    tensor = np.empty((1, 3, height, width), np.float32)
    fill_input([image], tensor, checkpoint.recipe)
    with torch.inference_mode():
        output = checkpoint.model.train(False)(pixel_values=torch.from_numpy(tensor))
    size_wh = (image.shape[1], image.shape[0])
    return as_boxes(decode_logits(output.logits[0].numpy(), output.pred_boxes[0].numpy(), size_wh))


def as_boxes(raw: RawDetections) -> DetectedBoxes:
    """Unfiltered detections with the network's own class numbers."""
    labels, boxes, scores = raw
    return DetectedBoxes(boxes, labels.astype(np.int32), scores)


def largest_difference(wanted: DetectedBoxes, offered: DetectedBoxes) -> tuple[float, float]:
    """Largest box (pixels) and score difference from each wanted detection to its nearest of the same class."""
    if not len(wanted):
        return 0.0, 0.0
    if not len(offered):
        return float("inf"), float("inf")
    box = np.abs(wanted.boxes_xyxy[:, None] - offered.boxes_xyxy[None]).max(axis=2)
    box = np.where(wanted.class_ids[:, None] == offered.class_ids[None], box, np.inf)
    nearest = box.argmin(axis=1)
    score = np.abs(wanted.scores - offered.scores[nearest])
    return float(box.min(axis=1).max()), float(score.max())
