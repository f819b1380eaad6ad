"""Exports a trained RT-DETR to ONNX and proves that the file answers as torch does."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from torch import nn
from transformers import RTDetrForObjectDetection

from cable_models.detection import DetectedBoxes, Image
from cable_models.errors import ModelError
from cable_models.rtdetr.compact import CompactRtDetrConfig
from cable_models.rtdetr.labels import coco_index_table
from cable_models.rtdetr.onnx_detector import OnnxDetector
from cable_models.rtdetr.postprocess import decode_logits, select_detections
from cable_models.rtdetr.preprocess import fill_input

OPSET = 17
BOX_TOLERANCE_PX = 0.5
SCORE_TOLERANCE = 1e-3
COMPARED_SCORE = 0.1

PREPROCESSING = "BGR to RGB, straight bilinear resize to the input size, divide by 255, NCHW; no mean or deviation"


class LogitsAndBoxes(nn.Module):
    """The two tensors of the published transformers export, without the rest of the output object."""

    def __init__(self, model: RTDetrForObjectDetection) -> None:
        super().__init__()
        self.model = model

    def forward(self, pixel_values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """``logits`` [N, queries, classes] and ``pred_boxes`` [N, queries, 4]."""
        output = self.model(pixel_values=pixel_values)
        return output.logits, output.pred_boxes


def export_onnx(
    model: RTDetrForObjectDetection, config: CompactRtDetrConfig, path: Path, notes: Mapping[str, str]
) -> None:
    """Writes the graph (batch dynamic, image size fixed) with everything a reader needs in its metadata.

    Args:
        model: Trained model.
        config: Its size and labels.
        path: ONNX file to write.
        notes: Further metadata, such as ``source`` and ``licence``.
    """
    width, height = config.input_size_wh
    # the exporter that is not based on dynamo: the newer one froze the batch at the example's size
    torch.onnx.export(
        LogitsAndBoxes(model).train(False),
        (torch.zeros(2, 3, height, width),),
        str(path),
        input_names=["pixel_values"],
        output_names=["logits", "pred_boxes"],
        dynamic_axes={name: {0: "batch"} for name in ("pixel_values", "logits", "pred_boxes")},
        opset_version=OPSET,
        dynamo=False,
    )
    graph = onnx.load(str(path))
    metadata = {
        "labels": json.dumps(dict(enumerate(config.labels))),
        "input_width": str(width),
        "input_height": str(height),
        "preprocessing": PREPROCESSING,
        "architecture": "RT-DETR (RTDetrForObjectDetection of transformers), compact configuration",
        **notes,
    }
    onnx.helper.set_model_props(graph, metadata)
    onnx.checker.check_model(graph)
    onnx.save(graph, str(path))


def verify_export(
    model: RTDetrForObjectDetection, config: CompactRtDetrConfig, path: Path, images: Sequence[Image]
) -> tuple[float, float]:
    """Compares the detections of torch and of ONNX Runtime on real images, nearest to nearest.

    Args:
        model: The exported model.
        config: Its size and labels.
        path: The ONNX file.
        images: uint8 [height, width, 3] BGR, run as one batch by ONNX Runtime and one by one by torch.

    Returns:
        Largest difference of a box side in pixels, and of a score.

    Raises:
        ModelError: they differ by more than 0.5 px or 0.001, or one finds an object that the other doesn't.
    """
    # a margin under the compared score, so that no detection is missed for lying on the threshold
    low = COMPARED_SCORE - 2 * SCORE_TOLERANCE
    detector = OnnxDetector(path, providers=["CPUExecutionProvider"], min_score=low)
    worst_box = worst_score = 0.0
    for image, found in zip(images, detector.detect(images), strict=True):
        expected = detect_with_torch(model, config, image, low)
        for first, second in ((expected, found), (found, expected)):
            box, score = largest_difference(first.select(first.scores >= COMPARED_SCORE), second)
            worst_box, worst_score = max(worst_box, box), max(worst_score, score)
    if worst_box > BOX_TOLERANCE_PX or worst_score > SCORE_TOLERANCE:
        raise ModelError(
            f"{path} differs from torch by {worst_box:.3f} px and {worst_score:.5f} in score; "
            f"allowed are {BOX_TOLERANCE_PX} px and {SCORE_TOLERANCE}. Don't ship it"
        )
    return worst_box, worst_score


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


def detect_with_torch(
    model: RTDetrForObjectDetection, config: CompactRtDetrConfig, image: Image, min_score: float
) -> DetectedBoxes:
    """Detections of one image, all classes, without ONNX."""
    width, height = config.input_size_wh
    tensor = np.empty((1, 3, height, width), np.float32)
    fill_input([image], tensor)
    with torch.inference_mode():
        output = model.train(False)(pixel_values=torch.from_numpy(tensor))
    size_wh = (image.shape[1], image.shape[0])
    return select_detections(
        *decode_logits(output.logits[0].numpy(), output.pred_boxes[0].numpy(), size_wh),
        coco_index=coco_index_table(dict(enumerate(config.labels))),
        wanted=np.ones(80, np.bool_),
        min_score=min_score,
        size_wh=size_wh,
    )
