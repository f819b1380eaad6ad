"""Summaries of plain samples in which a missing value is None."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Median and tails of a sample, in the sample's unit."""

    p50: float
    p95: float
    p99: float


def percentiles(values: Iterable[float | None]) -> Percentiles | None:
    """p50, p95 and p99 with linear interpolation, None values left out; None for an empty sample."""
    sample = [value for value in values if value is not None]
    if not sample:
        return None
    p50, p95, p99 = np.percentile(np.asarray(sample, np.float64), (50.0, 95.0, 99.0))
    return Percentiles(float(p50), float(p95), float(p99))


def mean_or_none(values: Iterable[float | None]) -> float | None:
    """Mean of the values that are finite numbers; None where there is none."""
    sample = [float(value) for value in values if value is not None and np.isfinite(value)]
    return sum(sample) / len(sample) if sample else None
