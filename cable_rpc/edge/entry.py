"""Actors that no prior knows yet: they drive in from the side, or step out between parked cars.

Everything here is joined with R_k after the corridor and never widens it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.types import BoolMask

Contour = npt.NDArray[np.int32]

TIE = 1e-9
"""Widths are rounded half up; rounding error of the product must not decide a tie."""
LINK_SHARE = 0.01
"""Pieces of motion closer than this share of the width are one actor, and its outline is widened by half of it."""
REACH_SHARE = 0.02
"""An actor moves by no more than this share of the width from frame to frame, beyond its own extent."""
ABOVE_HORIZON_SHARE = 0.1
"""Share of the height above the horizon in which heads and roofs still count."""
MAX_ACTORS = 16
"""Largest pieces of motion that are followed at a time."""


def first_actor_row(height: int, horizon_row: float | None) -> int:
    """Row above which motion is no sign of a new actor: every actor stands on the ground, below the horizon.

    Args:
        height: rows of the grid.
        horizon_row: row of the horizon on that grid; None = not known, taken to lie no higher than a third.
    """
    first = height / 3 if horizon_row is None else horizon_row
    return min(max(math.floor(first - ABOVE_HORIZON_SHARE * height), 0), height)


def strip_width(width: int, share: float) -> int:
    """Columns in a share of the width, rounded half up, at least 1 unless the share is 0."""
    return min(max(math.floor(share * width + 0.5 + TIE), 1), width) if share > 0 else 0


def entry_bands(motion: BoolMask, share: float, *, first_row: int = 0) -> BoolMask:
    """Residual motion along the left and right border, where no prior gates it.

    Args:
        motion: bool [height, width], D_k.
        share: width of each band, share of the frame's width; 0 gives none.
        first_row: no motion counts above this row, see `first_actor_row`.

    Returns:
        bool [height, width], a new array.
    """
    bands = np.zeros_like(motion)
    strip = strip_width(motion.shape[1], share)
    if strip:
        bands[first_row:, :strip] = motion[first_row:, :strip]
        bands[first_row:, -strip:] = motion[first_row:, -strip:]
    return bands


def new_view(valid: BoolMask | None, limit_share: float = 0.25, *, first_row: int = 0) -> BoolMask | None:
    """The strip along the left or right border that the camera's turn has just brought into view.

    In each row it reaches from the border to the first pixel that the previous frame showed too. A warp that
    leaves more than ``limit_share`` of the columns (of the rows in question) without a past is no turn but a cut
    or a failure, on which only a keyframe helps: it brings nothing.

    Args:
        valid: bool [height, width], where the warped previous frame is defined; None = everywhere.
        limit_share: mean width of the undefined area up to which it is taken for a turn, share of the width.
        first_row: nothing is added above this row, see `first_actor_row`.

    Returns:
        bool [height, width], or None where nothing is new.
    """
    if valid is None:
        return None
    seen = valid[first_row:]
    unseen = 1.0 - np.count_nonzero(seen) / max(seen.size, 1)
    if not 0.0 < unseen <= limit_share:
        return None
    strip = np.zeros_like(valid)
    new = strip[first_row:]
    always = np.flatnonzero(seen.all(axis=0))
    # Beyond the outermost columns that are seen in every row, no row has a strip.
    left, right = (int(always[0]), int(always[-1]) + 1) if len(always) else (seen.shape[1], 0)
    new[:, :left] = unseen_start(seen[:, :left])
    new[:, right:] |= unseen_start(seen[:, right:][:, ::-1])[:, ::-1]
    if not len(always):
        new[~seen.any(axis=1)] = False
    return strip


def unseen_start(seen: BoolMask) -> BoolMask:
    """Per row the pixels before the first one that is seen."""
    return np.logical_not(np.logical_or.accumulate(seen, axis=1))


@dataclass(frozen=True, slots=True)
class Sighting:
    """One piece of motion outside the dilated prior."""

    outline: Contour
    """int32 [points, 1, 2], its convex hull, x and y in pixels."""
    box_xyxy: tuple[int, int, int, int]
    """Exclusive maxima."""
    frames: int = 1
    """Frames in a row in which it was seen."""


def sightings(outside: BoolMask, min_area_px: float, link_px: int) -> list[Sighting]:
    """Pieces of motion outside the dilated prior whose convex hull is larger than an area.

    A moving textured body changes mostly along its outline, so pieces are closed over small gaps and measured by
    their hull.
    """
    closed = cv2.morphologyEx(outside.view(np.uint8), cv2.MORPH_CLOSE, square(link_px))
    contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    # A hull of that area is at least so wide or high, and its contour goes there and back.
    least_points = 2 * (math.sqrt(min_area_px) - 1)
    found = []
    for contour in contours:
        if len(contour) < least_points:
            continue
        x, y, width, height = cv2.boundingRect(contour)
        if width * height > min_area_px:
            area, hull = hull_of(contour)
            if area > min_area_px:
                found.append((area, Sighting(hull, (x, y, x + width, y + height))))
    found.sort(key=lambda piece: piece[0], reverse=True)
    return [sighting for _, sighting in found[:MAX_ACTORS]]


def square(side_px: int) -> npt.NDArray[np.uint8]:
    """Structuring element of odd side that closes gaps of up to ``side_px`` pixels."""
    side = 2 * math.ceil(side_px / 2) + 1
    return np.ones((side, side), np.uint8)


def hull_of(contour: cv2.typing.MatLike) -> tuple[float, Contour]:
    """Pixels inside a contour's convex hull, its outline included (Pick's theorem), and the hull."""
    hull = np.asarray(cv2.convexHull(contour), np.int32)
    corners = hull[:, 0].tolist()
    sides = zip(corners, corners[1:] + corners[:1], strict=True)
    on_outline = sum(math.gcd(x1 - x0, y1 - y0) for (x0, y0), (x1, y1) in sides)
    return cv2.contourArea(hull) + on_outline / 2 + 1, hull


def continued(current: list[Sighting], previous: list[Sighting], reach_px: float) -> list[Sighting]:
    """Current sightings, each counted on from the longest previous one within reach of its box."""
    if not current or not previous:
        return current
    now = np.array([sighting.box_xyxy for sighting in current])[:, None]
    before = np.array([sighting.box_xyxy for sighting in previous])[None]
    near = (now[..., :2] < before[..., 2:] + reach_px).all(axis=-1)
    near &= (before[..., :2] < now[..., 2:] + reach_px).all(axis=-1)
    ages = (near * np.array([sighting.frames for sighting in previous])).max(axis=1)
    return [Sighting(s.outline, s.box_xyxy, 1 + int(age)) for s, age in zip(current, ages, strict=True)]


class NoveltyDetector:
    """Finds actors born outside the dilated prior by motion that lasts for some frames.

    Args:
        config: least area, number of frames, and the share of the frame that may move.
    """

    def __init__(self, config: RoiConfig) -> None:
        self.config = config
        self.previous: list[Sighting] = []

    def reset(self) -> None:
        """Forget what was seen so far."""
        self.previous = []

    def update(self, motion: BoolMask, dilated: BoolMask, *, first_row: int = 0) -> BoolMask | None:
        """Take in the next frame's motion.

        Args:
            motion: bool [height, width], D_k.
            dilated: bool [height, width], Mplus; motion inside it is no news.
            first_row: no motion counts above this row, see `first_actor_row`.

        Returns:
            bool [height, width], the convex outlines of what was seen for long enough; None where there is
            nothing.
        """
        if self.config.novelty_area_share == 0:
            return None
        outside = np.greater(motion, dilated)
        moving = np.count_nonzero(outside)
        if not 0 < moving <= self.config.novelty_limit_share * motion.size:
            self.reset()
            return None
        height, width = motion.shape
        link_px = max(round(LINK_SHARE * width), 1)
        outside[:first_row] = False
        found = sightings(outside, self.config.novelty_area_share * motion.size, link_px)
        self.previous = continued(found, self.previous, REACH_SHARE * width)
        lasting = [s.outline for s in self.previous if s.frames >= self.config.novelty_frames]
        if not lasting:
            return None
        region = np.zeros((height, width), np.uint8)
        for outline in lasting:
            cv2.fillConvexPoly(region, outline, 1)
        return cv2.dilate(region, square(link_px)).view(np.bool_)
