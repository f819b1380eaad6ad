"""Curves of all bootstrap draws at once: against scipy, curve by curve, and against each draw compared alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from cable_rpc.study.bd_rate import RateQualityCurve, bd_quality, bd_rate
from cable_rpc.study.rate_quality.delta import DeltaRules
from cable_rpc.study.rate_quality.drawn_curves import DrawnCurves
from cable_rpc.study.rate_quality.fixed_quality import drawn_savings, saving_on_hulls
from cable_rpc.study.rate_quality.pchip_rows import integrals, slopes, values


@settings(max_examples=80, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), knots=st.integers(2, 9), monotone=st.booleans())
def test_cubics_are_scipys(seed: int, knots: int, monotone: bool) -> None:
    random = np.random.default_rng(seed)
    x = np.cumsum(random.uniform(0.01, 3.0, (6, knots)), axis=1)
    y = random.normal(size=(6, knots)).round(1)
    y = np.cumsum(np.abs(y), axis=1) if monotone else y
    low, high = (x[:, 0] + share * (x[:, -1] - x[:, 0]) for share in np.sort(random.uniform(0, 1, 2)))
    at = float(np.median(x))
    found = slopes(x, y), integrals(x, y, low, high), values(x, y, at)
    for row in range(6):
        curve = PchipInterpolator(x[row], y[row], extrapolate=False)
        np.testing.assert_allclose(found[0][row], curve.derivative()(x[row]), rtol=1e-9, atol=1e-9)
        assert found[1][row] == pytest.approx(float(curve.integrate(low[row], high[row])), rel=1e-9, abs=1e-9)
        np.testing.assert_allclose(found[2][row], curve(at), rtol=1e-9, atol=1e-9)


def noisy(random: np.random.Generator, draws: int, points: int) -> DrawnCurves:
    """Curves with ties, beaten points, and now and then nothing to gain."""
    rates = np.sort(random.uniform(50, 900, (draws, points)).round(-1), axis=1)[:, random.permutation(points)]
    qualities = (60 + 0.04 * rates + random.normal(0, 4, rates.shape)).round(1)
    qualities[random.random(rates.shape) < 0.05] = np.nan
    return DrawnCurves(rates, qualities)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), at_equal_rate=st.booleans())
def test_every_draw_is_what_it_is_alone(seed: int, at_equal_rate: bool) -> None:
    random = np.random.default_rng(seed)
    drawn = noisy(random, 12, 7), noisy(random, 12, 6)
    rules = DeltaRules(bd_quality if at_equal_rate else bd_rate, "pchip", 0.0, 4)
    alone = [rules.value(curves) for curves in zip(*(one.curves() for one in drawn), strict=True)]
    np.testing.assert_allclose(rules.values(drawn), alone, rtol=1e-7, atol=1e-7)
    savings = [saving_on_hulls(curves, 80.0) for curves in zip(*(one.curves() for one in drawn), strict=True)]
    np.testing.assert_allclose(drawn_savings(drawn, 80.0), savings, rtol=1e-7, atol=1e-9)


def test_hulls_hold_the_points_that_nothing_beats() -> None:
    curve = RateQualityCurve((100.0, 200.0, 200.0, 300.0, 50.0), (10.0, 30.0, 20.0, 25.0, 10.0))
    drawn = DrawnCurves(np.array([curve.rates]), np.array([curve.qualities]))
    ((rows, log_rates, qualities),) = drawn.hulls()
    kept = curve.without_dominated()
    assert rows.tolist() == [0]
    assert log_rates[0].tolist() == pytest.approx([math.log10(rate) for rate in kept.rates])
    assert qualities[0].tolist() == list(kept.qualities)
