"""The pooled curve of a method in every bootstrap draw, all draws at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_rpc.study.bd_rate import RateQualityCurve
from cable_rpc.study.rate_quality.pchip_rows import integrals, values
from cable_rpc.study.rate_quality.pooling import Float64Array, RateQualityGrid, Weights

RowsFunction = Callable[[npt.NDArray[np.int64], Float64Array, Float64Array], Float64Array]
"""Of rows int64 [R], and their log rates and qualities float64 [R, N], N at least 2; gives float64 [R]."""


@dataclass(frozen=True, slots=True)
class DrawnCurves:
    """Points by draw; the hull of each draw is its own."""

    rates: Float64Array
    """float64 [D, K], kbit/s."""
    qualities: Float64Array
    """float64 [D, K], NaN where the drawn sequences have nothing to gain."""

    @classmethod
    def of(cls, grid: RateQualityGrid, weights: Weights) -> DrawnCurves:
        """The pooled points of a grid under weights int64 [D, S]."""
        return cls(grid.rates(weights), grid.qualities(weights))

    @property
    def measured(self) -> npt.NDArray[np.bool_]:
        """bool [D, K], points that have both rate and quality."""
        return (self.rates > 0) & ~np.isnan(self.qualities)

    def curves(self) -> Iterator[RateQualityCurve]:
        """Draw by draw."""
        for rates, qualities, usable in zip(self.rates, self.qualities, self.measured, strict=True):
            yield RateQualityCurve(tuple(rates[usable].tolist()), tuple(qualities[usable].tolist()))

    def on_hulls(self, function: RowsFunction) -> Float64Array:
        """A function of each draw's hull, float64 [D]; NaN for hulls of less than two points."""
        found = np.full(len(self.rates), np.nan)
        for rows, log_rates, qualities in self.hulls():
            found[rows] = function(rows, log_rates, qualities)
        return found

    def hulls(self) -> Iterator[tuple[npt.NDArray[np.int64], Float64Array, Float64Array]]:
        """Draws with hulls of equally many points: their rows, decadic log rates and qualities, by rising rate.

        Those of fewer than two points are left out.
        """
        usable = self.measured
        rates = np.where(usable, self.rates, np.inf)
        qualities = np.where(usable, self.qualities, -np.inf)
        order = np.lexsort((-qualities, rates), axis=1)
        rates, qualities = (np.take_along_axis(values_, order, axis=1) for values_ in (rates, qualities))
        best = np.maximum.accumulate(qualities, axis=1)
        kept = np.isfinite(rates)
        kept[:, 1:] &= qualities[:, 1:] > best[:, :-1]
        counts = kept.sum(axis=1)
        for count in np.unique(counts[counts >= 2]):
            rows = np.flatnonzero(counts == count)
            chosen = kept[rows]
            shape = len(rows), int(count)
            yield rows, np.log10(rates[rows][chosen]).reshape(shape), qualities[rows][chosen].reshape(shape)

    def ends(self, *, of_rates: bool) -> tuple[Float64Array, Float64Array, npt.NDArray[np.int64]]:
        """Least and largest quality (or log rate) of each hull, and its points: float64 [D] twice, int64 [D]."""
        low, high = np.full(len(self.rates), np.nan), np.full(len(self.rates), np.nan)
        counts = np.zeros(len(self.rates), np.int64)
        for rows, log_rates, qualities in self.hulls():
            axis = log_rates if of_rates else qualities
            low[rows], high[rows], counts[rows] = axis[:, 0], axis[:, -1], axis.shape[1]
        return low, high, counts

    def areas(self, low: Float64Array, high: Float64Array, *, of_rates: bool) -> Float64Array:
        """Integral of log rate over quality, or of quality over log rate, from ``low`` to ``high`` [D], float64 [D]."""
        if of_rates:
            return self.on_hulls(lambda rows, x, y: integrals(x, y, low[rows], high[rows]))
        return self.on_hulls(lambda rows, y, x: integrals(x, y, low[rows], high[rows]))

    def log_rates_at(self, quality: float) -> Float64Array:
        """Decadic logarithm of the rate at a quality, float64 [D]; NaN beyond a hull."""
        return self.on_hulls(lambda _, y, x: values(x, y, quality))
