"""Resizing frames together with the camera they were taken by."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from cable_rpc.types import CameraIntrinsics, Frame, GroundTruth, Image


def resize_image(image: Image, size_wh: tuple[int, int]) -> Image:
    """uint8 [height, width, 3] at another size: area average when shrinking, bilinear when growing."""
    width, height = size_wh
    if image.shape[:2] == (height, width):
        return image
    shrinking = width <= image.shape[1] and height <= image.shape[0]
    interpolation = cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
    return cv2.resize(image, size_wh, interpolation=interpolation).astype(np.uint8, copy=False)


def scaled_intrinsics(
    intrinsics: CameraIntrinsics | None, from_wh: tuple[int, int], to_wh: tuple[int, int]
) -> CameraIntrinsics | None:
    """The camera after resizing its image; None stays None."""
    if intrinsics is None:
        return None
    return intrinsics.scaled(to_wh[0] / from_wh[0], to_wh[1] / from_wh[1])


def resize_frame(frame: Frame, size_wh: tuple[int, int]) -> Frame:
    """A frame at another size, its camera and truth scaled along; the frame itself where it has that size."""
    height, width = frame.size_hw
    if (width, height) == size_wh:
        return frame
    return replace(
        frame,
        image=resize_image(frame.image, size_wh),
        intrinsics=scaled_intrinsics(frame.intrinsics, (width, height), size_wh),
        truth=None if frame.truth is None else scaled_truth(frame.truth, (width, height), size_wh),
    )


def scaled_truth(truth: GroundTruth, from_wh: tuple[int, int], to_wh: tuple[int, int]) -> GroundTruth:
    """Annotations after resizing their image."""
    factor_x, factor_y = to_wh[0] / from_wh[0], to_wh[1] / from_wh[1]
    factors = np.array([factor_x, factor_y, factor_x, factor_y], np.float32)
    mask, ignored = truth.instance_mask, truth.ignored_boxes_xyxy
    if mask is not None:
        mask = cv2.resize(mask, to_wh, interpolation=cv2.INTER_NEAREST).astype(np.int32, copy=False)
    return replace(
        truth,
        boxes_xyxy=truth.boxes_xyxy * factors,
        instance_mask=mask,
        ignored_boxes_xyxy=None if ignored is None else ignored * factors,
    )
