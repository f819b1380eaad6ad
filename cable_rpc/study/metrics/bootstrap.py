"""Cluster bootstrap: intervals of figures pooled over sequences, by drawing whole sequences with replacement.

Frames of one drive are no independent sample, so frames are never drawn. A figure is a ratio of sums over sequences;
each draw weighs every sequence by how often it was drawn, and the interval runs between percentiles of the ratios
(Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, chapter 13). With few sequences such an interval is too
narrow: below about ten read it as a lower bound of the spread. Below three none is given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from cable_rpc.errors import ConfigurationError

Float64Array = npt.NDArray[np.float64]

MIN_CLUSTERS = 3


@dataclass(frozen=True, slots=True)
class Interval:
    """A two-sided percentile interval."""

    low: float
    high: float
    level: float
    """Nominal coverage, e.g. 0.95."""


@dataclass(frozen=True, slots=True)
class Bootstrap:
    """How to draw.

    Raises:
        ConfigurationError: a value is outside its range.
    """

    draws: int = 2000
    level: float = 0.95
    seed: int = 0

    def __post_init__(self) -> None:
        if self.draws < 1 or self.seed < 0:
            raise ConfigurationError(f"Bootstrap.draws is {self.draws}, seed {self.seed}; give at least 1 and 0")
        if not 0.0 < self.level < 1.0:
            raise ConfigurationError(f"Bootstrap.level is {self.level}; give a share between 0 and 1, such as 0.95")


@lru_cache(maxsize=8)
def cluster_draws(clusters: int, bootstrap: Bootstrap) -> npt.NDArray[np.int64]:
    """How often each cluster is drawn, int64 [draws, clusters], read-only; each row sums to the number of clusters.

    Equal for an equal number of clusters and an equal `Bootstrap`, so figures drawn apart are paired.
    """
    random = np.random.default_rng(bootstrap.seed)
    draws = random.multinomial(clusters, np.full(clusters, 1.0 / clusters), size=bootstrap.draws)
    draws.flags.writeable = False
    return draws


def bootstrap_interval(
    clusters: int,
    statistic: Callable[[npt.NDArray[np.int64]], Float64Array],
    bootstrap: Bootstrap,
    *,
    informative: int | None = None,
) -> Interval | None:
    """Percentile interval of any figure of clusters; that of a difference, if the statistic is one.

    Args:
        clusters: S, number of sequences.
        statistic: from how often each cluster counts, int64 [draws, S], to the figure in each draw, float64 [draws],
            NaN where it is undefined; such draws are left out.
        bootstrap: how to draw.
        informative: clusters that bear on the figure at all; all by default.

    Returns:
        None for fewer than three such clusters.
    """
    if min(clusters, clusters if informative is None else informative) < MIN_CLUSTERS:
        return None
    sample = statistic(cluster_draws(clusters, bootstrap))
    defined = sample[~np.isnan(sample)]
    if not len(defined):
        return None
    tail = (1.0 - bootstrap.level) / 2.0
    low, high = np.quantile(defined, (tail, 1.0 - tail))
    return Interval(float(low), float(high), bootstrap.level)


def drawn_ratios(
    numerators: npt.ArrayLike, denominators: npt.ArrayLike, weights: npt.NDArray[np.int64]
) -> Float64Array:
    """The ratio of sums in each draw.

    Args:
        numerators: [S], one per cluster, or [S, K] for a mean over K such ratios.
        denominators: likewise, at least 0.
        weights: int64 [draws, S].

    Returns:
        float64 [draws], NaN where a denominator is 0.
    """
    above, below = np.asarray(numerators, np.float64), np.asarray(denominators, np.float64)
    totals = weights @ below.reshape(len(below), -1)
    sums = weights @ above.reshape(len(above), -1)
    ratios: Float64Array = np.divide(sums, totals, out=np.full(totals.shape, np.nan), where=totals > 0.0).mean(axis=1)
    return ratios
