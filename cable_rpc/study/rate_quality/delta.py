"""Bjontegaard's deltas between two methods, with paired intervals over sequences.

The curves are pooled over the sequences that both methods have, and compared by `cable_rpc.study.bd_rate`; each
bootstrap draw of whole sequences pools and compares them anew. What may be published is ruled for the measured curves:
enough points, enough overlap. A draw needs no more than the arithmetic does, four points and any shared range, since
draws turned away for a small overlap would be those in which the methods differ most.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.bd_rate import (
    MIN_OVERLAP,
    MIN_POINTS,
    MIN_UNDOMINATED,
    BjontegaardDelta,
    IncomparableCurvesError,
    Interpolation,
    RateQualityCurve,
    bd_quality,
    bd_rate,
)
from cable_rpc.study.metrics.bootstrap import Bootstrap, Interval
from cable_rpc.study.rate_quality.drawn_curves import DrawnCurves
from cable_rpc.study.rate_quality.points import Method
from cable_rpc.study.rate_quality.pooling import Float64Array, grid_of
from cable_rpc.study.rate_quality.refusals import how_to_compare, no_sequence_in_common, no_setting
from cable_rpc.study.rate_quality.resampling import Pair, Resampled, paired, resample

MIN_POINTS_OF_A_DRAW = 4
"""As many as Bjontegaard's own document has."""
TOO_STEEP = "points of almost equal quality or rate leave the interpolation undefined; code at CRFs further apart"


@dataclass(frozen=True, slots=True)
class DeltaResult:
    """The mean distance of a method from its anchor, or why there is none."""

    value: float | None
    """Percent of rate (negative: the test needs less), or quality in its own unit (positive: the test is better)."""
    interval: Interval | None
    """Paired, over sequences; None without a value, a bootstrap, three sequences, or enough draws that have it."""
    overlap: float | None
    """Range that the curves share, of the range they span together, 0..1; None without a value."""
    dropped_anchor: int
    """Points of the anchor that others of it beat."""
    dropped_test: int
    """The same for the test method."""
    reason: str
    """Why there is no value, and what to do; empty where there is one."""
    by_sequence: Mapping[str, float | None]
    """The same figure of each sequence that both have, by the same rules; None where it can't be told."""
    mean_of_sequences: float | None
    """Their mean; None unless each sequence with anything to gain has one."""
    method: Interpolation
    defined_draws: float
    """Share of the draws in which the figure was defined; 0 where none were drawn."""
    notes: tuple[str, ...] = ()
    """What was left out, and why there is no interval though one was asked for."""


class Delta(Protocol):
    """`bd_rate` or `bd_quality`."""

    def __call__(
        self,
        anchor: RateQualityCurve,
        test: RateQualityCurve,
        method: Interpolation = ...,
        *,
        min_overlap: float = ...,
        min_points: int = ...,
    ) -> BjontegaardDelta:
        """The mean difference."""
        ...


@dataclass(frozen=True, slots=True)
class DeltaRules:
    """How two curves are compared, and when they may be.

    Raises:
        ConfigurationError: a value is outside its range.
    """

    delta: Delta
    interpolation: Interpolation
    min_overlap: float
    min_points: int

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_overlap <= 1.0 or self.min_points < 2:
            raise ConfigurationError(
                f"min_overlap is {self.min_overlap} and min_points {self.min_points}; give a share from 0 to 1, and at "
                "least 2"
            )

    def compare(self, anchor: RateQualityCurve, test: RateQualityCurve) -> BjontegaardDelta:
        """The mean difference of two measured curves.

        Raises:
            IncomparableCurvesError: they break a rule, or are so steep that the interpolation overflows.
        """
        try:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                found = self.delta(
                    anchor, test, self.interpolation, min_overlap=self.min_overlap, min_points=self.min_points
                )
        except (OverflowError, ValueError):  # the latter is scipy's word for slopes that overflow
            raise IncomparableCurvesError(TOO_STEEP) from None
        if not math.isfinite(found.value):
            raise IncomparableCurvesError(TOO_STEEP)
        return found

    def of_draw(self) -> DeltaRules:
        """The looser rules within a draw."""
        return DeltaRules(self.delta, self.interpolation, 0.0, min(self.min_points, MIN_POINTS_OF_A_DRAW))

    def value(self, curves: tuple[RateQualityCurve, ...]) -> float:
        """The mean difference of (anchor, test), NaN where there is none."""
        try:
            return self.compare(*curves).value
        except IncomparableCurvesError:
            return math.nan

    def values(self, drawn: tuple[DrawnCurves, ...]) -> Float64Array:
        """The mean difference of (anchor, test) in every draw, float64 [D], NaN where there is none."""
        if self.interpolation != "pchip":
            return np.array([self.value(curves) for curves in zip(*(one.curves() for one in drawn), strict=True)])
        at_equal_rate = self.delta is bd_quality
        anchor, test = drawn
        (anchor_low, anchor_high, anchor_left), (test_low, test_high, test_left) = (
            one.ends(of_rates=at_equal_rate) for one in drawn
        )
        low, high = np.maximum(anchor_low, test_low), np.minimum(anchor_high, test_high)
        with np.errstate(all="ignore"):
            differences = (
                test.areas(low, high, of_rates=at_equal_rate) - anchor.areas(low, high, of_rates=at_equal_rate)
            ) / (high - low)
            found = differences if at_equal_rate else 100.0 * (10.0**differences - 1.0)
        measured = np.minimum(*(one.measured.sum(axis=1) for one in drawn))
        left = np.minimum(anchor_left, test_left)
        comparable = (high > low) & (measured >= self.min_points) & (left >= min(MIN_UNDOMINATED, self.min_points))
        return np.where(comparable & np.isfinite(found), found, np.nan)


def bd_rate_between(
    anchor: Method,
    test: Method,
    bootstrap: Bootstrap | None,
    *,
    interpolation: Interpolation = "pchip",
    min_overlap: float = MIN_OVERLAP,
    min_points: int = MIN_POINTS,
) -> DeltaResult:
    """Mean difference in rate at equal quality, in percent of the anchor's rate.

    Args:
        anchor: what to compare with.
        test: what to judge.
        bootstrap: how to draw sequences; None for no interval.
        interpolation: between the points of a curve.
        min_overlap: share of the spanned qualities that the curves must have in common, 0..1.
        min_points: points that each curve needs, at least 2.

    Raises:
        ConfigurationError: an option is unusable, or scipy is missing.
    """
    return delta_between(anchor, test, bootstrap, DeltaRules(bd_rate, interpolation, min_overlap, min_points))


def bd_quality_between(
    anchor: Method,
    test: Method,
    bootstrap: Bootstrap | None,
    *,
    interpolation: Interpolation = "pchip",
    min_overlap: float = MIN_OVERLAP,
    min_points: int = MIN_POINTS,
) -> DeltaResult:
    """Mean difference in quality at equal rate, in the quality's own unit.

    Args:
        anchor: what to compare with.
        test: what to judge.
        bootstrap: how to draw sequences; None for no interval.
        interpolation: between the points of a curve.
        min_overlap: share of the spanned log rates that the curves must have in common, 0..1.
        min_points: points that each curve needs, at least 2.

    Raises:
        ConfigurationError: an option is unusable, or scipy is missing.
    """
    return delta_between(anchor, test, bootstrap, DeltaRules(bd_quality, interpolation, min_overlap, min_points))


def delta_between(anchor: Method, test: Method, bootstrap: Bootstrap | None, rules: DeltaRules) -> DeltaResult:
    """A delta of two methods with all that it rests on."""
    pair = paired(anchor, test)
    by_sequence = {name: delta_of_sequence(anchor, test, name, rules) for name in pair.sequences}
    judged = [by_sequence[name] for name in pair.judged]
    numbers = [value for value in judged if value is not None]
    mean = sum(numbers) / len(numbers) if numbers and len(numbers) == len(judged) else None
    anchor_curve, test_curve = pair.anchor.curve(), pair.test.curve()
    try:
        found = rules.compare(anchor_curve, test_curve)
    except IncomparableCurvesError as error:
        found, reason = None, refusal(pair, anchor, test, rules, error)
        resampled = Resampled()
    else:
        reason = ""
        resampled = resample((pair.anchor, pair.test), rules.of_draw().values, bootstrap, len(pair.judged))
    return DeltaResult(
        value=None if found is None else found.value,
        interval=resampled.interval,
        overlap=None if found is None else found.overlap,
        dropped_anchor=len(anchor_curve) - len(anchor_curve.without_dominated()),
        dropped_test=len(test_curve) - len(test_curve.without_dominated()),
        reason=reason,
        by_sequence=by_sequence,
        mean_of_sequences=mean,
        method=rules.interpolation,
        defined_draws=resampled.defined_draws,
        notes=(*pair.notes, *resampled.notes),
    )


def delta_of_sequence(anchor: Method, test: Method, name: str, rules: DeltaRules) -> float | None:
    """The delta on one sequence, at all the settings that either method has there; None where it can't be told."""
    curves = tuple(grid_of(method.of_sequence(name), (name,)).curve() for method in (anchor, test))
    value = rules.value(curves)
    return None if math.isnan(value) else value


def refusal(pair: Pair, anchor: Method, test: Method, rules: DeltaRules, error: IncomparableCurvesError) -> str:
    """Why two methods can't be compared, and what to do."""
    if not pair.sequences:
        return no_sequence_in_common(anchor, test)
    sides = (anchor.label, pair.anchor), (test.label, pair.test)
    if not all(grid.settings for _, grid in sides):
        return "; ".join(no_setting(label, grid) for label, grid in sides if not grid.settings)
    advice = how_to_compare(
        (anchor.label, pair.anchor.curve()),
        (test.label, pair.test.curve()),
        rules.min_points,
        at_equal_rate=rules.delta is bd_quality,
    )
    return f"{error}: {advice}"
