"""Bjontegaard deltas against the reference package, published data and cases with known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.bd_rate import (
    IncomparableCurvesError,
    RateQualityCurve,
    bd_quality,
    bd_rate,
)

pytest.importorskip("scipy", reason="needs scipy, in the study extra")

METHODS = ("pchip", "akima", "cubic")
ANCHOR = RateQualityCurve((120.0, 260.0, 490.0, 1010.0, 2100.0), (30.2, 33.1, 35.6, 38.4, 41.0))
TEST = RateQualityCurve((70.0, 150.0, 320.0, 700.0, 1600.0), (29.6, 32.9, 35.5, 38.6, 41.3))

rising_curves = st.lists(st.tuples(st.floats(0.08, 0.6), st.floats(1.0, 4.0)), min_size=5, max_size=9).map(
    lambda steps: RateQualityCurve(
        tuple(10.0 ** (2 + float(total)) for total in np.cumsum([step for step, _ in steps])),
        tuple(25 + float(total) for total in np.cumsum([step for _, step in steps])),
    )
)


def scaled(curve: RateQualityCurve, factor: float) -> RateQualityCurve:
    return RateQualityCurve(tuple(factor * rate for rate in curve.rates), curve.qualities)


def lifted(curve: RateQualityCurve, gain: float) -> RateQualityCurve:
    return RateQualityCurve(curve.rates, tuple(quality + gain for quality in curve.qualities))


@pytest.mark.parametrize("method", METHODS)
def test_half_the_rate_at_every_quality_is_minus_fifty_percent(method: str) -> None:
    delta = bd_rate(ANCHOR, scaled(ANCHOR, 0.5), method)
    assert delta.value == pytest.approx(-50.0, abs=1e-9)
    assert delta.overlap == 1.0
    assert (delta.low, delta.high) == (30.2, 41.0)
    assert bd_rate(scaled(ANCHOR, 0.5), ANCHOR, method).value == pytest.approx(100.0, abs=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_one_decibel_more_at_every_rate(method: str) -> None:
    assert bd_quality(ANCHOR, lifted(ANCHOR, 1.0), method).value == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_straight_curves_have_the_closed_form(method: str) -> None:
    # quality = slope * log10(rate) + offset: over q in [30, 40], log10 r = (q - offset) / slope.
    qualities = (30.0, 32.0, 35.0, 37.0, 40.0)
    anchor = RateQualityCurve(tuple(10 ** ((q - 10) / 10) for q in qualities), qualities)
    test = RateQualityCurve(tuple(10 ** ((q - 5) / 12.5) for q in qualities), qualities)
    mean_log_ratio = (35 - 5) / 12.5 - (35 - 10) / 10
    assert bd_rate(anchor, test, method).value == pytest.approx(100 * (10**mean_log_ratio - 1), abs=1e-8)


@pytest.mark.parametrize("method", METHODS)
def test_agrees_with_the_reference_package(method: str) -> None:
    reference = pytest.importorskip("bjontegaard", reason="needs the package bjontegaard")
    arguments = (ANCHOR.rates, ANCHOR.qualities, TEST.rates, TEST.qualities)
    expected_rate = reference.bd_rate(*arguments, method=method, min_overlap=0)
    expected_psnr = reference.bd_psnr(*arguments, method=method, min_overlap=0)
    assert bd_rate(ANCHOR, TEST, method).value == pytest.approx(expected_rate, abs=1e-6)
    assert bd_quality(ANCHOR, TEST, method).value == pytest.approx(expected_psnr, abs=1e-6)


@given(rising_curves, rising_curves, st.sampled_from(METHODS))
def test_agrees_with_the_reference_package_on_any_curves(
    anchor: RateQualityCurve, test: RateQualityCurve, method: str
) -> None:
    reference = pytest.importorskip("bjontegaard", reason="needs the package bjontegaard")
    expected = reference.bd_rate(
        anchor.rates, anchor.qualities, test.rates, test.qualities, method=method, min_overlap=0,
        require_matching_points=False,
    )  # fmt: skip
    try:
        found = bd_rate(anchor, test, method)
    except IncomparableCurvesError:
        low = max(anchor.qualities[0], test.qualities[0])
        high = min(anchor.qualities[-1], test.qualities[-1])
        union = max(anchor.qualities[-1], test.qualities[-1]) - min(anchor.qualities[0], test.qualities[0])
        assert (high - low) / union < 0.5
        return
    assert math.log1p(found.value / 100) == pytest.approx(math.log1p(expected / 100), abs=1e-6)


@given(rising_curves, st.floats(0.1, 10.0), st.sampled_from(METHODS))
def test_a_factor_on_the_rates_is_found_again(curve: RateQualityCurve, factor: float, method: str) -> None:
    assert bd_rate(curve, scaled(curve, factor), method).value == pytest.approx(100 * (factor - 1), rel=1e-6, abs=1e-6)


@given(rising_curves, rising_curves, st.sampled_from(METHODS))
def test_swapping_anchor_and_test_inverts_the_ratio(
    anchor: RateQualityCurve, test: RateQualityCurve, method: str
) -> None:
    there = bd_rate(anchor, test, method, min_overlap=0.0) if overlapping(anchor, test) else None
    if there is not None:
        back = bd_rate(test, anchor, method, min_overlap=0.0)
        assert math.log1p(there.value / 100) == pytest.approx(-math.log1p(back.value / 100), abs=1e-9)
        assert there.overlap == back.overlap


def overlapping(anchor: RateQualityCurve, test: RateQualityCurve) -> bool:
    low = max(anchor.qualities[0], test.qualities[0])
    return low + 1e-3 < min(anchor.qualities[-1], test.qualities[-1])


@given(st.lists(st.tuples(st.floats(1, 1e6), st.floats(0, 60)), min_size=1, max_size=12))
def test_hull_keeps_exactly_the_points_that_nothing_beats(points: list[tuple[float, float]]) -> None:
    rates, qualities = zip(*points, strict=True)
    hull = RateQualityCurve(rates, qualities).without_dominated()
    unbeaten = {
        (rate, quality)
        for rate, quality in points
        if not any(r <= rate and q >= quality and (r, q) != (rate, quality) for r, q in points)
    }
    assert set(zip(hull.rates, hull.qualities, strict=True)) == unbeaten
    assert list(hull.rates) == sorted(hull.rates)
    assert list(hull.qualities) == sorted(hull.qualities)


def test_order_of_the_points_and_beaten_ones_change_nothing() -> None:
    muddled = RateQualityCurve((*TEST.rates[::-1], 400.0, 2000.0), (*TEST.qualities[::-1], 33.0, 40.0))
    delta = bd_rate(ANCHOR, muddled)
    assert delta.value == bd_rate(ANCHOR, TEST).value
    assert (delta.anchor_dropped, delta.test_dropped) == (0, 2)


def test_too_few_points_are_refused() -> None:
    short = RateQualityCurve(TEST.rates[:4], TEST.qualities[:4])
    with pytest.raises(IncomparableCurvesError, match="the test curve has 4 points, 5 are needed"):
        bd_rate(ANCHOR, short)
    with pytest.raises(IncomparableCurvesError, match="the anchor has 4 points, 5 are needed"):
        bd_quality(short, TEST)
    beaten = RateQualityCurve(TEST.rates, (*TEST.qualities[:2], *([30.0] * (len(TEST) - 2))))
    with pytest.raises(IncomparableCurvesError, match="2 points once 3 beaten by others are dropped, 3 are needed"):
        bd_rate(ANCHOR, beaten)


def test_too_little_overlap_is_refused() -> None:
    with pytest.raises(IncomparableCurvesError, match=r"share 29 % of their quality range .*30\.2 to 41.* 50 %"):
        bd_rate(ANCHOR, lifted(ANCHOR, 6.0))
    assert bd_rate(ANCHOR, lifted(ANCHOR, 6.0), min_overlap=0.25).overlap == pytest.approx(4.8 / 16.8)
    with pytest.raises(IncomparableCurvesError, match="share 0 %"):
        bd_rate(ANCHOR, lifted(ANCHOR, 20.0), min_overlap=0.0)
    with pytest.raises(IncomparableCurvesError, match="log rate range"):
        bd_quality(ANCHOR, scaled(ANCHOR, 0.25))


@pytest.mark.parametrize("point", [(0.0, 30.0), (-1.0, 30.0), (math.inf, 30.0), (5.0, math.inf), (5.0, math.nan)])
def test_impossible_points_are_refused(point: tuple[float, float]) -> None:
    with pytest.raises(ConfigurationError, match="rates must be above 0 and both finite"):
        RateQualityCurve((1.0, point[0]), (30.0, point[1]))


def test_misuse_is_told() -> None:
    with pytest.raises(ConfigurationError, match="3 rates and 2 qualities"):
        RateQualityCurve((1.0, 2.0, 3.0), (30.0, 31.0))
    with pytest.raises(ConfigurationError, match="use one of pchip, akima, cubic"):
        bd_rate(ANCHOR, TEST, "linear")
