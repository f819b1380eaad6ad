"""Decoded video frames to BGR by the file's own colour tags."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import av
import cv2
import numpy as np
import numpy.typing as npt
from av.video.reformatter import ColorRange, Interpolation

from cable_rpc.types import Image

LUMA_WEIGHTS: Mapping[int, tuple[float, float]] = {
    1: (0.2126, 0.0722),
    4: (0.30, 0.11),
    5: (0.299, 0.114),
    6: (0.299, 0.114),
    7: (0.212, 0.087),
    9: (0.2627, 0.0593),
    10: (0.2627, 0.0593),
}
"""Matrix coefficients of ITU-T H.273 by code: (Kr, Kb)."""

BT709, BT470BG, SMPTE170M = 1, 5, 6

EXACT = Interpolation.POINT | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
"""swscale without its shortcuts, which darken by one to two levels."""

TURNS = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_CLOCKWISE}
"""Display rotation, degrees counter-clockwise, to OpenCV's code."""


def to_bgr(frame: av.VideoFrame) -> Image:
    """A decoded frame as uint8 [height, width, 3], BGR, by its own matrix and range tags, turned upright.

    Untagged YUV is taken as limited range, BT.709 from 1280 columns or 577 rows on and BT.601 below, which
    is what players do. Halved chroma is replicated, as OpenCV does.
    """
    if frame.format.name in ("yuv420p", "yuvj420p"):
        image = yuv420_to_bgr(frame)
    else:
        if not frame.format.is_rgb:
            frame.colorspace = matrix_code(frame)
        image = frame.reformat(format="bgr24", interpolation=EXACT).to_ndarray().astype(np.uint8, copy=False)
    turn = TURNS.get(round(frame.rotation) % 360)
    return image if turn is None else cv2.rotate(image, turn).astype(np.uint8, copy=False)


def matrix_code(frame: av.VideoFrame) -> int:
    """The frame's YUV matrix as a code of ITU-T H.273, by its size where it has no usable tag."""
    if frame.colorspace in LUMA_WEIGHTS:
        return int(frame.colorspace)
    return BT709 if frame.width >= 1280 or frame.height > 576 else BT470BG


def yuv420_to_bgr(frame: av.VideoFrame) -> Image:
    """A frame of 8-bit 4:2:0, of any size, matrix and range, as uint8 [height, width, 3], BGR."""
    width, height = frame.width, frame.height
    code = matrix_code(frame)
    full_range = frame.color_range == ColorRange.JPEG or frame.format.name == "yuvj420p"
    even = width % 2 == 0 and height % 2 == 0
    if even and not full_range and code in (BT470BG, SMPTE170M):
        return cv2.cvtColor(frame.to_ndarray(), cv2.COLOR_YUV2BGR_I420).astype(np.uint8, copy=False)
    luma, cb, cr = (plane_samples(plane) for plane in frame.planes)
    size = (2 * cb.shape[1], 2 * cb.shape[0])
    blown_up = [cv2.resize(c, size, interpolation=cv2.INTER_NEAREST)[:height, :width] for c in (cb, cr)]
    matrix = ycbcr_to_bgr_matrix(*LUMA_WEIGHTS[code], full_range=full_range)
    return cv2.transform(cv2.merge([luma, *blown_up]), matrix).astype(np.uint8, copy=False)


def plane_samples(plane: av.video.plane.VideoPlane) -> npt.NDArray[np.uint8]:
    """The samples of an 8-bit plane, uint8 [height, width], without a copy."""
    # A plane has Python's buffer interface, which its type stub doesn't say.
    rows = np.frombuffer(cast("memoryview[int]", plane), np.uint8).reshape(-1, plane.line_size)
    return rows[: plane.height, : plane.width]


def ycbcr_to_bgr_matrix(kr: float, kb: float, *, full_range: bool) -> npt.NDArray[np.float64]:
    """float64 [3, 4] that maps (Y', Cb, Cr, 1) of 0..255 to BGR (ITU-T H.273, equations 38 to 52 inverted)."""
    kg = 1.0 - kr - kb
    black, luma, chroma = (0.0, 1.0, 1.0) if full_range else (16.0, 255 / 219, 255 / 224)
    linear = np.array(
        [
            [luma, 2 * (1 - kb) * chroma, 0.0],
            [luma, -2 * kb * (1 - kb) / kg * chroma, -2 * kr * (1 - kr) / kg * chroma],
            [luma, 0.0, 2 * (1 - kr) * chroma],
        ]
    )
    offset = -linear @ np.array([black, 128.0, 128.0])
    return np.column_stack([linear, offset])
