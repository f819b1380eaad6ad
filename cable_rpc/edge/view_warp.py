"""How the picture moves between two frames, and the warp of mask and frame that follows (paper, section II)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.types import BoolMask

Homography = npt.NDArray[np.float64]
GreyImage = npt.NDArray[np.uint8]

MAX_MAGNIFICATION = 4.0
"""Where the ground would grow by more than this along a row, the earlier frame knows too little of it: undefined."""
POSITION_TOLERANCE_PX = 1e-6
"""Rounding allowed in a source position on the very border."""


def identity_homography() -> Homography:
    """float64 [3, 3] that moves nothing."""
    return np.eye(3, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class ViewWarp:
    """How the picture moves from an earlier frame to a later one, as forward maps (source to destination)."""

    ground: Homography = field(default_factory=identity_homography)
    """float64 [3, 3], of the ground; of the whole picture where ``far`` is None."""
    far: Homography | None = None
    """float64 [3, 3], of everything above the horizon."""
    horizon_row: float | None = None
    """Destination row from which on ``ground`` holds; None with ``far`` None."""

    def then(self, following: ViewWarp) -> ViewWarp:
        """This motion and the one after it, as one; the later one's horizon wins."""
        # A shift can overflow at standstill (epsilon); the warp takes any such matrix for "out of the frame".
        with np.errstate(over="ignore", invalid="ignore"):
            ground = following.ground @ self.ground
            if self.far is None and following.far is None:
                return ViewWarp(ground)
            far = following.upper @ self.upper
        later = following.horizon_row
        return ViewWarp(ground, far, self.horizon_row if later is None else later)

    def scaled(self, factor: float) -> ViewWarp:
        """The same motion in a picture resized by ``factor``, where x becomes (x + 0.5) factor - 0.5."""
        if factor == 1:
            return self
        far = None if self.far is None else scaled_homography(self.far, factor)
        horizon = None if self.horizon_row is None else (self.horizon_row + 0.5) * factor - 0.5
        return ViewWarp(scaled_homography(self.ground, factor), far, horizon)

    @property
    def upper(self) -> Homography:
        """What holds above the horizon."""
        return self.ground if self.far is None else self.far

    def centre_shift_px(self, size_hw: tuple[int, int]) -> float:
        """How far the point at a picture's centre moves to the right, in pixels; NaN where it leaves the camera's view.

        Args:
            size_hw: (height, width) of the picture.
        """
        centre = np.array([(size_hw[1] - 1) / 2, (size_hw[0] - 1) / 2, 1.0])
        homography = self.far if self.far is not None and centre[1] < (self.horizon_row or 0) else self.ground
        with np.errstate(all="ignore"):
            x, _, depth = homography @ centre
            return float(x / depth - centre[0]) if depth > 0 else math.nan

    @property
    def is_identity(self) -> bool:
        """Whether nothing moves."""
        return horizontal_shift(self.ground) == 0 and (self.far is None or horizontal_shift(self.far) == 0)


def scaled_homography(homography: Homography, factor: float) -> Homography:
    """A homography for a picture resized by ``factor``, pixel centres at whole numbers in both."""
    shift = horizontal_shift(homography)
    if shift is not None:
        scaled = identity_homography()
        scaled[0, 2] = shift * factor
        return scaled
    offset = (factor - 1) / 2
    resize = np.array([[factor, 0, offset], [0, factor, offset], [0, 0, 1]])
    back = np.array([[1 / factor, 0, -offset / factor], [0, 1 / factor, -offset / factor], [0, 0, 1]])
    with np.errstate(over="ignore", invalid="ignore"):
        return resize @ homography @ back


def horizontal_shift(homography: Homography) -> float | None:
    """Pixels to the right if the homography is a pure horizontal translation, else None."""
    (a, b, shift), (c, d, e), (f, g, h) = homography.tolist()
    return shift if a == d == h == 1 and b == c == e == f == g == 0 else None


def inverse_homography(homography: Homography) -> Homography | None:
    """The inverse; None where there is none that can be relied on (not finite, singular or nearly so)."""
    with np.errstate(all="ignore"):
        if not np.isfinite(homography).all():
            return None
        try:
            inverse = np.asarray(np.linalg.inv(homography), np.float64)
        except np.linalg.LinAlgError:
            return None
        error = np.abs(homography @ inverse - np.eye(3)).max()
    return inverse if error < POSITION_TOLERANCE_PX else None


class Band(NamedTuple):
    """Destination rows ``first`` .. ``last - 1``, over which one homography holds."""

    first: int
    last: int
    homography: Homography


def bands(warp: ViewWarp, height: int) -> Iterator[Band]:
    """The destination rows of each homography; none where the horizon isn't a number."""
    if warp.far is None or warp.horizon_row is None:
        yield Band(0, height, warp.ground)
        return
    if math.isnan(warp.horizon_row):
        return
    horizon = math.ceil(min(max(warp.horizon_row, 0.0), float(height)))
    if horizon > 0:
        yield Band(0, horizon, warp.far)
    if horizon < height:
        yield Band(horizon, height, warp.ground)


def warp_mask(mask: BoolMask, warp: ViewWarp) -> BoolMask:
    """W(M, H) with nearest neighbour and an empty border.

    Args:
        mask: bool [height, width].
        warp: motion from the mask's frame to the later one.

    Returns:
        bool [height, width]; the argument itself where nothing moves, so don't write into it. Empty where the
        source lies outside the mask or behind the camera, and where the homography isn't finite.
    """
    if warp.is_identity:
        return mask
    warped = np.zeros_like(mask)
    for band in bands(warp, mask.shape[0]):
        rows = slice(band.first, band.last)
        shift = horizontal_shift(band.homography)
        if shift is not None:
            shift_mask(mask[rows], shift, warped[rows])
            continue
        inverse = inverse_homography(band.homography)
        if inverse is not None:
            sample_mask(mask, band, inverse, warped)
    return warped


def shift_mask(mask: BoolMask, shift_px: float, warped: BoolMask) -> None:
    """Write a mask, moved to the right by a real number of pixels, into an empty one of the same size."""
    width = mask.shape[1]
    if not abs(shift_px) < width + 1:
        return
    columns = math.ceil(shift_px - 0.5)
    if columns >= 0:
        warped[:, columns:] = mask[:, : max(width - columns, 0)]
    else:
        warped[:, :columns] = mask[:, -columns:]


def sample_mask(mask: BoolMask, band: Band, inverse: Homography, warped: BoolMask) -> None:
    """Write the band of a warped mask, looking only where the mask's bounding box can land."""
    x0, y0, width, height = cv2.boundingRect(mask.view(np.uint8))
    if width == 0:
        return
    left, right, top, bottom = landing(band.homography, (x0 - 1, y0 - 1, x0 + width, y0 + height), mask.shape)
    top, bottom = max(top, band.first), min(bottom, band.last)
    if left >= right or top >= bottom:
        return
    target = warped[top:bottom, left:right]
    origin = np.array([[1.0, 0, left], [0, 1, top], [0, 0, 1]])
    cv2.warpPerspective(
        mask.view(np.uint8),
        inverse @ origin,
        (right - left, bottom - top),
        dst=target.view(np.uint8),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
    )
    if depth_ratios_vary(inverse, (left, top, right, bottom)):
        first, last = defined_columns(inverse, np.arange(top, bottom), mask.shape, 0.5)
        columns = np.arange(left, right)
        target &= (columns >= first[:, None]) & (columns <= last[:, None])


def landing(
    homography: Homography, box: tuple[int, int, int, int], size_hw: tuple[int, ...]
) -> tuple[int, int, int, int]:
    """Pixels (left, right, top, bottom, ends excluded) that a box (x0, y0, x1, y1) can land on, at most all."""
    height, width = size_hw
    x0, y0, x1, y1 = box
    corners = np.array([[x0, x1, x1, x0], [y0, y0, y1, y1], [1.0, 1, 1, 1]])
    with np.errstate(all="ignore"):
        x, y, depth = homography @ corners
        if not (depth > 0).all():
            return 0, width, 0, height
        x, y = x / depth, y / depth
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return 0, width, 0, height
    left, right = max(float(x.min()), 0.0), min(float(x.max()) + 2, float(width))
    top, bottom = max(float(y.min()), 0.0), min(float(y.max()) + 2, float(height))
    return int(min(left, width)), int(max(right, 0)), int(min(top, height)), int(max(bottom, 0))


def depth_ratios_vary(inverse: Homography, box: tuple[int, int, int, int]) -> bool:
    """Whether part of a destination box lies behind the earlier camera or is magnified beyond use."""
    left, top, right, bottom = box
    slope_x, slope_y, offset = inverse[2]
    with np.errstate(all="ignore"):
        ratios = [slope_x * x + slope_y * y + offset for x in (left, right) for y in (top, bottom)]
    return not all(0 < ratio <= MAX_MAGNIFICATION for ratio in ratios)


def warp_frame(grey: GreyImage, warp: ViewWarp) -> tuple[GreyImage, BoolMask | None]:
    """W(I, H) with bilinear interpolation, and where it is defined.

    Args:
        grey: uint8 [height, width].
        warp: motion from the image's frame to the later one.

    Returns:
        The warped image (the argument itself where nothing moves) and a bool [height, width] that is True
        where the source position lies inside the source image, in front of its camera; None in its place says
        "everywhere".
    """
    if warp.is_identity:
        return grey, None
    warped = np.zeros_like(grey)
    valid = np.zeros(grey.shape, np.bool_)
    for band in bands(warp, grey.shape[0]):
        rows = slice(band.first, band.last)
        shift = horizontal_shift(band.homography)
        if shift is not None:
            shift_frame(grey[rows], shift, warped[rows], valid[rows])
            continue
        inverse = inverse_homography(band.homography)
        if inverse is not None:
            sample_frame(grey, band, inverse, warped[rows], valid[rows])
    return warped, valid


def shift_frame(grey: GreyImage, shift_px: float, warped: GreyImage, valid: BoolMask) -> None:
    """Write an image, moved to the right by a real number of pixels, and where it is defined, into zeros."""
    width = grey.shape[1]
    if not abs(shift_px) < width:
        return
    whole = math.floor(shift_px)
    fraction = shift_px - whole
    # Column x takes (1 - fraction) of source column x - whole and fraction of the one to its left.
    first = max(whole + (fraction > 0), 0)
    last = min(width, width + whole)
    if first >= last:
        return
    right = grey[:, first - whole : last - whole]
    if fraction > 0:
        left = grey[:, first - whole - 1 : last - whole - 1]
        cv2.addWeighted(right, 1.0 - fraction, left, fraction, 0.0, dst=warped[:, first:last])
    else:
        warped[:, first:last] = right
    valid[:, first:last] = True


def sample_frame(grey: GreyImage, band: Band, inverse: Homography, warped: GreyImage, valid: BoolMask) -> None:
    """Write the band of a warped image and where it is defined."""
    width = grey.shape[1]
    origin = np.array([[1.0, 0, 0], [0, 1, band.first], [0, 0, 1]])
    cv2.warpPerspective(
        grey,
        inverse @ origin,
        (width, band.last - band.first),
        dst=warped,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    first, last = defined_columns(inverse, np.arange(band.first, band.last), grey.shape, 0.0)
    whole = (first == 0) & (last == width - 1)
    valid[whole] = True
    cut = np.flatnonzero(~whole)
    if cut.size:
        columns = np.arange(width, dtype=np.int32)
        valid[cut] = (columns >= first[cut, None]) & (columns <= last[cut, None])


def defined_columns(
    inverse: Homography, rows: npt.NDArray[np.int_], size_hw: tuple[int, ...], margin_px: float
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """First and last destination column of each row whose source lies inside the picture, before the camera.

    Each condition is linear in the column once the homogeneous coordinate is known to be positive, so a row's
    defined pixels are one interval.

    Args:
        inverse: float64 [3, 3], destination to source.
        rows: int [N], destination rows.
        size_hw: source and destination size in pixels.
        margin_px: how far beyond the outermost pixel centres still counts as inside.

    Returns:
        int32 [N] twice, clipped to the width; first > last says that no column is defined.
    """
    height, width = size_hw
    margin = margin_px + POSITION_TOLERANCE_PX
    x, y, ratio = inverse
    conditions = np.array(
        [
            x + margin * ratio,
            (width - 1 + margin) * ratio - x,
            y + margin * ratio,
            (height - 1 + margin) * ratio - y,
            ratio,
            (0, 0, MAX_MAGNIFICATION) - ratio,
        ]
    )
    with np.errstate(all="ignore"):
        slopes = conditions[:, 0, None]
        levels = conditions[:, 1, None] * rows + conditions[:, 2, None]
        crossings = -levels / slopes
        first = np.where(slopes > 0, crossings, 0.0).max(axis=0)
        last = np.where(slopes < 0, crossings, width - 1.0).min(axis=0)
        impossible = ((slopes == 0) & (levels < 0)).any(axis=0)
    unusable = impossible | ~np.isfinite(first) | ~np.isfinite(last)
    first = np.where(unusable, width, np.clip(np.ceil(first), 0, width))
    last = np.where(unusable, -1, np.clip(np.floor(last), -1, width - 1))
    return first.astype(np.int32), last.astype(np.int32)
