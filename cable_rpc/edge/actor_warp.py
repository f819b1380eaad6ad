"""The warp of a mask whose actors stand on the road rather than lie on it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np

from cable_rpc.edge.view_warp import MAX_MAGNIFICATION, ViewWarp, warp_mask
from cable_rpc.types import BoolMask


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
    found = list(pieces(mask))
    if not found:
        return warped
    boxes = np.array([box for box, _ in found])
    # A piece's lower edge, where it touches the road; the turn of the view differs little across a piece.
    contacts = np.ones((len(found), 3))
    contacts[:, 0] = boxes[:, 0] + (boxes[:, 2] - 1) / 2
    contacts[:, 1] = boxes[:, 1] + boxes[:, 3] - 0.5
    on_ground = contacts[:, 1, None] > warp.horizon_row
    with np.errstate(all="ignore"):
        moved = np.where(on_ground, contacts @ warp.ground.T, contacts @ warp.far.T)
        scales = 1 / moved[:, 2]
        offsets = (moved[:, :2] - contacts[:, :2]) * scales[:, None]
    usable = (scales > 0) & (scales <= MAX_MAGNIFICATION) & np.isfinite(offsets).all(axis=1)
    for number in np.flatnonzero(usable).tolist():
        (x, y, _, _), piece = found[number]
        place(piece, (x, y), float(scales[number]), (float(offsets[number, 0]), float(offsets[number, 1])), warped)
    return warped


def pieces(mask: BoolMask) -> Iterator[tuple[tuple[int, int, int, int], BoolMask]]:
    """The 8-connected pieces of a mask: (x, y, width, height) and bool [height, width] of each."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    box = mask[top : top + height, left : left + width].view(np.uint8)
    if width == 0:
        return
    # Outlines tell the boxes at a fifth of the cost of OpenCV's statistics.
    _, labels = cv2.connectedComponentsWithAlgorithm(box, 8, cv2.CV_32S, cv2.CCL_SPAGHETTI)
    outlines, hierarchy = cv2.findContours(box, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    for outline, (*_, parent) in zip(outlines, hierarchy[0], strict=True):
        if parent >= 0:
            continue  # a hole
        x, y, columns, rows = cv2.boundingRect(outline)
        label = labels[outline[0, 0, 1], outline[0, 0, 0]]
        yield (left + x, top + y, columns, rows), labels[y : y + rows, x : x + columns] == label


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
