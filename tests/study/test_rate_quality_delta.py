"""Paired Bjontegaard deltas against closed forms, the reference package and a slow literal bootstrap."""

from __future__ import annotations

import math
import random
import warnings
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import Bootstrap
from cable_rpc.study.metrics.bootstrap import cluster_draws
from cable_rpc.study.rate_quality import Method, SequencePoint, bd_quality_between, bd_rate_between

pytest.importorskip("scipy", reason="needs scipy, in the study extra")

QUALITIES = (24.0, 27.0, 30.0, 33.0, 36.0, 39.0)
BOOTSTRAP = Bootstrap(60)


def doubling(label: str, scales: Sequence[float], qualities: Sequence[float] = QUALITIES, frames: int = 10) -> Method:
    """Sequences whose rate doubles every six decibels, ``scale * 2^(q / 6)`` kB in one second each."""
    return Method(
        label,
        tuple(
            SequencePoint(f"s{row:02}", f"q {quality:g}", round(1e6 * scale * 2 ** (quality / 6)), 1.0,
                          quality * frames, frames)
            for row, scale in enumerate(scales)
            for quality in qualities
        ),
    )  # fmt: skip


def detected(label: str, rates: np.ndarray, shares: np.ndarray, objects: Sequence[int]) -> Method:
    """Sequences by settings: kilobytes of 8 seconds, and shares of the objects found."""
    return Method(
        label,
        tuple(
            SequencePoint(f"s{row:02}", f"crf {20 + 4 * column}", round(1000 * rates[row, column]), 8.0,
                          round(shares[row, column] * objects[row]), objects[row], f"{label}/{row}/{column}")
            for row in range(rates.shape[0])
            for column in range(rates.shape[1])
        ),
    )  # fmt: skip


def noisy_pair(seed: int, sequences: int = 5) -> tuple[Method, Method]:
    """Two methods on sequences of very different level, with curves that aren't quite monotone."""
    drawn = np.random.default_rng(seed)
    level = drawn.uniform(0.5, 1.5, (sequences, 1))
    objects = drawn.integers(200, 900, sequences).tolist()
    steps = np.arange(7)
    base = level * 2.0 ** (-steps / 2) * 100
    shares = np.clip((0.95 - 0.1 * level) * (1 - 0.004 * steps**2) + 0.01 * drawn.standard_normal((sequences, 7)), 0, 1)
    saved = base * (0.6 + 0.1 * drawn.standard_normal((sequences, 1)))
    return detected("anchor", base, shares, objects), detected("test", saved, shares - 0.01, objects)


@pytest.mark.parametrize("factor", [0.4, 1.0, 1.7])
@pytest.mark.parametrize("interpolation", ["pchip", "akima", "cubic"])
def test_a_factor_on_all_rates_is_found_with_an_interval_of_no_width(factor: float, interpolation: str) -> None:
    scales = (1.0, 2.5, 0.3, 6.0)
    anchor, test = doubling("full", scales), doubling("roi", [factor * scale for scale in scales])
    found = bd_rate_between(anchor, test, BOOTSTRAP, interpolation=interpolation)  # type: ignore[arg-type]
    assert found.value == pytest.approx(100 * (factor - 1), abs=1e-4)
    assert found.interval is not None
    assert (found.interval.low, found.interval.high) == pytest.approx((found.value, found.value), abs=1e-4)
    assert dict(found.by_sequence) == pytest.approx({f"s{row:02}": 100 * (factor - 1) for row in range(4)}, abs=1e-4)
    assert found.mean_of_sequences == pytest.approx(100 * (factor - 1), abs=1e-4)
    assert (found.overlap, found.defined_draws, found.reason, found.notes) == (1.0, 1.0, "", ())
    assert (found.dropped_anchor, found.dropped_test, found.method) == (0, 0, interpolation)


def test_equal_qualities_pool_to_the_ratio_of_the_bytes() -> None:
    """Where sequences differ in their factor, the pooled figure is that of all bytes, not the mean of the factors."""
    scales, factors = (1.0, 5.0, 2.0), (0.9, 0.5, 0.2)
    test = doubling("roi", [scale * factor for scale, factor in zip(scales, factors, strict=True)])
    found = bd_rate_between(doubling("full", scales), test, None)
    assert found.value == pytest.approx(100 * ((0.9 + 2.5 + 0.4) / 8 - 1), abs=1e-4)
    assert found.mean_of_sequences == pytest.approx(100 * (1.6 / 3 - 1), abs=1e-4)
    assert (found.interval, found.defined_draws) == (None, 0.0)


def test_quality_at_equal_rate_has_its_closed_form() -> None:
    # A rate factor f on curves that gain six decibels per doubling is worth -6 * log2(f) decibels.
    found = bd_quality_between(doubling("full", (1, 2, 3)), doubling("roi", (0.8, 1.6, 2.4)), BOOTSTRAP)
    assert found.value == pytest.approx(-6 * math.log2(0.8), abs=1e-4)
    assert found.overlap == pytest.approx((15 / 6 + math.log2(0.8)) / (15 / 6 - math.log2(0.8)), abs=1e-4)


def unbeaten(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    return sorted({one for one in points if not any(r <= one[0] and q >= one[1] and (r, q) != one for r, q in points)})


def drawn_curve(method: Method, drawn: list[str]) -> list[tuple[float, float]]:
    """The hull of a method over sequences drawn with replacement, one sum after the other."""
    points = []
    for setting in method.settings:
        size = time = gained = possible = 0.0
        for name in drawn:
            (point,) = (one for one in method.points if (one.sequence, one.setting) == (name, setting))
            size, time = size + 8 * point.bytes_up / 1000, time + point.seconds
            gained, possible = gained + point.gained, possible + point.possible
        points.append((size / time, gained / possible))
    return unbeaten(points)


@pytest.mark.parametrize("kind", ["rate", "psnr"])
def test_interval_is_that_of_a_literal_bootstrap_by_the_reference_package(kind: str) -> None:
    reference = pytest.importorskip("bjontegaard", reason="needs the package bjontegaard")
    anchor, test = noisy_pair(3)
    bootstrap = Bootstrap(40, level=0.9, seed=5)
    sample = []
    for counts in [*cluster_draws(5, bootstrap).tolist(), [1] * 5]:
        drawn = [name for name, count in zip(anchor.sequences, counts, strict=True) for _ in range(count)]
        curves = [drawn_curve(method, drawn) for method in (anchor, test)]
        lists = [[point[axis] for point in curve] for curve in curves for axis in (0, 1)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sample.append(
                getattr(reference, f"bd_{kind}")(*lists, method="pchip", min_overlap=0, require_matching_points=False)
            )
    *draws, expected = sample
    compare = bd_rate_between if kind == "rate" else bd_quality_between
    found = compare(anchor, test, bootstrap)
    assert found.value == pytest.approx(expected, rel=1e-6)
    assert found.interval is not None
    low, high = np.percentile(draws, (5, 95))
    assert (found.interval.low, found.interval.high) == pytest.approx((low, high), rel=1e-6)
    assert found.defined_draws == 1.0


def test_pairing_takes_the_level_of_the_sequences_out() -> None:
    """The same rates drawn apart spread by tens of percent, the paired figure by little."""
    drawn = np.random.default_rng(1)
    scales = drawn.lognormal(0, 1, 10)
    factors = 0.7 * (1 + 0.02 * drawn.standard_normal(10))
    found = bd_rate_between(doubling("full", scales), doubling("roi", scales * factors), Bootstrap(200))
    weights, others = (cluster_draws(10, Bootstrap(200, seed=seed)) for seed in (1, 2))
    apart = 100 * ((weights @ (scales * factors)) / (others @ scales) - 1)
    unpaired = np.quantile(apart, (0.025, 0.975))
    assert found.interval is not None
    assert 10 * (found.interval.high - found.interval.low) < unpaired[1] - unpaired[0]
    assert found.interval.low < found.value < found.interval.high  # type: ignore[operator]


def test_interval_holds_the_truth_about_as_often_as_it_says() -> None:
    """Mean factor 0.6 that varies over sequences; the percentile interval of twelve is known to be somewhat narrow."""
    drawn = np.random.default_rng(11)
    hits = 0
    for run in range(80):
        scales = drawn.lognormal(0, 0.3, 12)
        factors = 0.6 * (1 + 0.15 * drawn.standard_normal(12))
        found = bd_rate_between(doubling("full", scales), doubling("roi", scales * factors), Bootstrap(50, seed=run))
        assert found.interval is not None
        hits += found.interval.low <= -40 <= found.interval.high
    # 0.9 +- 3 standard errors of 80 runs.
    assert 0.8 <= hits / 80 <= 0.99


@given(st.integers(0, 10_000), st.randoms(use_true_random=False))
@settings(max_examples=15, deadline=None)
def test_order_of_the_points_changes_nothing(seed: int, shuffler: random.Random) -> None:
    anchor, test = noisy_pair(seed)
    muddled = []
    for method in (anchor, test):
        points = list(method.points)
        shuffler.shuffle(points)
        muddled.append(Method(method.label, tuple(points)))
    assert bd_rate_between(*muddled, Bootstrap(10)) == bd_rate_between(anchor, test, Bootstrap(10))


@given(st.integers(0, 10_000), st.integers(2, 1000))
@settings(max_examples=15, deadline=None)
def test_a_unit_of_bytes_changes_nothing(seed: int, unit: int) -> None:
    anchor, test = noisy_pair(seed, 3)
    other = [
        Method(method.label, tuple(SequencePoint(p.sequence, p.setting, unit * p.bytes_up, p.seconds, p.gained,
                                                 p.possible) for p in method.points))
        for method in (anchor, test)
    ]  # fmt: skip
    one, more = bd_rate_between(anchor, test, Bootstrap(10)), bd_rate_between(*other, Bootstrap(10))
    assert (one.value is None) == (more.value is None)
    if one.value is not None:
        assert more.value == pytest.approx(one.value, rel=1e-9)
        assert more.overlap == one.overlap


@given(
    st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 6), st.integers(0, 10**9), st.floats(0, 100), st.integers(0, 3)),
        max_size=40,
        unique_by=lambda row: row[:2],
    ),
    st.sampled_from(["pchip", "akima"]),
)
@settings(max_examples=60, deadline=None)
def test_any_measurements_give_a_figure_or_a_reason(rows: list[tuple], interpolation: str) -> None:  # type: ignore[type-arg]
    method = Method("wild", tuple(SequencePoint(f"s{s}", f"crf {k}", b, 2.0, g, p) for s, k, b, g, p in rows))
    for compare in (bd_rate_between, bd_quality_between):
        found = compare(
            doubling("full", (1, 2, 3, 4)),
            method,
            Bootstrap(5),
            interpolation=interpolation,
            min_overlap=0.0,
            min_points=2,
        )  # type: ignore[operator]
        assert (found.value is None) == bool(found.reason) == (found.overlap is None)
        if found.value is None:
            assert "measure" in found.reason or "code" in found.reason or "choose" in found.reason
            assert found.interval is None
        else:
            assert math.isfinite(found.value)


def test_only_sequences_of_both_are_compared() -> None:
    anchor, test = doubling("full", (1, 2, 3, 4)), doubling("roi", (0.5, 1, 1.5, 2, 9))
    shorter = Method("roi", tuple(point for point in test.points if point.sequence != "s00"))
    found = bd_rate_between(anchor, shorter, BOOTSTRAP)
    assert found.value == pytest.approx(-50, abs=1e-4)
    assert list(found.by_sequence) == ["s01", "s02", "s03"]
    assert found.interval is not None
    assert found.notes == (
        "only 'full' was measured on s00, left out; measure the other there too",
        "only 'roi' was measured on s04, left out; measure the other there too",
    )


def test_a_setting_that_one_sequence_lacks_takes_no_part_in_the_pool() -> None:
    anchor, test = doubling("full", (1, 2, 3)), doubling("roi", (0.5, 1, 1.5), (21.0, *QUALITIES))
    holed = Method("roi", tuple(p for p in test.points if (p.sequence, p.setting) != ("s01", "q 21")))
    found = bd_rate_between(anchor, holed, None)
    assert found.overlap == 1.0
    assert found.notes == ("'roi' at 'q 21' is left out: it wasn't measured on s01; measure it there too",)
    assert set(found.by_sequence) == {"s00", "s01", "s02"}


def test_two_sequences_give_a_value_without_an_interval() -> None:
    found = bd_rate_between(doubling("full", (1, 2)), doubling("roi", (0.5, 1)), BOOTSTRAP)
    assert (found.interval, found.defined_draws) == (None, 0.0)
    assert dict(found.by_sequence) == pytest.approx({"s00": -50, "s01": -50}, abs=1e-4)
    assert found.notes == ("no interval: 2 sequences bear on it, 3 are needed; measure more",)


def test_a_sequence_without_objects_costs_bytes_but_has_no_figure_of_its_own() -> None:
    anchor, test = doubling("full", (1, 1, 1)), doubling("roi", (0.5, 0.5, 0.5))
    empty = [SequencePoint("s99", f"q {q:g}", round(1e6 * 2 ** (q / 6)), 1.0, 0, 0) for q in QUALITIES]
    found = bd_rate_between(
        Method("full", (*anchor.points, *empty)), Method("roi", (*test.points, *empty)), Bootstrap(20)
    )
    assert found.value == pytest.approx(100 * (2.5 / 4 - 1), abs=1e-4)
    assert found.by_sequence["s99"] is None
    assert found.mean_of_sequences == pytest.approx(-50, abs=1e-4)


def test_reasons_name_the_method_and_what_to_do() -> None:
    anchor = doubling("full", (1, 2, 3))
    few = bd_rate_between(anchor, doubling("roi", (1, 2, 3), QUALITIES[:4]), BOOTSTRAP)
    assert few.value is few.interval is few.overlap is None
    assert few.reason.startswith("the test curve has 4 points, 5 are needed")
    assert few.reason.endswith("code 'roi' at more CRFs, finer where the quality still rises")

    apart = bd_rate_between(anchor, doubling("roi", (1, 2, 3), [q + 9 for q in QUALITIES]), BOOTSTRAP)
    assert "share 25 % of their quality range" in apart.reason
    assert apart.reason.endswith("code 'full' at lower CRFs, towards 48 and 'roi' at higher CRFs, towards 24")
    slow = bd_quality_between(anchor, doubling("roi", (0.1, 0.2, 0.3)), BOOTSTRAP)
    assert "log rate range" in slow.reason
    top, bottom = 16 * 2**6.5 * 1e3, 1.6 * 2**4 * 1e3
    assert slow.reason.endswith(
        f"code 'roi' at lower CRFs, towards {top:.4g} kbit/s and 'full' at higher CRFs, towards {bottom:.4g} kbit/s"
    )

    flat = Method("flat", tuple(SequencePoint("s00", f"crf {k}", 100 * k, 1.0, 5, 9) for k in range(1, 8)))
    found = bd_rate_between(anchor, flat, BOOTSTRAP)
    assert "the test curve has 1 points once 6 beaten by others are dropped" in found.reason
    assert found.dropped_test == 6


def test_nothing_to_compare_is_told() -> None:
    anchor = doubling("full", (1, 2))
    elsewhere = Method("roi", (SequencePoint("x", "crf 1", 9, 1.0, 1, 2),))
    found = bd_rate_between(anchor, elsewhere, BOOTSTRAP)
    assert found.reason == "'full' (s00, s01) and 'roi' (x) share no sequence; measure both on the same ones"
    assert found.by_sequence == {}
    assert "(no sequence)" in bd_rate_between(anchor, Method("none", ()), None).reason
    blind = Method("blind", tuple(SequencePoint("s00", f"crf {k}", k, 1.0, 0, 0) for k in range(1, 8)))
    assert "no sequence has anything to find; choose sequences" in bd_rate_between(anchor, blind, None).reason


def test_too_few_defined_draws_give_no_interval() -> None:
    """Two of three sequences are so far apart that the curves meet only when the third is drawn."""

    def points(label: str, spans: Sequence[tuple[float, float]]) -> Method:
        return Method(label, tuple(
            SequencePoint(f"s{row}", f"step {step}", round(1000 * 2**step), 1.0, low + step * (high - low) / 7, 1.0)
            for row, (low, high) in enumerate(spans) for step in range(8)
        ))  # fmt: skip

    anchor = points("full", [(0, 1), (0, 1), (0, 9)])
    test = points("roi", [(2, 3), (2, 3), (0, 9)])
    found = bd_rate_between(anchor, test, Bootstrap(300), min_overlap=0.3)
    assert found.value is not None
    assert found.interval is None
    # The third isn't drawn with probability (2/3)^3.
    assert found.defined_draws == pytest.approx(1 - 8 / 27, abs=0.08)
    assert "of the draws have the figure, 90 % are needed; code at more or finer CRFs" in found.notes[-1]


def test_curves_too_steep_to_interpolate_are_told() -> None:
    steep = Method("steep", tuple(SequencePoint("s00", f"crf {k}", 8 + k, 1.0, k * 5e-324, 1.0) for k in range(6)))
    assert "code at CRFs further apart" in bd_rate_between(steep, steep, BOOTSTRAP).reason


def test_misuse_is_told() -> None:
    method = doubling("full", (1, 2))
    with pytest.raises(ConfigurationError, match="use one of pchip, akima, cubic"):
        bd_rate_between(method, method, None, interpolation="linear")  # type: ignore[arg-type]
    for options in ({"min_overlap": 1.5}, {"min_points": 1}):
        with pytest.raises(ConfigurationError, match="min_overlap is"):
            bd_rate_between(method, method, None, **options)  # type: ignore[arg-type]
