"""From raw network outputs to boxes in pixels; pure NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cable_models.detection import DetectedBoxes, Float32Array, Int32Array
from cable_models.rtdetr.labels import NOT_COCO, group_ids

DUPLICATE_IOU = 0.7


def decode_logits(
    logits: npt.NDArray[np.floating[Any]], pred_boxes: npt.NDArray[np.floating[Any]], size_wh: tuple[int, int]
) -> tuple[npt.NDArray[np.int64], Float32Array, Float32Array]:
    """RT-DETR's own post-processing of one image.

    Sigmoid, then the best ``queries`` entries of the flat queries x classes table (one query may give
    several classes), then boxes scaled by the original size; as ``RTDetrImageProcessor`` does it.

    Args:
        logits: float [queries, classes].
        pred_boxes: float [queries, 4], centre x, centre y, width, height in 0..1.
        size_wh: Width and height of the original image in pixels.

    Returns:
        labels int64 [queries], boxes float32 [queries, 4] xyxy in pixels, scores float32 [queries],
        best score first.
    """
    queries, classes = logits.shape
    flat = logits.astype(np.float32).ravel()
    best = np.argpartition(-flat, queries - 1)[:queries] if classes > 1 else np.arange(queries)
    best = best[np.argsort(-flat[best], kind="stable")]
    # tanh form: exp() of a large negative logit would overflow
    scores = 0.5 * (1.0 + np.tanh(0.5 * flat[best]))
    centre_size = pred_boxes.astype(np.float32)[best // classes]
    half = centre_size[:, 2:] / 2
    corners = np.concatenate([centre_size[:, :2] - half, centre_size[:, :2] + half], axis=1)
    scale = np.array([*size_wh, *size_wh], np.float32)
    return best % classes, corners * scale, scores.astype(np.float32)


def select_detections(
    labels: npt.NDArray[np.int64],
    boxes_xyxy: Float32Array,
    scores: Float32Array,
    *,
    coco_index: Int32Array,
    wanted: npt.NDArray[np.bool_],
    min_score: float,
    size_wh: tuple[int, int],
    deduplicate: bool = True,
) -> DetectedBoxes:
    """Thresholds, maps labels to COCO-80, keeps the wanted classes and removes second labels of one object.

    Args:
        labels: int64 [N], the model's own class indices.
        boxes_xyxy: float32 [N, 4], pixels.
        scores: float32 [N].
        coco_index: int32 [classes], COCO-80 index of each model class.
        wanted: bool [80], COCO classes to report.
        min_score: Lowest score reported.
        size_wh: Width and height of the image; boxes are clipped to it.
        deduplicate: Remove second labels (car and truck, say); False leaves them, as the published processor does.
    """
    confident = np.flatnonzero(scores >= min_score)
    class_ids = coco_index[labels[confident]]
    known = (class_ids != NOT_COCO) & wanted[class_ids]
    chosen = confident[known]
    class_ids = class_ids[known]
    order = np.argsort(-scores[chosen], kind="stable")
    chosen, class_ids = chosen[order], class_ids[order]
    limit = np.array([*size_wh, *size_wh], np.float32)
    boxes = np.clip(boxes_xyxy[chosen], 0, limit).astype(np.float32)
    found = DetectedBoxes(boxes, class_ids.astype(np.int32), scores[chosen].astype(np.float32))
    visible = (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])
    found = found.select(visible)
    if not deduplicate:
        return found
    return found.select(first_of_duplicates(found.boxes_xyxy, group_ids(found.class_ids)))


def first_of_duplicates(boxes_xyxy: Float32Array, groups: Int32Array) -> npt.NDArray[np.bool_]:
    """Greedy non-maximum suppression inside each group, boxes ordered by falling score.

    Args:
        boxes_xyxy: float32 [N, 4].
        groups: int32 [N]; boxes of different groups never suppress each other.

    Returns:
        bool [N], True for the boxes to keep.
    """
    rivals = (pairwise_iou(boxes_xyxy, boxes_xyxy) > DUPLICATE_IOU) & (groups[:, None] == groups[None, :])
    keep = np.ones(len(boxes_xyxy), np.bool_)
    for row in np.flatnonzero(np.triu(rivals, 1).any(axis=1)):
        if keep[row]:
            keep[row + 1 :] &= ~rivals[row, row + 1 :]
    return keep


def pairwise_iou(first_xyxy: Float32Array, second_xyxy: Float32Array) -> Float32Array:
    """Intersection over union of every pair, float32 [N, M]; 0 where both boxes are empty."""
    low = np.maximum(first_xyxy[:, None, :2], second_xyxy[None, :, :2])
    high = np.minimum(first_xyxy[:, None, 2:], second_xyxy[None, :, 2:])
    overlap = np.clip(high - low, 0, None).prod(axis=2)
    area_first = (first_xyxy[:, 2:] - first_xyxy[:, :2]).prod(axis=1)
    area_second = (second_xyxy[:, 2:] - second_xyxy[:, :2]).prod(axis=1)
    union = area_first[:, None] + area_second[None, :] - overlap
    return np.asarray(np.divide(overlap, union, out=np.zeros_like(overlap), where=union > 0), np.float32)
