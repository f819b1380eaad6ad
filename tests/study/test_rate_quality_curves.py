"""Pooled curves, rates at one quality and Pareto fronts against closed forms and literal definitions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import Bootstrap
from cable_rpc.study.metrics.bootstrap import cluster_draws
from cable_rpc.study.rate_quality import (
    Method,
    SequencePoint,
    hull,
    left_out,
    pareto_front,
    pareto_points,
    pooled_points,
    rate_at,
    saving_at,
)

pytest.importorskip("scipy", reason="needs scipy, in the study extra")

QUALITIES = (20.0, 26.0, 32.0, 38.0)


def doubling(label: str, scales: Sequence[float]) -> Method:
    """Sequences of one second whose rate doubles every six units of quality."""
    return Method(
        label,
        tuple(
            SequencePoint(f"s{row}", f"q {quality:g}", round(1e6 * scale * 2 ** (quality / 6)), 1.0, quality, 1.0)
            for row, scale in enumerate(scales)
            for quality in QUALITIES
        ),
    )


def kbps(scale: float, quality: float) -> float:
    """Closed form of a sequence of `doubling`."""
    return 8000 * scale * 2 ** (quality / 6)


TWO_LENGTHS = Method(
    "two",
    (
        SequencePoint("long", "crf 30", 3000, 6.0, 8, 10, "b"),
        SequencePoint("long", "crf 20", 9000, 6.0, 9, 10, "d"),
        SequencePoint("short", "crf 20", 5000, 2.0, 1, 2, "c"),
        SequencePoint("short", "crf 30", 1000, 2.0, 1, 2),
        SequencePoint("short", "crf 40", 500, 2.0, 0, 2),
    ),
)


def test_a_point_knows_its_rate_and_quality() -> None:
    point = TWO_LENGTHS.points[0]
    assert (point.rate_kbps, point.quality) == (4.0, 0.8)
    assert SequencePoint("s", "crf 20", 10, 1.0, 0.0, 0.0).quality is None
    assert TWO_LENGTHS.sequences == ("long", "short")
    assert TWO_LENGTHS.settings == ("crf 20", "crf 30", "crf 40")
    assert TWO_LENGTHS.of_sequence("long") == Method("two", TWO_LENGTHS.points[:2])


def test_sequences_pool_by_their_seconds_and_by_what_is_possible() -> None:
    cheap, dear = pooled_points(TWO_LENGTHS)
    assert (cheap.setting, cheap.rate_kbps, cheap.quality, cheap.cells) == ("crf 30", 4.0, 9 / 12, ("b",))
    assert (dear.setting, dear.rate_kbps, dear.quality, dear.cells) == ("crf 20", 14.0, 10 / 12, ("d", "c"))
    assert (dear.sequences, dear.rate_interval, dear.quality_interval) == (2, None, None)
    assert left_out(TWO_LENGTHS) == ("'two' at 'crf 40' is left out: it wasn't measured on long; measure it there too",)


def test_settings_without_bytes_or_truth_are_left_out() -> None:
    method = Method("odd", (SequencePoint("s", "none", 0, 1.0, 1, 2), SequencePoint("s", "crf 1", 8, 1.0, 0, 0)))
    assert pooled_points(method) == ()
    blind, silent = left_out(method)
    assert "no sequence has anything to find" in blind
    assert "nothing was sent" in silent


def test_intervals_of_a_point_are_those_of_the_drawn_sums() -> None:
    drawn = np.random.default_rng(4)
    size, time = drawn.integers(1000, 9000, 6), drawn.uniform(5, 20, 6)
    found, objects = drawn.integers(0, 20, 6), np.array([20, 25, 30, 0, 40, 20])
    found[3] = 0
    method = Method(
        "m",
        tuple(
            SequencePoint(f"s{row}", "crf 20", int(size[row]), float(time[row]), int(found[row]), int(objects[row]))
            for row in range(6)
        ),
    )
    bootstrap = Bootstrap(100, level=0.8, seed=2)
    (point,) = pooled_points(method, bootstrap)
    rates, shares = [], []
    for counts in cluster_draws(6, bootstrap).tolist():
        rows = [row for row, count in enumerate(counts) for _ in range(count)]
        rates.append(8 * sum(int(size[row]) for row in rows) / sum(float(time[row]) for row in rows) / 1000)
        shares.append(sum(int(found[row]) for row in rows) / sum(int(objects[row]) for row in rows))
    for interval, sample in ((point.rate_interval, rates), (point.quality_interval, shares)):
        assert interval is not None
        assert (interval.low, interval.high) == pytest.approx(np.percentile(sample, (10, 90)))


@given(st.lists(st.tuples(st.integers(1, 60), st.integers(0, 20)), min_size=1, max_size=12))
@settings(deadline=None)
def test_hull_keeps_what_nothing_beats_by_rising_rate(rows: list[tuple[int, int]]) -> None:
    method = Method("m", tuple(SequencePoint("s", f"crf {k}", 125 * b, 1.0, g, 20) for k, (b, g) in enumerate(rows)))
    points = pooled_points(method)
    kept = hull(points)
    assert [point.rate_kbps for point in points] == sorted(float(size) for size, _ in rows)
    expected = {
        (size, gained / 20)
        for size, gained in rows
        if not any(r <= size and g >= gained and (r, g) != (size, gained) for r, g in rows)
    }
    assert [(point.rate_kbps, point.quality) for point in kept] == sorted(expected)
    assert all(one.quality < more.quality for one, more in pairwise(kept))
    assert set(kept) <= set(points)


def test_rate_at_a_quality_is_that_of_the_curve() -> None:
    method = doubling("roi", (1, 2, 6))
    for quality in (20.0, 29.3, 32.0, 38.0):
        found = rate_at(method, quality, Bootstrap(300))
        assert found.rate_kbps == pytest.approx(kbps(3, quality), rel=1e-6)
        assert found.interval is not None
        weights = cluster_draws(3, Bootstrap(300)) @ np.array([1, 2, 6]) / 3
        bounds = np.quantile(weights, (0.025, 0.975))
        assert (found.interval.low, found.interval.high) == pytest.approx(
            tuple(kbps(bound, quality) for bound in bounds), rel=1e-6
        )
        assert (found.reason, found.defined_draws) == ("", 1.0)


def test_nothing_is_extrapolated() -> None:
    method = doubling("roi", (1, 2, 6))
    above, below = rate_at(method, 38.5, None), rate_at(method, 19.0, None)
    assert above.rate_kbps is below.rate_kbps is None
    assert above.reason.startswith("quality 38.5 lies above the best of 'roi', 38 at")
    assert above.reason.endswith("code it at lower CRFs, or ask for less")
    assert below.reason.startswith("quality 19 lies below the poorest of 'roi', 20 at")
    one = rate_at(Method("one", (SequencePoint("s", "crf 1", 8, 1.0, 1, 2),)), 0.5, None)
    assert one.reason == "'one' has 1 points that nothing beats, 2 are needed; code it at more CRFs"
    assert rate_at(Method("none", ()), 0.5, None).reason.endswith("it has no points; measure some")
    twins = Method("twins", tuple(SequencePoint("s", f"crf {k}", 8 + k, 1.0, k * 5e-324, 1.0) for k in range(4)))
    steep = rate_at(twins, 5e-324, None)
    assert (steep.rate_kbps is None) == ("almost equal quality" in steep.reason)


def test_saving_is_paired_and_told_by_sequence() -> None:
    scales, factors = np.array([1.0, 30.0, 4.0, 9.0]), np.array([0.5, 0.6, 0.4, 0.55])
    anchor, test = doubling("full", scales), doubling("roi", scales * factors)
    bootstrap = Bootstrap(200)
    found = saving_at(anchor, test, 30.0, bootstrap)
    assert found.saving == pytest.approx(1 - (scales * factors).sum() / scales.sum(), rel=1e-6)
    assert dict(found.by_sequence) == pytest.approx({f"s{row}": 1 - factors[row] for row in range(4)}, abs=1e-6)
    weights = cluster_draws(4, bootstrap)
    bounds = np.quantile(1 - (weights @ (scales * factors)) / (weights @ scales), (0.025, 0.975))
    assert found.interval is not None
    assert (found.interval.low, found.interval.high) == pytest.approx(bounds, abs=1e-6)
    assert found.anchor_kbps == pytest.approx(kbps(11, 30), rel=1e-6)
    assert found.test_kbps == pytest.approx(kbps((scales * factors).mean(), 30), rel=1e-6)


def test_a_quality_out_of_reach_has_no_saving() -> None:
    anchor = doubling("full", (1, 2, 3))
    short = Method("roi", tuple(point for point in anchor.points if point.setting != "q 38"))
    found = saving_at(anchor, short, 35.0, Bootstrap(10))
    assert found.saving is found.interval is found.test_kbps is None
    assert found.anchor_kbps == pytest.approx(kbps(2, 35), rel=1e-6)
    assert found.reason.startswith("quality 35 lies above the best of 'roi', 32 at")
    assert set(found.by_sequence.values()) == {None}
    elsewhere = saving_at(anchor, Method("roi", (SequencePoint("x", "crf 1", 8, 1.0, 1, 2),)), 30.0, None)
    assert "share no sequence; measure both on the same ones" in elsewhere.reason


coordinates = st.one_of(st.integers(0, 4).map(float), st.just(math.inf))


@given(st.lists(st.tuples(coordinates, coordinates, coordinates), max_size=25), st.tuples(*[st.booleans()] * 3))
def test_front_is_what_nothing_dominates(rows: list[tuple[float, ...]], maximise: tuple[bool, ...]) -> None:
    def dominates(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
        pairs = [(b, a) if most else (a, b) for a, b, most in zip(one, other, maximise, strict=True)]
        return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)

    found = pareto_front(np.array(rows).reshape(len(rows), 3), maximise)
    assert found.tolist() == [not any(dominates(other, row) for other in rows) for row in rows]


def test_a_slow_method_is_kept_only_if_it_buys_something() -> None:
    points = pareto_points(
        ["quick", "thrifty", "both worse", "twin"],
        [(900, 80), (400, 120), (900, 130), (400, 120)],
        [0.8, 0.8, 0.8, 0.8],
    )
    assert [(point.label, point.dominated) for point in points] == [
        ("quick", False), ("thrifty", False), ("both worse", True), ("twin", False)
    ]  # fmt: skip
    assert points[0].costs == (900, 80)
    assert pareto_points([], [], []) == ()


@pytest.mark.parametrize(
    ("values", "text"),
    [((1, 0.0, 1, 1), "above 0"), ((-1, 1.0, 1, 1), "at least 0"), ((1, 1.0, math.nan, 1), "all must be finite"),
     ((1, 1.0, 1, -1), "at least 0"), ((1, math.inf, 1, 1), "all must be finite")],
)  # fmt: skip
def test_impossible_points_are_refused(values: tuple[float, ...], text: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"sequence 's' at 'crf 1' has .*{text}"):
        SequencePoint("s", "crf 1", *values)  # type: ignore[arg-type]


def test_misuse_is_told() -> None:
    point = SequencePoint("s", "crf 1", 8, 1.0, 1, 2)
    with pytest.raises(ConfigurationError, match="'m' has 2 points of sequence 's' at 'crf 1'"):
        Method("m", (point, point))
    with pytest.raises(ConfigurationError, match="'m' has no sequence 'x'; it has s"):
        Method("m", (point,)).of_sequence("x")
    with pytest.raises(ConfigurationError, match=r"shape \[N, 2\], got \(3,\)"):
        pareto_front([1, 2, 3], (True, False))
    with pytest.raises(ConfigurationError, match="point 1 has no number for objective 0"):
        pareto_front([[1.0], [math.nan]], (True,))
    with pytest.raises(ConfigurationError, match="2 labels, 1 costs, 1 qualities"):
        pareto_points(["a", "b"], [(1,)], [1])
    with pytest.raises(ConfigurationError, match=r"points have \[1, 2\] costs"):
        pareto_points(["a", "b"], [(1,), (1, 2)], [1, 2])
