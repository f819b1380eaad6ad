"""Rates at one quality: what a method needs to reach it, and what it saves there against another.

The decadic logarithm of the rate is interpolated over the quality by shape-preserving cubics through the points that
nothing beats, as for BD-rate. Nothing is extrapolated: a quality that a curve doesn't reach has no rate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.bd_rate import RateQualityCurve, logarithms
from cable_rpc.study.metrics.bootstrap import Bootstrap, Interval
from cable_rpc.study.rate_quality.drawn_curves import DrawnCurves
from cable_rpc.study.rate_quality.points import Method
from cable_rpc.study.rate_quality.pooling import Float64Array, RateQualityGrid, grid_of
from cable_rpc.study.rate_quality.refusals import no_sequence_in_common, no_setting
from cable_rpc.study.rate_quality.resampling import Pair, Resampled, paired, resample


@dataclass(frozen=True, slots=True)
class FixedQuality:
    """What one method needs for one quality."""

    quality: float
    rate_kbps: float | None
    interval: Interval | None
    """Over sequences; None without a rate, a bootstrap, three sequences, or enough draws that reach the quality."""
    reason: str
    """Why there is no rate, and what to do; empty where there is one."""
    defined_draws: float = 0.0
    """Share of the draws in which the curve reaches the quality; 0 where none were drawn."""
    notes: tuple[str, ...] = ()
    """What was left out, and why there is no interval though one was asked for."""


@dataclass(frozen=True, slots=True)
class SavingAtQuality:
    """What a method saves of its anchor's rate at one quality."""

    quality: float
    saving: float | None
    """``1 - rate_test / rate_anchor``, at most 1; negative where the test needs more."""
    interval: Interval | None
    """Paired, over sequences; None as for `FixedQuality`."""
    anchor_kbps: float | None
    """Pooled over the sequences that both have; None where the curve doesn't reach the quality."""
    test_kbps: float | None
    """Likewise."""
    reason: str
    """Why there is no saving, and what to do; empty where there is one."""
    by_sequence: Mapping[str, float | None]
    """The saving on each sequence that both have at the same quality; None where either doesn't reach it."""
    defined_draws: float = 0.0
    """Share of the draws in which both reach the quality; 0 where none were drawn."""
    notes: tuple[str, ...] = ()
    """What was left out, and why there is no interval though one was asked for."""


def rate_at(method: Method, quality: float, bootstrap: Bootstrap | None) -> FixedQuality:
    """Rate that a method needs for a quality, pooled over its sequences.

    Args:
        method: measured points.
        quality: in the unit of the method's qualities.
        bootstrap: how to draw sequences; None for no interval.

    Raises:
        ConfigurationError: scipy is missing.
    """
    grid = grid_of(method, method.sequences)
    rate = rate_on_hull(grid.curve(), quality)
    resampled = Resampled()
    if not math.isnan(rate):
        judged = int(np.count_nonzero(grid.judged))
        resampled = resample((grid,), lambda drawn: 10.0 ** drawn[0].log_rates_at(quality), bootstrap, judged)
    return FixedQuality(
        quality=quality,
        rate_kbps=number_or_none(rate),
        interval=resampled.interval,
        reason=why_no_rate(method.label, grid, quality),
        defined_draws=resampled.defined_draws,
        notes=(*grid.left_out, *resampled.notes),
    )


def saving_at(anchor: Method, test: Method, quality: float, bootstrap: Bootstrap | None) -> SavingAtQuality:
    """Share of the anchor's rate that a method saves at a quality, on the sequences that both have.

    Args:
        anchor: what to compare with.
        test: what to judge.
        quality: in the unit of the methods' qualities.
        bootstrap: how to draw sequences; None for no interval.

    Raises:
        ConfigurationError: scipy is missing.
    """
    pair = paired(anchor, test)
    curves = pair.anchor.curve(), pair.test.curve()
    saving = saving_on_hulls(curves, quality)
    resampled = Resampled()
    if not math.isnan(saving):
        resampled = resample(
            (pair.anchor, pair.test), lambda drawn: drawn_savings(drawn, quality), bootstrap, len(pair.judged)
        )
    anchor_kbps, test_kbps = (rate_on_hull(curve, quality) for curve in curves)
    return SavingAtQuality(
        quality=quality,
        saving=number_or_none(saving),
        interval=resampled.interval,
        anchor_kbps=number_or_none(anchor_kbps),
        test_kbps=number_or_none(test_kbps),
        reason=why_no_saving(pair, anchor, test, quality),
        by_sequence={name: saving_of_sequence(anchor, test, name, quality) for name in pair.sequences},
        defined_draws=resampled.defined_draws,
        notes=(*pair.notes, *resampled.notes),
    )


def saving_of_sequence(anchor: Method, test: Method, name: str, quality: float) -> float | None:
    """The saving on one sequence; None where either method doesn't reach the quality there."""
    curves = tuple(grid_of(method.of_sequence(name), (name,)).curve() for method in (anchor, test))
    return number_or_none(saving_on_hulls(curves, quality))


def saving_on_hulls(curves: tuple[RateQualityCurve, ...], quality: float) -> float:
    """The saving of the second curve against the first; NaN where either doesn't reach the quality."""
    anchor, test = (rate_on_hull(curve, quality) for curve in curves)
    return 1.0 - test / anchor


def drawn_savings(drawn: tuple[DrawnCurves, ...], quality: float) -> Float64Array:
    """`saving_on_hulls` in every draw, float64 [D]."""
    anchor, test = drawn
    return 1.0 - 10.0 ** (test.log_rates_at(quality) - anchor.log_rates_at(quality))


def rate_on_hull(curve: RateQualityCurve, quality: float) -> float:
    """Rate of a curve at a quality; NaN outside of it, for fewer than two points that nothing beats, or for
    points of all but equal quality.

    Raises:
        ConfigurationError: scipy is missing.
    """
    kept = curve.without_dominated()
    if len(kept) < 2 or not kept.qualities[0] <= quality <= kept.qualities[-1]:
        return math.nan
    try:
        from scipy.interpolate import PchipInterpolator
    except ImportError as error:
        raise ConfigurationError("rates at one quality need scipy: pip install 'cable-rpc[study]'") from error
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            rate = float(10.0 ** PchipInterpolator(kept.qualities, logarithms(kept))(quality))
    except ValueError:  # scipy's word for slopes that overflow
        return math.nan
    return rate if math.isfinite(rate) else math.nan


def why_no_saving(pair: Pair, anchor: Method, test: Method, quality: float) -> str:
    """Why two methods can't be compared at a quality, and what to do; empty where they can."""
    if not pair.sequences:
        return no_sequence_in_common(anchor, test)
    sides = (anchor.label, pair.anchor), (test.label, pair.test)
    return "; ".join(reason for label, grid in sides if (reason := why_no_rate(label, grid, quality)))


def why_no_rate(label: str, grid: RateQualityGrid, quality: float) -> str:
    """Why a method has no rate at a quality, and what to do; empty where it has."""
    if not grid.settings:
        return no_setting(label, grid)
    kept = grid.curve().without_dominated()
    if len(kept) < 2:
        return f"'{label}' has {len(kept)} points that nothing beats, 2 are needed; code it at more CRFs"
    if quality > kept.qualities[-1]:
        return (
            f"quality {quality:.4g} lies above the best of '{label}', {kept.qualities[-1]:.4g} at "
            f"{kept.rates[-1]:.4g} kbit/s; code it at lower CRFs, or ask for less"
        )
    if quality < kept.qualities[0]:
        return (
            f"quality {quality:.4g} lies below the poorest of '{label}', {kept.qualities[0]:.4g} at "
            f"{kept.rates[0]:.4g} kbit/s; code it at higher CRFs, or ask for more"
        )
    if math.isnan(rate_on_hull(kept, quality)):
        return f"'{label}' has points of almost equal quality next to {quality:.4g}; code it at CRFs further apart"
    return ""


def number_or_none(value: float) -> float | None:
    """None for NaN."""
    return None if math.isnan(value) else value
