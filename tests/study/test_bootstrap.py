from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import Bootstrap, bootstrap_interval, drawn_ratios
from cable_rpc.study.metrics.bootstrap import cluster_draws

counts = st.integers(0, 50)


def ratio_interval(above: list[float], below: list[float], bootstrap: Bootstrap):  # type: ignore[no-untyped-def]
    return bootstrap_interval(len(above), lambda weights: drawn_ratios(above, below, weights), bootstrap)


@given(st.lists(st.tuples(counts, st.integers(1, 50)), min_size=1, max_size=8), st.integers(0, 5))
def test_each_draw_is_the_ratio_of_the_drawn_sequences(rows: list[tuple[int, int]], seed: int) -> None:
    weights = cluster_draws(len(rows), Bootstrap(5, seed=seed))
    assert (weights.sum(axis=1) == len(rows)).all()
    above, below = zip(*rows, strict=True)
    for drawn, ratio in zip(weights, drawn_ratios(above, below, weights), strict=True):
        picked = [row for row, count in zip(rows, drawn, strict=True) for _ in range(count)]
        assert ratio == pytest.approx(sum(one for one, _ in picked) / sum(one for _, one in picked))


@given(st.lists(st.floats(-5, 5), min_size=3, max_size=8), st.floats(-100, 100))
def test_interval_of_symmetric_data_holds_the_estimate(offsets: list[float], centre: float) -> None:
    values = [centre + offset for offset in offsets] + [centre - offset for offset in offsets]
    found = ratio_interval(values, [1.0] * len(values), Bootstrap(400))
    assert found is not None
    assert found.low - 1e-9 <= centre <= found.high + 1e-9


@given(st.floats(0.01, 1), st.lists(st.integers(1, 99), min_size=3, max_size=9))
def test_sequences_that_agree_leave_no_spread(share: float, sizes: list[int]) -> None:
    found = ratio_interval([share * size for size in sizes], [float(size) for size in sizes], Bootstrap(50))
    assert found is not None
    assert (found.low, found.high) == pytest.approx((share, share))


def test_interval_is_that_of_scipy() -> None:
    """The mean of 20 numbers by scipy's percentile bootstrap, up to the noise of both draws."""
    sample = np.random.default_rng(7).gamma(2.0, 1.0, 20)
    expected = stats.bootstrap((sample,), np.mean, n_resamples=20_000, method="percentile", rng=1).confidence_interval
    found = ratio_interval(sample.tolist(), [1.0] * 20, Bootstrap(20_000))
    assert found is not None
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=0.02)


def test_two_sequences_give_no_interval() -> None:
    assert ratio_interval([1, 2], [3, 4], Bootstrap(10)) is None
    assert ratio_interval([1, 2, 0], [3, 4, 5], Bootstrap(10)) is not None
    ignoring = bootstrap_interval(5, lambda weights: weights[:, 0] / 1.0, Bootstrap(10), informative=2)
    assert ignoring is None


def test_draws_without_a_denominator_are_left_out() -> None:
    ratios = drawn_ratios([1, 0], [2, 0], np.array([[1, 1], [0, 2]]))
    assert ratios[0] == 0.5
    assert math.isnan(ratios[1])
    assert bootstrap_interval(3, lambda weights: np.full(len(weights), np.nan), Bootstrap(10)) is None


def test_mean_over_ratios() -> None:
    assert drawn_ratios([[1, 1], [1, 3]], [[2, 4], [2, 4]], np.ones((1, 2), np.int64)).tolist() == [0.5]


def test_a_paired_difference_is_narrower_than_both_of_its_sides() -> None:
    """Sequences differ far more than the two strategies do on any of them."""
    random = np.random.default_rng(2)
    base = random.uniform(0, 10, 12)
    gain = 1 + 0.01 * random.standard_normal(12)
    frames = np.ones(12)
    alone = ratio_interval((base + gain).tolist(), frames.tolist(), Bootstrap(500))
    paired = bootstrap_interval(
        12,
        lambda weights: drawn_ratios(base + gain, frames, weights) - drawn_ratios(base, frames, weights),
        Bootstrap(500),
    )
    assert alone is not None
    assert paired is not None
    assert paired.high - paired.low < 0.05 < 1.0 < alone.high - alone.low
    assert paired.low < gain.mean() < paired.high


def test_equal_seeds_draw_equally() -> None:
    first, second = cluster_draws(6, Bootstrap(20, seed=3)), cluster_draws(6, Bootstrap(20, seed=3))
    assert first.tolist() == second.tolist()
    assert first.tolist() != cluster_draws(6, Bootstrap(20, seed=4)).tolist()


@pytest.mark.parametrize("settings", [{"draws": 0}, {"level": 1.0}, {"level": 0.0}, {"seed": -1}])
def test_unusable_settings(settings: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError, match="Bootstrap"):
        Bootstrap(**settings)  # type: ignore[arg-type]
