"""From a camera image to the network's input."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from cable_models.detection import Image
from cable_models.errors import ModelError

FloatTensor = npt.NDArray[np.floating[Any]]


def check_image(image: Image, position: int) -> None:
    """Refuses anything but a non-empty uint8 [H, W, 3] array.

    Raises:
        ModelError: wrong dtype or shape.
    """
    is_image = isinstance(image, np.ndarray) and image.dtype == np.uint8
    if not is_image or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        found = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ModelError(f"image {position} must be uint8 [height, width, 3] in BGR order, got {found}")


def fill_input(images: Sequence[Image], tensor: FloatTensor) -> None:
    """Writes images into an RGB tensor [N, 3, H, W] in 0..1: straight bilinear resize, no mean or deviation.

    Args:
        images: uint8 [height, width, 3] BGR, any sizes.
        tensor: Destination; its first ``len(images)`` rows are overwritten.
    """
    height, width = tensor.shape[2:]
    for row, image in zip(tensor, images, strict=False):
        resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
        for plane, channel in zip(row, reversed(cv2.split(resized)), strict=True):
            np.multiply(channel, plane.dtype.type(1 / 255), out=plane)
