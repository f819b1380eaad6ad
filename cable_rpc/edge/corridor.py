"""The corridor: one contiguous band of columns around the fused region (paper, section II)."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.types import BoolMask

Curve = npt.NDArray[np.float64]

TIE = 1e-9
"""Rows are rounded half up; rounding error of the moving average must not decide a tie."""


def column_extents(mask: BoolMask) -> tuple[npt.NDArray[np.int64], Curve, Curve]:
    """Topmost and bottommost row of each non-empty column.

    Args:
        mask: bool [height, width].

    Returns:
        The columns in rising order, and t and b at those columns.
    """
    left, first, width, height = cv2.boundingRect(mask.view(np.uint8))
    box = mask[first : first + height, left : left + width]
    if width == 0:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
    # Contiguous columns let numpy's search for the first True run at memory speed.
    columns_first = cv2.transpose(box.view(np.uint8))
    top = columns_first.view(np.bool_).argmax(axis=1)
    occupied = np.flatnonzero(columns_first[np.arange(width), top])
    cv2.flip(columns_first, 1, dst=columns_first)
    bottom = height - 1 - columns_first.view(np.bool_).argmax(axis=1)
    return left + occupied, first + top[occupied].astype(np.float64), first + bottom[occupied].astype(np.float64)


def moving_average(curve: Curve, window: int) -> Curve:
    """Mean over an odd window of columns; the ends are replicated, so it does not bend there."""
    half = window // 2
    padded = np.pad(curve, half, mode="edge")
    return np.convolve(padded, np.full(window, 1.0 / window), mode="valid")


def corridor_curves(
    raw: BoolMask, config: RoiConfig
) -> tuple[slice, npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
    """The band's columns with its first and last row in each of them.

    ``t' = smooth(t) - eta_t t`` and ``b' = smooth(b) + eta_b (H - b)``, clipped to the frame, stretched to
    the least height about the centre, shifted inside, rounded half up. Empty columns between occupied ones
    take t and b by linear interpolation.

    Args:
        raw: bool [height, width], Rraw_k.
        config: margins, window and least height.

    Returns:
        Columns, first rows, last rows (inclusive); None where ``raw`` is empty.
    """
    occupied, top_rows, bottom_rows = column_extents(raw)
    if len(occupied) == 0:
        return None
    height = raw.shape[0]
    columns = np.arange(occupied[0], occupied[-1] + 1)
    t = np.interp(columns, occupied, top_rows)
    b = np.interp(columns, occupied, bottom_rows)
    window = config.smoothing_window_columns
    upper = moving_average(t, window) - config.top_margin * t
    lower = moving_average(b, window) + config.bottom_margin * (height - b)
    upper, lower = enforce_height(
        np.clip(upper, 0, height - 1),
        np.clip(lower, 0, height - 1),
        config.min_height_fraction * height,
        height,
    )
    first_rows = np.floor(upper + 0.5 + TIE).astype(np.int64)
    last_rows = np.floor(lower + 0.5 + TIE).astype(np.int64)
    return slice(int(columns[0]), int(columns[-1]) + 1), first_rows, last_rows


def enforce_height(upper: Curve, lower: Curve, min_height: float, height: int) -> tuple[Curve, Curve]:
    """Stretch ``lower - upper`` to at least ``min_height`` about the centre, then shift into 0..height-1."""
    missing = np.maximum(min_height - (lower - upper), 0.0) / 2
    upper = upper - missing
    lower = lower + missing
    down = np.maximum(-upper, 0.0)
    up = np.maximum(lower - (height - 1), 0.0)
    shift = down - up
    return np.clip(upper + shift, 0, height - 1), np.clip(lower + shift, 0, height - 1)


def corridor(raw: BoolMask, config: RoiConfig) -> BoolMask:
    """R_k = fill(t', b') ∪ Rraw_k.

    Args:
        raw: bool [height, width], Rraw_k.
        config: margins, window and least height.

    Returns:
        bool [height, width], a new array; empty where ``raw`` is empty.
    """
    region = raw.copy()
    curves = corridor_curves(raw, config)
    if curves is None:
        return region
    columns, first_rows, last_rows = curves
    first, last = int(first_rows.min()), int(last_rows.max())
    # The narrowest type that holds a row number doubles the speed of the two comparisons.
    rows = np.arange(first, last + 1, dtype=np.min_scalar_type(raw.shape[0]))[:, None]
    band = rows >= first_rows.astype(rows.dtype)
    band &= rows <= last_rows.astype(rows.dtype)
    region[first : last + 1, columns] |= band
    return region
