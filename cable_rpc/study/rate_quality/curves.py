"""A method's curve over all of its sequences, and the part of it that nothing beats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cable_rpc.study.bd_rate import RateQualityCurve
from cable_rpc.study.metrics.bootstrap import Bootstrap, Interval, bootstrap_interval, drawn_ratios
from cable_rpc.study.rate_quality.points import Method
from cable_rpc.study.rate_quality.pooling import Float64Array, grid_of


@dataclass(frozen=True, slots=True)
class PooledPoint:
    """One setting of a method over all of its sequences."""

    setting: str
    rate_kbps: float
    """Bits of all sequences over the seconds of all sequences, in kbit/s."""
    quality: float
    """What was gained in all sequences of what was possible in all."""
    rate_interval: Interval | None
    """None without a bootstrap, or for fewer than three sequences."""
    quality_interval: Interval | None
    """Likewise; sequences with nothing to gain don't count."""
    sequences: int
    cells: tuple[str, ...]
    """Keys of the measured cells, by name of the sequence, unnamed ones left out."""


def pooled_points(method: Method, bootstrap: Bootstrap | None = None) -> tuple[PooledPoint, ...]:
    """The curve of a method over its sequences, by rising rate.

    A setting at which one of the sequences wasn't measured, nothing was sent or nothing could be gained is left out;
    `left_out` says which and why.

    Args:
        method: measured points.
        bootstrap: how to draw sequences for the intervals; None for no intervals.
    """
    grid = grid_of(method, method.sequences)
    rates, qualities = grid.rates(grid.each_once)[0], grid.qualities(grid.each_once)[0]
    cells = {(point.sequence, point.setting): point.cell for point in method.points}
    points = []
    for column, setting in enumerate(grid.settings):
        possible = grid.possible[:, column]
        points.append(
            PooledPoint(
                setting,
                float(rates[column]),
                float(qualities[column]),
                ratio_interval(grid.kilobits[:, column], grid.seconds[:, column], bootstrap),
                ratio_interval(grid.gained[:, column], possible, bootstrap),
                len(grid.sequences),
                tuple(cell for name in grid.sequences if (cell := cells[name, setting])),
            )
        )
    return tuple(sorted(points, key=lambda point: (point.rate_kbps, point.quality, point.setting)))


def left_out(method: Method) -> tuple[str, ...]:
    """Why settings of a method are missing from `pooled_points`, one text for each."""
    return grid_of(method, method.sequences).left_out


def hull(points: Sequence[PooledPoint]) -> tuple[PooledPoint, ...]:
    """The points that no other beats, by rising rate: rate and quality then both rise strictly.

    A point is beaten by one of at most its rate and at least its quality; of equal points the first stays.
    """
    curve = RateQualityCurve(
        tuple(point.rate_kbps for point in points), tuple(point.quality for point in points)
    ).without_dominated()
    by_place = {(point.rate_kbps, point.quality): point for point in reversed(points)}
    return tuple(by_place[place] for place in zip(curve.rates, curve.qualities, strict=True))


def ratio_interval(above: Float64Array, below: Float64Array, bootstrap: Bootstrap | None) -> Interval | None:
    """Interval of a ratio of sums over sequences, each [S]; None without a bootstrap or enough sequences."""
    if bootstrap is None:
        return None
    return bootstrap_interval(
        len(above),
        lambda weights: drawn_ratios(above, below, weights),
        bootstrap,
        informative=int(np.count_nonzero(below)),
    )
