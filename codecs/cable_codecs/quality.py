"""How well a region of an image survived coding, measured on luma.

Luma only, because chroma subsampling caps the PSNR of colour images, whatever the quantiser does.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from cable_codecs.base import BoolMask, Image
from cable_codecs.errors import CodecError

PEAK = 255.0
SSIM_SIGMA = 1.5
SSIM_WINDOW = 11
SSIM_RIM = 3
"""Pixels left out along the inside of the region's edge, where the window (2 sigma) sees the background."""
SSIM_C1, SSIM_C2 = (0.01 * PEAK) ** 2, (0.03 * PEAK) ** 2


def roi_psnr(reference: Image, test: Image, roi: BoolMask) -> float:
    """Peak signal-to-noise ratio of BT.601 luma inside a region.

    Args:
        reference: uint8 [height, width, 3], BGR.
        test: uint8 [height, width, 3], BGR.
        roi: bool [height, width], True where it counts.

    Returns:
        Decibels; infinity where the luma is equal.

    Raises:
        CodecError: Arrays that don't fit together, or an empty region.
    """
    check_pair(reference, test, roi)
    squares = cv2.norm(luma(reference), luma(test), cv2.NORM_L2SQR, roi.view(np.uint8))
    error = squares / np.count_nonzero(roi)
    return math.inf if error == 0 else 10 * math.log10(PEAK**2 / error)


def roi_ssim(reference: Image, test: Image, roi: BoolMask) -> float:
    """Structural similarity of BT.601 luma inside a region.

    Wang, Bovik, Sheikh and Simoncelli (2004), with their Gaussian window (11x11, sigma 1.5) and constants;
    images are mirrored at their border. Neither the region's rim of 3 pixels nor the image's counts.

    Args:
        reference: uint8 [height, width, 3], BGR.
        test: uint8 [height, width, 3], BGR.
        roi: bool [height, width], True where it counts.

    Returns:
        At most 1, which means equal.

    Raises:
        CodecError: Arrays that don't fit together, or a region with nothing left inside its rim.
    """
    check_pair(reference, test, roi)
    valid = without_rim(roi)
    if not valid.any():
        raise CodecError(f"the region has no pixel left inside its rim of {SSIM_RIM} px; give a larger region")
    area = surroundings(valid)
    first, second = luma(reference[area]).astype(np.float32), luma(test[area]).astype(np.float32)
    return float(cv2.mean(ssim_map(first, second), np.ascontiguousarray(valid[area]))[0])


def surroundings(valid: Image) -> tuple[slice, slice]:
    """Rows and columns of the smallest rectangle that holds every window around a pixel that counts."""
    left, top, width, height = cv2.boundingRect(valid)
    reach = SSIM_WINDOW // 2
    rows = slice(max(0, top - reach), top + height + reach)
    return rows, slice(max(0, left - reach), left + width + reach)


def ssim_map(first: npt.NDArray[np.float32], second: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Local structural similarity of two float32 [height, width] images in 0..255."""
    mean_first, mean_second = gaussian(first), gaussian(second)
    product = mean_first * mean_second
    squares = mean_first * mean_first + mean_second * mean_second
    covariance = gaussian(first * second) - product
    variances = gaussian(first * first + second * second) - squares
    numerator = (2 * product + SSIM_C1) * (2 * covariance + SSIM_C2)
    return np.asarray(numerator / ((squares + SSIM_C1) * (variances + SSIM_C2)), np.float32)


def gaussian(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Weighted local mean under the SSIM window."""
    blurred = cv2.GaussianBlur(values, (SSIM_WINDOW, SSIM_WINDOW), SSIM_SIGMA, borderType=cv2.BORDER_REFLECT)
    return np.asarray(blurred, np.float32)


def without_rim(roi: BoolMask) -> Image:
    """uint8 [height, width], 1 in the region at least 3 pixels from its edge and the image's."""
    kernel = np.ones((2 * SSIM_RIM + 1, 2 * SSIM_RIM + 1), np.uint8)
    eroded = cv2.erode(roi.view(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(eroded, np.uint8)


def luma(image: Image) -> Image:
    """BT.601 luma uint8 [height, width], full range, of a BGR image."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def check_pair(reference: Image, test: Image, roi: BoolMask) -> None:
    """Check that two images and a region belong together.

    Raises:
        CodecError: Wrong shapes or dtypes, or an empty region.
    """
    for label, image in (("reference", reference), ("test", test)):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise CodecError(
                f"the {label} image must be uint8 [height, width, 3], got {image.dtype} {list(image.shape)}"
            )
    if reference.shape != test.shape:
        raise CodecError(f"the images differ in size: {list(reference.shape)} and {list(test.shape)}")
    if roi.dtype != np.bool_ or roi.shape != reference.shape[:2]:
        raise CodecError(f"the region must be bool {list(reference.shape[:2])}, got {roi.dtype} {list(roi.shape)}")
    if not roi.any():
        raise CodecError("the region is empty, so it has no quality; skip this frame")
