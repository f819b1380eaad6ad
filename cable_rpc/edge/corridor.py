"""The corridor: contiguous bands of columns around the fused region (paper, section II)."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.errors import FrameError
from cable_rpc.types import BoolMask

Curve = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

TIE = 1e-9
"""Rows, columns and windows are rounded half up; rounding error of the arithmetic must not decide a tie."""
FEW_COLUMNS = 64
"""Up to 1 in so many columns, picking them one by one is faster than the whole range."""


class CorridorCurves(NamedTuple):
    """The corridor as two curves over the columns from its first to its last.

    A column between two bands belongs to none: its first row is the frame's height, its last row -1.
    """

    columns: slice
    first_rows: Rows
    last_rows: Rows
    """Inclusive."""


def column_extents(mask: BoolMask) -> tuple[Rows, Rows, Rows]:
    """Topmost and bottommost row of each non-empty column.

    Args:
        mask: bool [height, width].

    Returns:
        The columns in rising order, and t and b at those columns.
    """
    touched_rows = np.flatnonzero(mask.any(axis=1))
    if len(touched_rows) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
    first, last = int(touched_rows[0]), int(touched_rows[-1])
    box = mask[first : last + 1]
    occupied = np.flatnonzero(box.any(axis=0))
    # Contiguous columns let numpy's search for the first True run at memory speed.
    columns_first = cv2.transpose(np.ascontiguousarray(box).view(np.uint8)).reshape(box.shape[::-1])
    top = columns_first.view(np.bool_).argmax(axis=1)
    flipped = cv2.flip(columns_first, 1).reshape(columns_first.shape)
    bottom = flipped.view(np.bool_).argmax(axis=1)
    return occupied, first + top[occupied], last - bottom[occupied]


def moving_average(curves: Curve, window: int) -> Curve:
    """Mean over an odd window of columns; the ends are replicated, so it does not bend there.

    Args:
        curves: float64 [columns], or [curves, columns] to smooth each row.
        window: columns, odd.
    """
    kernel = np.full((1, window), 1.0 / window)
    smoothed = cv2.sepFilter2D(np.atleast_2d(curves), -1, kernel, np.ones((1, 1)), borderType=cv2.BORDER_REPLICATE)
    return smoothed.reshape(curves.shape).astype(np.float64, copy=False)


def smoothing_window(config: RoiConfig, width: int, scale: int) -> int:
    """w_s in columns of the analysis grid, the next odd number, at least 1.

    Args:
        config: window, and the frame width at which it holds as it is.
        width: columns of the grid.
        scale: pixels of the full frame per column of the grid.
    """
    full_frame = float(config.smoothing_window_columns)
    if config.smoothing_reference_width > 0:
        full_frame *= width * scale / config.smoothing_reference_width
    return 2 * math.floor(full_frame / scale / 2 + TIE) + 1


def side_margin(config: RoiConfig, width: int, late_frames: int) -> int:
    """Columns by which each band is widened to both sides.

    Args:
        config: share of the width, and further share per late frame.
        width: columns of the grid.
        late_frames: frames that the prior is older than one.
    """
    share = config.side_margin_share + config.side_margin_per_late_frame_share * max(late_frames, 0)
    return min(math.floor(share * width + 0.5 + TIE), width)


def enforce_height(upper: Curve, lower: Curve, min_height: float, height: int) -> tuple[Curve, Curve]:
    """Stretch ``lower - upper`` to at least ``min_height`` about the centre, then shift into 0..height-1."""
    missing = np.maximum(min_height - (lower - upper), 0.0) / 2
    upper = upper - missing
    lower = lower + missing
    shift = np.maximum(-upper, 0.0) - np.maximum(lower - (height - 1), 0.0)
    return clip(upper + shift, height), clip(lower + shift, height)


def clip(rows: Curve, height: int) -> Curve:
    """Rows limited to 0..height-1."""
    return np.minimum(np.maximum(rows, 0.0), height - 1.0)


def band_rows(
    occupied: Rows, top_rows: Rows, bottom_rows: Rows, window: int, height: int, config: RoiConfig
) -> tuple[Rows, Rows]:
    """First and last row of one band, for every column from its first to its last occupied one.

    ``t' = smooth(t) - eta_t t`` and ``b' = smooth(b) + eta_b (H - b)``, clipped to the frame, stretched to
    the least height about the centre, shifted inside, rounded half up. Empty columns between occupied ones
    take t and b by linear interpolation.
    """
    first, last = int(occupied[0]), int(occupied[-1])
    extents = np.empty((2, last - first + 1))
    if len(occupied) == last - first + 1:
        extents[0], extents[1] = top_rows, bottom_rows
    else:
        columns = np.arange(first, last + 1)
        extents[0] = np.interp(columns, occupied, top_rows)
        extents[1] = np.interp(columns, occupied, bottom_rows)
    smoothed = moving_average(extents, window)
    upper = clip(smoothed[0] - config.top_margin * extents[0], height)
    lower = clip(smoothed[1] + config.bottom_margin * (height - extents[1]), height)
    upper, lower = enforce_height(upper, lower, config.min_height_fraction * height, height)
    return np.floor(upper + (0.5 + TIE)).astype(np.int64), np.floor(lower + (0.5 + TIE)).astype(np.int64)


def replicate_ends(curve: Rows, before: int, after: int) -> Rows:
    """The curve with its first and last value repeated in front and behind."""
    widened = np.empty(before + len(curve) + after, curve.dtype)
    widened[:before] = curve[0]
    widened[before : before + len(curve)] = curve
    widened[before + len(curve) :] = curve[-1]
    return widened


def corridor_curves(raw: BoolMask, config: RoiConfig, *, scale: int = 1, late_frames: int = 0) -> CorridorCurves | None:
    """The corridor's columns with its first and last row in each of them.

    Args:
        raw: bool [height, width], Rraw_k.
        config: margins, window, least height, gap between bands.
        scale: pixels of the full frame per pixel of ``raw``.
        late_frames: frames that the prior is older than one (staleness - 1).

    Returns:
        None where ``raw`` is empty.
    """
    return curves_around(column_extents(raw), raw.shape, config, scale, late_frames)


def curves_around(
    extents: tuple[Rows, Rows, Rows], shape: tuple[int, ...], config: RoiConfig, scale: int, late_frames: int
) -> CorridorCurves | None:
    """`corridor_curves` from the columns' extents in a mask of the given shape."""
    occupied, top_rows, bottom_rows = extents
    if len(occupied) == 0:
        return None
    height, width = shape
    window = smoothing_window(config, width, scale)
    margin = side_margin(config, width, late_frames)
    starts = np.flatnonzero(np.diff(occupied) - 1 > config.corridor_gap_share * width + TIE) + 1
    bounds = [0, *starts.tolist(), len(occupied)]
    hull = slice(max(int(occupied[0]) - margin, 0), min(int(occupied[-1]) + 1 + margin, width))
    first_rows = np.full(hull.stop - hull.start, height, np.int64)
    last_rows = np.full(hull.stop - hull.start, -1, np.int64)
    for start, stop in pairwise(bounds):
        columns = occupied[start:stop]
        rows = band_rows(columns, top_rows[start:stop], bottom_rows[start:stop], window, height, config)
        left, right = int(columns[0]) - hull.start, int(columns[-1]) + 1 - hull.start
        before, after = min(margin, left), min(margin, len(first_rows) - right)
        widened = slice(left - before, right + after)
        upper, lower = (replicate_ends(curve, before, after) for curve in rows)
        # Widened bands may meet; where they do, they are one.
        np.minimum(first_rows[widened], upper, out=first_rows[widened])
        np.maximum(last_rows[widened], lower, out=last_rows[widened])
    return CorridorCurves(hull, first_rows, last_rows)


def fill_band(region: BoolMask, curves: CorridorCurves) -> None:
    """Set the pixels between the curves in an all-False region."""
    columns, first_rows, last_rows = curves
    begin, end = int(first_rows.min()), int(last_rows.max()) + 1
    started, ending = min(int(first_rows.max()), end), max(int(last_rows.min()) + 1, begin)
    # The narrowest type that holds a row number doubles the speed of the comparisons.
    narrow = np.min_scalar_type(region.shape[0])
    rows = np.arange(region.shape[0], dtype=narrow)[:, None]
    np.greater_equal(rows[begin:started], first_rows.astype(narrow), out=region[begin:started, columns])
    region[started:end, columns] = True
    region[ending:end, columns] &= rows[ending:end] < (last_rows + 1).astype(narrow)


def corridor(
    raw: BoolMask,
    config: RoiConfig,
    *,
    scale: int = 1,
    late_frames: int = 0,
    out: BoolMask | None = None,
) -> BoolMask:
    """R_k = fill(t', b') ∪ Rraw_k.

    Args:
        raw: bool [height, width], Rraw_k, in any resolution.
        config: margins, window, least height, gap between bands; without ``corridor`` R_k is Rraw_k.
        scale: pixels of the full frame per pixel of ``raw``.
        late_frames: frames that the prior is older than one (staleness - 1).
        out: array of the same shape to write into, other than ``raw``; None makes one.

    Returns:
        bool [height, width], ``out`` or a new array; empty where ``raw`` is empty.

    Raises:
        FrameError: ``out`` doesn't fit ``raw``.
    """
    if out is None:
        out = np.empty(raw.shape, np.bool_)
    elif out.shape != raw.shape or out.dtype != np.bool_ or np.may_share_memory(out, raw):
        raise FrameError(
            f"corridor() can't write {raw.dtype} {raw.shape} into {out.dtype} {out.shape}: give a separate bool "
            "array of the same shape"
        )
    extents = column_extents(raw) if config.corridor else None
    curves = None if extents is None else curves_around(extents, raw.shape, config, scale, late_frames)
    if extents is None or curves is None:
        np.copyto(out, raw)
        return out
    out.fill(False)
    fill_band(out, curves)
    occupied, top_rows, bottom_rows = extents
    inside = occupied - curves.columns.start
    peaks = occupied[(top_rows < curves.first_rows[inside]) | (bottom_rows > curves.last_rows[inside])]
    if len(peaks):
        # Smoothing cuts peaks: only their columns need the union with Rraw.
        rows = slice(int(top_rows.min()), int(bottom_rows.max()) + 1)
        crowded = len(peaks) * FEW_COLUMNS > raw.shape[1]
        columns = slice(int(peaks[0]), int(peaks[-1]) + 1) if crowded else peaks
        out[rows, columns] |= raw[rows, columns]
    return out
