"""Quality of each still image so that a stream of them keeps a bit rate.

One pass: before a frame, its bytes at each quality are predicted from its pixels; afterwards the true number
corrects the prediction. The prediction is log-linear,

    ln(bytes) = level + ln(pixels) + slope * curve(quality)

where ``curve`` is the codec's own and level and slope follow the content. Frames sent whole have a level of their
own: the region's detail says little about the rest of the picture. Bytes spent above the target so far are a debt,
which the following frames pay back over a fraction of the window.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

from cable_codecs.errors import CodecError


@dataclass(frozen=True, slots=True)
class QualityCurve:
    """How the bytes of a codec grow with its quality, on average over road images."""

    qualities: tuple[int, ...]
    """Rising."""
    log_bytes: tuple[float, ...]
    """Natural logarithm of the bytes at each, relative to those at quality 50; rising."""

    def __post_init__(self) -> None:
        rising = all(a < b for a, b in pairwise(self.qualities)) and all(a < b for a, b in pairwise(self.log_bytes))
        if len(self.qualities) < 2 or len(self.qualities) != len(self.log_bytes) or not rising:
            raise CodecError("a quality curve needs at least two qualities and as many log_bytes, both rising")

    def at(self, quality: float) -> float:
        """The logarithm at a quality, linear between the points and beyond them."""
        return interpolate(quality, self.qualities, self.log_bytes)

    def quality_of(self, log_bytes: float) -> float:
        """The quality at a logarithm; the inverse of ``at``."""
        return interpolate(log_bytes, self.log_bytes, self.qualities)


JPEG_CURVE = QualityCurve(
    (1, 4, 8, 13, 20, 30, 40, 50, 60, 70, 80, 85, 90, 93, 96, 98, 100),
    (-2.2, -1.8, -1.25, -0.88, -0.57, -0.31, -0.14, 0.0, 0.13, 0.3, 0.53, 0.69, 0.92, 1.12, 1.43, 1.75, 2.2),
)
WEBP_CURVE = QualityCurve(
    (1, 5, 10, 20, 30, 40, 50, 60, 70, 75, 80, 85, 90, 95, 100),
    (-1.0, -0.86, -0.7, -0.47, -0.3, -0.14, 0.0, 0.12, 0.23, 0.28, 0.5, 0.71, 0.95, 1.3, 1.9),
)

FIRST_BYTES_PER_PIXEL = 0.09
"""At quality 50, before anything is known: road frames take 0.03 to 0.14."""
FILL_WEIGHT = 0.03
"""What a pixel of the constant fill costs, of one inside the region."""
LEVEL_GAIN = 0.6
SLOPE_GAIN = 0.1
SLOPE_RANGE = (0.75, 1.3)
STEADY_GAIN = 0.1
SLOPE_NOISE = 0.1
"""Squared change of ``curve`` below which an error says little about the slope."""
BUDGET_RANGE = (0.1, 1.5)
"""No frame is planned with fewer or more bytes than these shares of its target, whatever the debt."""
RETRY_ABOVE = 1.6
"""Coding a frame once more is worth while where it took more than this share of its target."""
DEBT_SHARE = 0.15
"""Share of the window over which a debt is paid back."""
ROOM_SHARE = 0.015
"""Share of the window's bytes by which the debt may swing to keep the quality steady."""
DEBT_LIMIT_SHARE = 0.1
"""Share of the window's bytes beyond which debt or credit is forgotten: it can't be made good within the window."""

Limit = Literal["floor", "ceiling"]


@dataclass(frozen=True, slots=True)
class StillRateStatus:
    """What a controller has come to."""

    frames: int
    mean_kbps: float
    """Over all frames; 0 before the first."""
    largest_overshoot: float
    """Of the bytes of a frame over the target of one frame, at the most: 1 is twice the target."""
    frames_at_floor: int
    """Frames at the lowest quality that were to have fewer bytes still."""
    frames_at_ceiling: int
    """Frames at the highest quality that might have had more bytes."""
    limit: Limit | None
    """Which end of the range the newest frame was at: while it lasts, the target is out of reach."""


@dataclass(frozen=True, slots=True)
class PlannedFrame:
    """What was decided for a frame whose bytes are not yet known."""

    quality: int
    whole: bool
    log_size: float
    """Logarithm of its weighted pixels."""
    limit: Limit | None


class StillRateController:
    """Chooses the quality of each JPEG or WebP image so that the stream keeps a bit rate.

    Call `quality_for` before a frame is coded and `coded` after; a frame that is dropped before coding needs no
    `coded`. Deterministic; holds no codec.

    Args:
        target_kbps: Bit rate of the images in kbit/s (1000 bits).
        frame_rate: Frames per second that will truly be coded.
        frame_pixels: Width times height.
        curve: The codec's quality curve.
        lowest_quality: Never go below; the target may be missed for it.
        highest_quality: Never go above.
        window_s: Seconds over which the rate shall be kept.

    Raises:
        CodecError: A value out of range.
    """

    def __init__(
        self,
        target_kbps: float,
        frame_rate: float,
        *,
        frame_pixels: int,
        curve: QualityCurve = JPEG_CURVE,
        lowest_quality: int = 5,
        highest_quality: int = 95,
        window_s: float = 2.0,
    ) -> None:
        for label, value in (("frame_rate", frame_rate), ("frame_pixels", frame_pixels), ("window_s", window_s)):
            if not (math.isfinite(value) and value > 0):
                raise CodecError(f"still rate control: {label} must be positive, got {value}")
        if not 1 <= lowest_quality <= highest_quality <= 100:
            raise CodecError(
                f"still rate control: qualities must be 1 <= lowest <= highest <= 100, got {lowest_quality} "
                f"and {highest_quality}"
            )
        self.frame_rate = frame_rate
        self.frame_pixels = frame_pixels
        self.curve = curve
        self.lowest_quality, self.highest_quality = lowest_quality, highest_quality
        self.window_frames = max(1.0, window_s * frame_rate)
        self.debt = 0.0
        self.steady: float | None = None
        self.retarget(target_kbps)
        self.levels: dict[bool, float] = {}
        self.slope = 1.0
        self.previous: tuple[bool, float] | None = None
        self.planned: PlannedFrame | None = None
        self.frames = self.total_bytes = self.frames_at_floor = self.frames_at_ceiling = 0
        self.largest_overshoot = 0.0
        self.limit: Limit | None = None

    def retarget(self, target_kbps: float) -> None:
        """Change the bit rate from the next frame on.

        Raises:
            CodecError: Not positive.
        """
        if not (math.isfinite(target_kbps) and target_kbps > 0):
            raise CodecError(f"still rate control: target_kbps must be positive, got {target_kbps}")
        self.frame_bytes = target_kbps * 125 / self.frame_rate
        self.debt, self.steady = 0.0, None

    def quality_for(self, pixels: float, *, whole: bool = False) -> int:
        """The quality to code the next frame at.

        Args:
            pixels: Pixels inside its region of interest, up to all of the frame.
            whole: It is sent without a fill. Its content differs from a region's, so it is predicted apart.

        Raises:
            CodecError: ``pixels`` isn't 0..``frame_pixels``.
        """
        if not 0 <= pixels <= self.frame_pixels:
            raise CodecError(f"still rate control: pixels must be 0..{self.frame_pixels}, got {pixels}")
        log_size = math.log(pixels + FILL_WEIGHT * (self.frame_pixels - pixels))
        base = self.level_of(whole) + log_size
        budget = self.frame_bytes - self.debt / max(1.0, DEBT_SHARE * self.window_frames)
        room = max(0.0, ROOM_SHARE * self.window_frames * self.frame_bytes - abs(self.debt))
        least_bytes, most_bytes = (share * self.frame_bytes for share in BUDGET_RANGE)
        # The curve's value that gives the least bytes acceptable, the budget, and the most bytes acceptable.
        least, on_budget, most = (
            (math.log(min(max(byte_count, least_bytes), most_bytes)) - base) / self.slope
            for byte_count in (budget - room, budget, budget + room)
        )
        # What can't be reached must not draw the steady value away.
        on_budget = min(max(on_budget, self.curve.at(self.lowest_quality)), self.curve.at(self.highest_quality))
        self.steady = on_budget if self.steady is None else self.steady + STEADY_GAIN * (on_budget - self.steady)
        chosen = min(max(self.steady, least), most)
        wanted = self.curve.quality_of(chosen)
        quality = min(max(round(wanted), self.lowest_quality), self.highest_quality)
        limit: Limit | None = None
        if wanted < self.lowest_quality:
            limit = "floor"
        elif wanted > self.highest_quality:
            limit = "ceiling"
        self.planned = PlannedFrame(quality, whole, log_size, limit)
        return quality

    def retry_quality(self, byte_count: int) -> int | None:
        """A lower quality to code the same frame at once more, None where it should be sent as it is.

        Optional, before `coded`: a caller that has the time bounds the bytes of frames whose content surprises. Ask
        until the answer is None; each quality is lower than the one before.

        Args:
            byte_count: What the frame took at the newest quality.

        Raises:
            CodecError: No frame is open, or the number isn't positive.
        """
        planned = self.open_frame(byte_count)
        if byte_count <= RETRY_ABOVE * self.frame_bytes or planned.quality <= self.lowest_quality:
            return None
        curve = self.curve.at(planned.quality)
        self.levels[planned.whole] = math.log(byte_count) - planned.log_size - self.slope * curve
        wanted = self.curve.quality_of(curve + math.log(self.frame_bytes / byte_count) / self.slope)
        quality = min(max(math.floor(wanted), self.lowest_quality), planned.quality - 1)
        limit: Limit | None = "floor" if wanted < self.lowest_quality else None
        self.planned = replace(planned, quality=quality, limit=limit)
        return quality

    def open_frame(self, byte_count: int) -> PlannedFrame:
        """The frame between `quality_for` and `coded`.

        Raises:
            CodecError: There is none, or the number of bytes isn't positive.
        """
        if self.planned is None:
            raise CodecError("still rate control: bytes without a frame; call quality_for() before each frame")
        if byte_count < 1:
            raise CodecError(f"still rate control: a coded frame has at least 1 byte, got {byte_count}")
        return self.planned

    def coded(self, byte_count: int) -> None:
        """Tell the bytes of the frame that `quality_for` was asked about last.

        Raises:
            CodecError: No frame is open, or the number isn't positive.
        """
        planned = self.open_frame(byte_count)
        self.planned = None
        self.learn(planned, math.log(byte_count))
        limit = DEBT_LIMIT_SHARE * self.window_frames * self.frame_bytes
        self.debt = min(max(self.debt + byte_count - self.frame_bytes, -limit), limit)
        self.frames += 1
        self.total_bytes += byte_count
        self.frames_at_floor += planned.limit == "floor"
        self.frames_at_ceiling += planned.limit == "ceiling"
        self.limit = planned.limit
        self.largest_overshoot = max(self.largest_overshoot, byte_count / self.frame_bytes - 1)

    def learn(self, planned: PlannedFrame, log_bytes: float) -> None:
        """Correct level and slope by a frame's true bytes."""
        curve = self.curve.at(planned.quality)
        level = self.level_of(planned.whole)
        error = log_bytes - (level + planned.log_size + self.slope * curve)
        if self.previous is not None and self.previous[0] == planned.whole:
            change = curve - self.previous[1]
            slope = self.slope + SLOPE_GAIN * error * change / (change * change + SLOPE_NOISE)
            self.slope = min(max(slope, SLOPE_RANGE[0]), SLOPE_RANGE[1])
        self.previous = (planned.whole, curve)
        gain = LEVEL_GAIN if planned.whole in self.levels else 1.0
        self.levels[planned.whole] = level + gain * error

    def level_of(self, whole: bool) -> float:
        """Logarithm of the bytes per pixel at quality 50; where none of a kind came yet, that of the other kind."""
        known = self.levels.get(whole, self.levels.get(not whole))
        return math.log(FIRST_BYTES_PER_PIXEL) if known is None else known

    @property
    def status(self) -> StillRateStatus:
        """What has come of it so far."""
        kbps = self.total_bytes * self.frame_rate / 125 / self.frames if self.frames else 0.0
        return StillRateStatus(
            self.frames, kbps, self.largest_overshoot, self.frames_at_floor, self.frames_at_ceiling, self.limit
        )


def interpolate(x: float, xs: tuple[float, ...], ys: tuple[float, ...]) -> float:
    """Piecewise linear through rising points, the outer pieces prolonged."""
    after = min(max(bisect_right(xs, x), 1), len(xs) - 1)
    share = (x - xs[after - 1]) / (xs[after] - xs[after - 1])
    return ys[after - 1] + share * (ys[after] - ys[after - 1])
