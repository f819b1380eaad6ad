"""Which points of several objectives are worth having: those that no other dominates.

A point dominates another if it is at least as good in every objective and better in one (Pareto; Deb, "Multi-Objective
Optimization using Evolutionary Algorithms", 2001, definition 2.5). Of equal points none dominates another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_rpc.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class ParetoPoint:
    """One operating point."""

    label: str
    costs: tuple[float, ...]
    """Of which less is better, e.g. kbit/s and p95 of the end-to-end latency in ms; the same kinds for all points."""
    quality: float
    """Of which more is better."""
    dominated: bool
    """Whether another point costs no more in any way, is at least as good, and better in something."""


def pareto_points(
    labels: Sequence[str], costs: Sequence[Sequence[float]], qualities: Sequence[float]
) -> tuple[ParetoPoint, ...]:
    """Operating points in the order given, each marked if another dominates it.

    Args:
        labels: names, [N].
        costs: [N, M], of which less is better.
        qualities: [N], of which more is better.

    Raises:
        ConfigurationError: the lists don't fit together, or a value isn't a number.
    """
    if not len(labels) == len(costs) == len(qualities):
        raise ConfigurationError(
            f"there are {len(labels)} labels, {len(costs)} costs, {len(qualities)} qualities; give one for each point"
        )
    kinds = {len(row) for row in costs}
    if len(kinds) > 1:
        raise ConfigurationError(f"points have {sorted(kinds)} costs; give the same kinds for all")
    rows = [(*row, quality) for row, quality in zip(costs, qualities, strict=True)]
    maximise = (False,) * next(iter(kinds), 0) + (True,)
    undominated = pareto_front(np.array(rows, np.float64).reshape(len(rows), len(maximise)), maximise)
    return tuple(
        ParetoPoint(label, tuple(row), quality, not kept)
        for label, row, quality, kept in zip(labels, costs, qualities, undominated.tolist(), strict=True)
    )


def pareto_front(values: npt.ArrayLike, maximise: Sequence[bool]) -> npt.NDArray[np.bool_]:
    """Which points no other dominates.

    Args:
        values: [N, M], points by objectives; infinities are compared as they are.
        maximise: [M], True where more is better.

    Returns:
        bool [N]; equal points share their fate.

    Raises:
        ConfigurationError: the shape doesn't fit, or a value isn't a number.
    """
    points = np.asarray(values, np.float64)
    if points.ndim != 2 or points.shape[1] != len(maximise):
        raise ConfigurationError(
            f"points of {len(maximise)} objectives need the shape [N, {len(maximise)}], got {points.shape}"
        )
    if np.isnan(points).any():
        row, column = np.argwhere(np.isnan(points))[0].tolist()
        raise ConfigurationError(
            f"point {row} has no number for objective {column}; leave points out that weren't measured in all of them"
        )
    costs = np.where(np.asarray(maximise, np.bool_), -points, points)
    undominated = np.ones(len(costs), np.bool_)
    for index, own in enumerate(costs):
        undominated[index] = not ((costs <= own).all(axis=1) & (costs < own).any(axis=1)).any()
    return undominated
