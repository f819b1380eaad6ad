"""Bytes of whole frames at the quality that a strategy gives its region: the saving that equal settings misstate.

A constant rate factor gives simpler pictures a finer quantiser, so a region alone is coded better than the same region
in the whole frame. Here whole frames are coded at several factors, their squared error of luma is taken inside what the
strategy sent, and their bytes are interpolated at its PSNR there: PCHIP of log bytes, as `cable_rpc.study.bd_rate`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.bd_rate import RateQualityCurve
from cable_rpc.study.metrics import Bootstrap, bootstrap_interval, drawn_ratios
from cable_rpc.study.sequence_metrics import Estimate

PEAK = 255.0

EQUAL_QUALITY_FIGURES: Mapping[str, str] = {
    "byte_saving_equal_psnr": "bytes saved at the message layer against whole frames in H.264 that have the same PSNR "
    "inside what was sent",
    "roi_psnr_db": "PSNR of luma inside what was sent, squared errors pooled over frames",
    "full_psnr_db": "the same of the whole frames as they were coded for the equal-setting savings",
}
"""Names of `EqualQualityPool.figure` and what they mean."""


@dataclass(frozen=True, slots=True)
class Rung:
    """Whole frames at one setting, summed over frames."""

    crf: int
    bytes_up: int
    """Of the whole messages."""
    squared_error: float
    """Of luma inside the strategy's region, in grey levels squared."""


@dataclass(frozen=True, slots=True)
class EqualQuality:
    """One strategy beside the whole frames at several settings; frames of a sequence add up."""

    pixels: int
    """Inside what was sent; all of a frame that was sent whole."""
    squared_error: float
    bytes_up: int
    """Of the whole messages, masks included."""
    own_crf: int
    """Setting of the whole frames that equal-setting savings are held against; one of the rungs."""
    rungs: tuple[Rung, ...]

    def __add__(self, other: EqualQuality) -> EqualQuality:
        rungs = (
            Rung(one.crf, one.bytes_up + more.bytes_up, one.squared_error + more.squared_error)
            for one, more in zip(self.rungs, other.rungs, strict=True)
        )
        return EqualQuality(
            self.pixels + other.pixels,
            self.squared_error + other.squared_error,
            self.bytes_up + other.bytes_up,
            self.own_crf,
            tuple(rungs),
        )

    @property
    def own_rung(self) -> Rung:
        """The whole frames at their own setting."""
        return next(rung for rung in self.rungs if rung.crf == self.own_crf)

    def whole_bytes(self) -> float | None:
        """Bytes of whole frames as good inside the region; None where that lies beyond the settings tried.

        Raises:
            ConfigurationError: scipy is missing.
        """
        for rung in self.rungs:
            if rung.squared_error == self.squared_error:
                return float(rung.bytes_up)
        lossy = [rung for rung in self.rungs if rung.squared_error > 0]
        if not self.pixels or not self.squared_error or not lossy:
            return None
        curve = RateQualityCurve(
            tuple(float(rung.bytes_up) for rung in lossy),
            tuple(psnr(rung.squared_error, self.pixels) for rung in lossy),
        ).without_dominated()
        wanted = psnr(self.squared_error, self.pixels)
        if len(curve) < 2 or not curve.qualities[0] <= wanted <= curve.qualities[-1]:
            return None
        try:
            from scipy.interpolate import PchipInterpolator
        except ImportError as error:
            raise ConfigurationError("bytes at equal quality need scipy: pip install 'cable-rpc[study]'") from error
        return float(np.exp(PchipInterpolator(curve.qualities, np.log(curve.rates))(wanted)))

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return asdict(self)

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """The inverse of `to_json`."""
        rungs = tuple(Rung(**rung) for rung in content["rungs"])
        return cls(**{**content, "rungs": rungs})


@dataclass(frozen=True, slots=True)
class EqualQualityPool:
    """Any number of sequences under one strategy."""

    sequences: tuple[EqualQuality, ...] = ()
    bootstrap: Bootstrap | None = None

    def figure(self, name: str) -> Estimate:
        """One of `EQUAL_QUALITY_FIGURES`, undefined where nothing was measured.

        Raises:
            ConfigurationError: there is no such figure, or scipy is missing.
        """
        pixels = sum(one.pixels for one in self.sequences)
        if name == "byte_saving_equal_psnr":
            return self.saving()
        if name == "roi_psnr_db":
            return Estimate(psnr(sum(one.squared_error for one in self.sequences), pixels) if pixels else None)
        if name == "full_psnr_db":
            error = sum(one.own_rung.squared_error for one in self.sequences)
            return Estimate(psnr(error, pixels) if pixels else None)
        raise ConfigurationError(f"there is no figure '{name}'; choose of {', '.join(EQUAL_QUALITY_FIGURES)}")

    def saving(self) -> Estimate:
        """Bytes saved as a share of the whole frames' interpolated bytes, both summed over sequences.

        Sequences whose quality lies beyond the settings tried are left out of both sums.
        """
        both = [(one.bytes_up, one.whole_bytes()) for one in self.sequences]
        pairs = [(own, whole_bytes) for own, whole_bytes in both if whole_bytes is not None]
        if not pairs:
            return Estimate(None)
        whole = np.array([pair[1] for pair in pairs])
        saved = whole - np.array([pair[0] for pair in pairs], np.float64)
        value = float(saved.sum() / whole.sum())
        if self.bootstrap is None:
            return Estimate(value)
        interval = bootstrap_interval(len(pairs), lambda weights: drawn_ratios(saved, whole, weights), self.bootstrap)
        return Estimate(value, interval)


def pool_equal_quality(found: Sequence[EqualQuality | None], bootstrap: Bootstrap | None = None) -> EqualQualityPool:
    """The sequences that were measured so."""
    return EqualQualityPool(tuple(one for one in found if one is not None), bootstrap)


def psnr(squared_error: float, pixels: int) -> float:
    """Decibels of a pooled squared error; infinity where there is none."""
    return 10.0 * math.log10(PEAK**2 * pixels / squared_error) if squared_error else math.inf
