"""Paired comparison of two methods on the sequences that both have, again in every bootstrap draw.

Both methods are pooled with the same weights, so what sequences have in common (a busy street costs every method more)
cancels out of the comparison.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cable_rpc.study.metrics.bootstrap import MIN_CLUSTERS, Bootstrap, Interval, bootstrap_interval, cluster_draws
from cable_rpc.study.rate_quality.drawn_curves import DrawnCurves
from cable_rpc.study.rate_quality.points import Method
from cable_rpc.study.rate_quality.pooling import Float64Array, RateQualityGrid, grid_of

MIN_DEFINED_DRAWS = 0.9
"""Share of the draws that must have the figure before there is an interval: percentiles of the rest would be too
narrow, for the draws that lack it are rarely an arbitrary lot."""

DrawnFigure = Callable[[tuple[DrawnCurves, ...]], Float64Array]
"""A figure of one or two curves in every draw, float64 [D], NaN where they have none."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two methods on the sequences that both have."""

    anchor: RateQualityGrid
    test: RateQualityGrid
    notes: tuple[str, ...]
    """What was left out of either, and why."""

    @property
    def sequences(self) -> tuple[str, ...]:
        """Names of the sequences, sorted."""
        return self.anchor.sequences

    @property
    def judged(self) -> tuple[str, ...]:
        """Those that have anything to gain in both."""
        both = self.anchor.judged & self.test.judged
        return tuple(name for name, judged in zip(self.sequences, both, strict=True) if judged)


@dataclass(frozen=True, slots=True)
class Resampled:
    """What the draws say of a figure."""

    interval: Interval | None = None
    defined_draws: float = 0.0
    """Share of the draws in which the figure was defined; 0 where none were drawn."""
    notes: tuple[str, ...] = ()
    """Why there is no interval, though draws were asked for."""


def paired(anchor: Method, test: Method) -> Pair:
    """Both methods on the sequences that both have; the sequences may be none."""
    common = tuple(sorted(set(anchor.sequences) & set(test.sequences)))
    notes = []
    for method in (anchor, test):
        alone = [name for name in method.sequences if name not in common]
        if alone:
            notes.append(
                f"only '{method.label}' was measured on {', '.join(alone)}, left out; measure the other there too"
            )
    grids = grid_of(anchor, common), grid_of(test, common)
    return Pair(*grids, (*notes, *grids[0].left_out, *grids[1].left_out))


def resample(
    grids: tuple[RateQualityGrid, ...], figure: DrawnFigure, bootstrap: Bootstrap | None, informative: int
) -> Resampled:
    """The spread of a figure over draws of whole sequences, the same draws for every grid.

    Args:
        grids: of the same sequences.
        figure: from the pooled curves of each grid in all draws.
        bootstrap: how to draw; None draws nothing.
        informative: sequences that bear on the figure; fewer than three give no interval.
    """
    if bootstrap is None:
        return Resampled()
    if informative < MIN_CLUSTERS:
        return Resampled(
            notes=(f"no interval: {informative} sequences bear on it, {MIN_CLUSTERS} are needed; measure more",)
        )
    clusters = len(grids[0].sequences)
    # Few sequences have few distinct draws: 10 for three, 462 for six.
    distinct, inverse = np.unique(cluster_draws(clusters, bootstrap), axis=0, return_inverse=True)
    sample = figure(tuple(DrawnCurves.of(grid, distinct) for grid in grids))[inverse.reshape(-1)]
    defined = 1.0 - float(np.isnan(sample).mean())
    if defined < MIN_DEFINED_DRAWS:
        return Resampled(
            None,
            defined,
            (
                f"no interval: {100 * defined:.0f} % of the draws have the figure, {100 * MIN_DEFINED_DRAWS:.0f} % are "
                "needed; code at more or finer CRFs so that the curves share more, or measure more sequences",
            ),
        )
    return Resampled(bootstrap_interval(clusters, lambda _: sample, bootstrap, informative=informative), defined)
