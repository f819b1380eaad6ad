"""One received picture with its detections, small enough to keep with every cell."""

from __future__ import annotations

import cv2
import numpy as np

from cable_rpc.study.closed_loop.lane import Passage
from cable_rpc.study.closed_loop.measured_frame import Reference
from cable_rpc.study.metrics import without_counterpart
from cable_rpc.study.sequence_metrics import OPERATING_SCORE
from cable_rpc.study.sweep.cell import ExampleFrame
from cable_rpc.types import Detections, Float32Array, Image

WIDEST = 640
JPEG_QUALITY = 80
KEPT, LOST, INVENTED = (96, 200, 60), (60, 60, 230), (0, 200, 255)
"""BGR."""


def draw_example(passage: Passage, reference: Reference) -> ExampleFrame:
    """The picture as the models saw it, with what they still find, what they lost, and what they invented."""
    found, wanted = sure(passage.detections), sure(reference.detections)
    invented, lost = without_counterpart(found, wanted), without_counterpart(wanted, found)
    picture, scale = reduced(passage.picture)
    for boxes, colour in (
        (found.boxes_xyxy[~invented], KEPT),
        (found.boxes_xyxy[invented], INVENTED),
        (wanted.boxes_xyxy[lost], LOST),
    ):
        draw_boxes(picture, boxes * scale, colour)
    _, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return ExampleFrame(passage.prepared.index, coded.tobytes(), passage.prepared.uplink_message_bytes)


def sure(detections: Detections) -> Detections:
    """Those that count."""
    return detections.select(detections.scores >= OPERATING_SCORE)


def reduced(picture: Image) -> tuple[Image, float]:
    """A copy of at most `WIDEST` columns, and its scale."""
    height, width = picture.shape[:2]
    scale = min(1.0, WIDEST / width)
    size = (round(width * scale), max(1, round(height * scale)))
    return np.array(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8), scale


def draw_boxes(picture: Image, boxes_xyxy: Float32Array, colour: tuple[int, int, int]) -> None:
    """Outlines in place."""
    for left, top, right, bottom in np.rint(boxes_xyxy).astype(int).tolist():
        cv2.rectangle(picture, (left, top), (right, bottom), colour, 2)
