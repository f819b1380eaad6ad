"""Resizing frames together with the camera they were taken by."""

from __future__ import annotations

import cv2
import numpy as np

from cable_rpc.types import CameraIntrinsics, Image


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
