"""Taking the lens distortion out of Waymo's images and boxes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.waymo.camera import Calibration
from cable_rpc.types import GroundTruth, Image

EDGE_PARTS = 8
"""Pieces of a box's edge: a straight edge becomes a curve."""


class Lens:
    """The distortion of one camera (OpenCV's k1, k2, p1, p2, k3), to be undone with the pinhole part kept.

    Args:
        calibration: of the camera.
    """

    def __init__(self, calibration: Calibration) -> None:
        pinhole = calibration.intrinsics
        self._matrix = np.array([[pinhole.fx, 0.0, pinhole.cx], [0.0, pinhole.fy, pinhole.cy], [0.0, 0.0, 1.0]])
        self._distortion = np.array(calibration.distortion)
        self._size_wh = calibration.size_wh
        self._maps = cv2.initUndistortRectifyMap(
            self._matrix, self._distortion, np.eye(3), self._matrix, self._size_wh, cv2.CV_16SC2
        )

    def undistort(self, image: Image) -> Image:
        """The image that a pinhole camera would have taken; black where the lens saw nothing."""
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR).astype(np.uint8, copy=False)

    def undistort_truth(self, truth: GroundTruth) -> GroundTruth:
        """The truth with boxes around the straightened outlines of its own, clipped to the image."""
        if not len(truth):
            return truth
        outlines = box_outlines(truth.boxes_xyxy.astype(np.float64))
        points = cv2.undistortPoints(outlines.reshape(-1, 1, 2), self._matrix, self._distortion, P=self._matrix)
        moved = points.reshape(outlines.shape)
        boxes = np.concatenate([moved.min(axis=1), moved.max(axis=1)], axis=1)
        clipped = np.clip(boxes, 0.0, np.array([*self._size_wh, *self._size_wh], np.float64)).astype(np.float32)
        inside = np.prod(clipped[:, 2:] - clipped[:, :2], axis=1) / np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
        seen = inside > 0
        return replace(
            truth,
            boxes_xyxy=clipped[seen],
            class_ids=truth.class_ids[seen],
            track_ids=truth.track_ids[seen],
            visibility=np.minimum(truth.visibility, inside)[seen].astype(np.float32),
        )


def box_outlines(boxes_xyxy: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Points along the edges of boxes [N, 4]: float64 [N, M, 2], corners included."""
    along = np.linspace(0.0, 1.0, EDGE_PARTS + 1)
    ends = np.stack([along, 1.0 - along], axis=1)
    x = ends @ np.stack([boxes_xyxy[:, 2], boxes_xyxy[:, 0]])
    y = ends @ np.stack([boxes_xyxy[:, 3], boxes_xyxy[:, 1]])
    x_min, y_min, x_max, y_max = (np.broadcast_to(side, x.shape) for side in boxes_xyxy.T)
    edges = [np.stack(pair, axis=-1) for pair in ((x, y_min), (x, y_max), (x_min, y), (x_max, y))]
    return np.concatenate(edges).transpose(1, 0, 2)
