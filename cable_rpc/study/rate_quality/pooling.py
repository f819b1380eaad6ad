"""Points of a method as a grid of sequences by settings, pooled for any weights of the sequences.

A pooled point only compares with others if all rest on the same sequences. A setting at which one of the sequences
wasn't measured is therefore left out, and said so; so is one that leads to no rate or no quality.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_rpc.study.bd_rate import RateQualityCurve
from cable_rpc.study.metrics.bootstrap import drawn_ratios
from cable_rpc.study.rate_quality.points import Method, SequencePoint

Float64Array = npt.NDArray[np.float64]
Weights = npt.NDArray[np.int64]
"""int64 [draws, S], how often each sequence counts."""

KILOBITS_PER_BYTE = 8e-3


@dataclass(frozen=True, slots=True)
class RateQualityGrid:
    """S sequences by K settings, both by name; every field of numbers is float64 [S, K]."""

    sequences: tuple[str, ...]
    settings: tuple[str, ...]
    kilobits: Float64Array
    seconds: Float64Array
    gained: Float64Array
    possible: Float64Array
    left_out: tuple[str, ...]
    """Why settings of the method are missing here, one text for each."""

    @property
    def judged(self) -> npt.NDArray[np.bool_]:
        """bool [S], sequences that have anything to gain, and so bear on the quality."""
        judged: npt.NDArray[np.bool_] = np.any(self.possible > 0, axis=1)
        return judged

    def rates(self, weights: Weights) -> Float64Array:
        """Kilobits per second pooled in each draw, float64 [draws, K]."""
        return pooled_ratios(self.kilobits, self.seconds, weights)

    def qualities(self, weights: Weights) -> Float64Array:
        """Quality pooled in each draw, float64 [draws, K], NaN where the drawn sequences have nothing to gain."""
        return pooled_ratios(self.gained, self.possible, weights)

    def curves(self, weights: Weights) -> list[RateQualityCurve]:
        """The pooled curve in each draw, without points that have no rate or no quality."""
        curves = []
        for rates, qualities in zip(self.rates(weights), self.qualities(weights), strict=True):
            usable = (rates > 0) & ~np.isnan(qualities)
            curves.append(RateQualityCurve(tuple(rates[usable].tolist()), tuple(qualities[usable].tolist())))
        return curves

    def curve(self) -> RateQualityCurve:
        """The curve pooled over the sequences, each counted once."""
        return self.curves(self.each_once)[0]

    @property
    def each_once(self) -> Weights:
        """int64 [1, S], the weights of the sequences as they were measured."""
        return np.ones((1, len(self.sequences)), np.int64)


def pooled_ratios(numerators: Float64Array, denominators: Float64Array, weights: Weights) -> Float64Array:
    """Ratios of weighted sums over sequences, float64 [draws, K], NaN where a denominator is 0.

    Args:
        numerators: [S, K].
        denominators: [S, K], at least 0.
        weights: int64 [draws, S].
    """
    ratios = np.empty((len(weights), numerators.shape[1]))
    for column in range(numerators.shape[1]):
        ratios[:, column] = drawn_ratios(numerators[:, column], denominators[:, column], weights)
    return ratios


def grid_of(method: Method, sequences: tuple[str, ...]) -> RateQualityGrid:
    """The points of a method at the settings that all of some sequences have.

    Args:
        method: measured points.
        sequences: names of those to keep, all of them the method's; none leave nothing.
    """
    placed = {(point.sequence, point.setting): point for point in method.points}
    settings: list[str] = []
    left_out: list[str] = []
    for setting in method.settings if sequences else ():
        complaint = complaint_of(method.label, setting, [(name, placed.get((name, setting))) for name in sequences])
        if complaint:
            left_out.append(complaint)
        else:
            settings.append(setting)
    rows = [[placed[name, setting] for setting in settings] for name in sequences]
    shape = len(sequences), len(settings)
    return RateQualityGrid(
        sequences,
        tuple(settings),
        np.array([[KILOBITS_PER_BYTE * one.bytes_up for one in row] for row in rows], np.float64).reshape(shape),
        np.array([[one.seconds for one in row] for row in rows], np.float64).reshape(shape),
        np.array([[one.gained for one in row] for row in rows], np.float64).reshape(shape),
        np.array([[one.possible for one in row] for row in rows], np.float64).reshape(shape),
        tuple(left_out),
    )


def complaint_of(label: str, setting: str, points: list[tuple[str, SequencePoint | None]]) -> str:
    """Why a setting can't be pooled; empty where it can."""
    here = f"'{label}' at '{setting}' is left out: "
    missing = [name for name, point in points if point is None]
    present = [point for _, point in points if point is not None]
    if missing:
        return f"{here}it wasn't measured on {', '.join(missing)}; measure it there too"
    if not sum(point.bytes_up for point in present):
        return f"{here}nothing was sent, so it has no rate on a logarithmic scale"
    if not sum(point.possible for point in present):
        return f"{here}no sequence has anything to find; choose sequences with ground truth"
    return ""
