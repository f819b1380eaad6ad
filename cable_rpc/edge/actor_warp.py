"""The warp of a mask whose actors stand on the road rather than lie on it."""

from __future__ import annotations

import math

import cv2
import numpy as np

from cable_rpc.edge.view_warp import MAX_MAGNIFICATION, ViewWarp, warp_mask
from cable_rpc.types import BoolMask

LABELS_16_BIT = 60_000


def warp_actors(mask: BoolMask, warp: ViewWarp) -> BoolMask:
    """W(M, H) for upright actors: each connected piece keeps its shape and follows the road under its lowest row.

    The ground-plane map spreads whatever stands on the road over the road behind it. Here its value at the piece's
    contact point gives the piece's translation and, by the ratio of depths, its scale. Pieces wholly above the
    horizon follow ``far``. Without ``far`` the picture moves as one and this is ``warp_mask``.

    Args:
        mask: bool [height, width].
        warp: motion from the mask's frame to the later one; homographies of determinant 1 where ``far`` is set.

    Returns:
        bool [height, width]; the argument itself where nothing moves, so don't write into it.
    """
    if warp.far is None or warp.horizon_row is None or warp.is_identity:
        return warp_mask(mask, warp)
    warped = np.zeros_like(mask)
    if not (np.isfinite(warp.ground).all() and np.isfinite(warp.far).all()):
        return warped
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    if width == 0:
        return warped
    box = mask[top : top + height, left : left + width].view(np.uint8)
    # An 8-connected piece takes a 2x2 cell at least, so 16 bits number those of any small picture, in half the time.
    label_type = cv2.CV_16U if box.size < 4 * LABELS_16_BIT else cv2.CV_32S
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(box, connectivity=8, ltype=label_type)
    for label in range(1, count):
        x, y, width, height, _ = boxes[label].tolist()
        x, y = x + left, y + top
        # The piece's lower edge, where it touches the road; the turn of the view differs little across a piece.
        contact = np.array([x + (width - 1) / 2, y + height - 0.5, 1.0])
        homography = warp.ground if contact[1] > warp.horizon_row else warp.far
        with np.errstate(all="ignore"):
            to_x, to_y, depth_ratio = homography @ contact
            scale = float(1 / depth_ratio)
            to_x, to_y = float(to_x * scale), float(to_y * scale)
        if 0 < scale <= MAX_MAGNIFICATION and math.isfinite(to_x) and math.isfinite(to_y):
            piece = labels[y - top : y - top + height, x - left : x - left + width] == label
            place(piece, (x, y), scale, (to_x - scale * contact[0], to_y - scale * contact[1]), warped)
    return warped


def place(
    piece: BoolMask, origin: tuple[int, int], scale: float, offset: tuple[float, float], warped: BoolMask
) -> None:
    """Join a scaled piece to a mask.

    Args:
        piece: bool [rows, columns], the piece within its own box.
        origin: x and y of that box in its picture.
        scale: of lengths.
        offset: x and y to add after scaling.
        warped: bool [height, width], written to.
    """
    rows, columns = piece.shape
    frame_height, frame_width = warped.shape
    left = scale * (origin[0] - 0.5) + offset[0]
    top = scale * (origin[1] - 0.5) + offset[1]
    x0, x1 = max(left, 0.0), min(left + scale * columns + 1, float(frame_width))
    y0, y1 = max(top, 0.0), min(top + scale * rows + 1, float(frame_height))
    if x0 >= x1 or y0 >= y1:
        return
    first_x, first_y = int(x0), int(y0)
    size = (math.ceil(x1) - first_x, math.ceil(y1) - first_y)
    back = np.array(
        [
            [1 / scale, 0, (first_x - offset[0]) / scale - origin[0]],
            [0, 1 / scale, (first_y - offset[1]) / scale - origin[1]],
        ]
    )
    scaled = cv2.warpAffine(piece.view(np.uint8), back, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
    warped[first_y : first_y + size[1], first_x : first_x + size[0]] |= scaled.view(np.bool_)
