"""What nearer opaque things hide, found before anything is drawn.

Both sides err towards drawing: hiders are eroded and what may be hidden is enlarged, so leaving out a hidden
thing doesn't change a pixel of the picture.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.camera import Camera
from cable_rpc.data.synthetic.road import Pose

FloatArray = npt.NDArray[np.float64]
UInt8Array = npt.NDArray[np.uint8]

SHRINK = 2
FRACTION_BITS = 4
MARGIN_PIXELS = 3.0
NEAREST_M = 0.5
EVERYWHERE = 1e6
EROSION = np.ones((5, 5), np.uint8)
PADDING = 3
LEAST_HIDER = 7.0
"""Smallest side of what is worth adding, pixels of the coarse mask."""


class Occlusion:
    """The part of the image that is known to be covered by things nearer than those asked about."""

    def __init__(self, camera: Camera) -> None:
        self.covered: UInt8Array = np.zeros((-(-camera.height // SHRINK), -(-camera.width // SHRINK)), np.uint8)

    def hides(self, bounds: tuple[float, float, float, float]) -> bool:
        """Whether a rectangle (x0, y0, x1, y1), image pixels, is covered or outside the image."""
        x0, y0, x1, y1 = (int(value) // SHRINK for value in bounds)
        part = self.covered[max(y0, 0) : max(y1 + 1, 0), max(x0, 0) : max(x1 + 1, 0)]
        if not part.size:
            return True
        return bool(part[-1, 0] and part[0, -1] and part.min())

    def cover(self, outline: FloatArray) -> None:
        """Add an opaque convex outline [N, 2], image pixels."""
        height, width = self.covered.shape
        shrunk = outline / SHRINK - 0.5 * (SHRINK - 1) / SHRINK
        (left, top), (right, bottom) = shrunk.min(axis=0).tolist(), shrunk.max(axis=0).tolist()
        if right - left < LEAST_HIDER or bottom - top < LEAST_HIDER:
            return
        x0, x1 = max(int(left) - PADDING, 0), min(int(right) + PADDING + 1, width)
        y0, y1 = max(int(top) - PADDING, 0), min(int(bottom) + PADDING + 1, height)
        if x0 >= x1 or y0 >= y1:
            return
        part = np.zeros((y1 - y0, x1 - x0), np.uint8)
        fixed = np.rint((shrunk - (x0, y0)) * (1 << FRACTION_BITS)).astype(np.int32)
        cv2.fillConvexPoly(part, fixed, 1, cv2.LINE_8, FRACTION_BITS)
        # The image's own border does not erode: beyond it the outline goes on.
        part = np.asarray(cv2.erode(part, EROSION), np.uint8)
        area = self.covered[y0:y1, x0:x1]
        np.maximum(area, part, out=area)


def image_bounds(camera: Camera, ego: Pose, footprints: FloatArray, heights: FloatArray) -> list[list[float]]:
    """Rectangles [x0, y0, x1, y1] of pixels around upright prisms, enlarged a little.

    Args:
        camera: The camera.
        ego: Pose of the ego vehicle.
        footprints: [N, 4, 2], world metres.
        heights: [N], metres.
    """
    count = len(footprints)
    points = np.zeros((count, 2, 4, 3))
    points[..., :2] = footprints[:, None]
    points[:, 1, :, 2] = heights[:, None]
    pixels, depths = camera.project(ego.to_local(points.reshape(-1, 3)))
    pixels = pixels.reshape(count, 8, 2)
    result = np.concatenate([pixels.min(axis=1) - MARGIN_PIXELS, pixels.max(axis=1) + MARGIN_PIXELS], axis=1)
    # Across the image plane the corners' rectangle means nothing.
    result[depths.reshape(count, 8).min(axis=1) < NEAREST_M] = (-EVERYWHERE, -EVERYWHERE, EVERYWHERE, EVERYWHERE)
    rows: list[list[float]] = np.clip(result, -EVERYWHERE, EVERYWHERE).tolist()
    return rows


def square(x: float, y: float, half: float) -> FloatArray:
    """Corners [4, 2] of an upright square around a place."""
    return np.array([[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]])
