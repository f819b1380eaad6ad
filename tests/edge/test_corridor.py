"""The corridor and each of its switches against a literal reference in exact fractions."""

from __future__ import annotations

import math
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

sys.path.insert(0, str(Path(__file__).parent))

import algorithm1_reference as reference

from cable_rpc.edge.corridor import column_extents, corridor, corridor_curves, side_margin, smoothing_window
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.errors import FrameError

SIZES = st.tuples(st.integers(1, 24), st.integers(1, 40))
MASKS = SIZES.flatmap(lambda size: hnp.arrays(np.bool_, size))
SPARSE_MASKS = st.tuples(SIZES, st.integers(0, 2**32 - 1), st.sampled_from([0.005, 0.02, 0.1])).map(
    lambda t: np.random.default_rng(t[1]).random(t[0]) < t[2]
)
HUNDREDTHS = st.integers(0, 100).map(lambda value: Fraction(value, 100))


def half_up(value):
    return math.floor(value + Fraction(1, 2))


def groups_of(columns, gap):
    """Occupied columns, cut where more than ``gap`` columns between neighbours are empty."""
    groups = [[columns[0]]]
    for column in columns[1:]:
        if column - groups[-1][-1] - 1 > gap:
            groups.append([])
        groups[-1].append(column)
    return groups


def literal_band(known_tops, known_bottoms, height, window, p):
    """{column: (first row, last row)} of one group of columns."""
    first, last = min(known_tops), max(known_tops)
    t = reference.interpolate(known_tops, first, last)
    b = reference.interpolate(known_bottoms, first, last)
    t_smooth, b_smooth = reference.smooth(t, window), reference.smooth(b, window)
    band = {}
    for i in range(last - first + 1):
        upper = min(max(t_smooth[i] - p["eta_t"] * t[i], Fraction(0)), Fraction(height - 1))
        lower = min(max(b_smooth[i] + p["eta_b"] * (height - b[i]), Fraction(0)), Fraction(height - 1))
        least = p["h_min"] * height
        if lower - upper < least:
            upper, lower = (upper + lower - least) / 2, (upper + lower + least) / 2
            slide = max(-upper, Fraction(0)) - max(lower - (height - 1), Fraction(0))
            upper, lower = max(upper + slide, Fraction(0)), min(lower + slide, Fraction(height - 1))
        band[first + i] = (half_up(upper), half_up(lower))
    return band


def literal_corridor(raw, p, scale=1, late_frames=0):
    height, width = raw.shape
    out = raw.copy()
    rows_of = {x: [y for y in range(height) if raw[y, x]] for x in range(width)}
    columns = [x for x in range(width) if rows_of[x]]
    if not columns or not p["corridor"]:
        return out
    exact = Fraction(p["w_s"], scale)
    if p["reference_width"]:
        exact = exact * width * scale / p["reference_width"]
    window = max(odd for odd in range(1, 2001, 2) if odd == 1 or odd - 1 <= exact)
    margin = half_up((p["side"] + p["late_side"] * late_frames) * width)
    covered = {}
    for group in groups_of(columns, p["gap"] * width):
        band = literal_band({x: rows_of[x][0] for x in group}, {x: rows_of[x][-1] for x in group}, height, window, p)
        for x in range(max(group[0] - margin, 0), min(group[-1] + margin, width - 1) + 1):
            upper, lower = band[min(max(x, group[0]), group[-1])]
            before = covered.get(x, (height, -1))
            covered[x] = (min(upper, before[0]), max(lower, before[1]))
    for x, (upper, lower) in covered.items():
        for y in range(upper, lower + 1):
            out[y, x] = True
    return out


def settings_of(p):
    return RoiConfig(
        corridor=p["corridor"],
        corridor_gap_share=float(p["gap"]),
        smoothing_window_columns=p["w_s"],
        smoothing_reference_width=p["reference_width"],
        side_margin_share=float(p["side"]),
        side_margin_per_late_frame_share=float(p["late_side"]),
        top_margin=float(p["eta_t"]),
        bottom_margin=float(p["eta_b"]),
        min_height_fraction=float(p["h_min"]),
    )


LITERAL_SETTINGS = st.fixed_dictionaries(
    {
        "corridor": st.sampled_from([True, True, True, False]),
        "gap": st.one_of(st.just(Fraction(1)), HUNDREDTHS),
        "w_s": st.sampled_from([1, 3, 15, 51]),
        "reference_width": st.sampled_from([0, 0, 20, 100, 1600]),
        "side": HUNDREDTHS.map(lambda share: share / 4),
        "late_side": HUNDREDTHS.map(lambda share: share / 10),
        "eta_t": HUNDREDTHS,
        "eta_b": HUNDREDTHS,
        "h_min": HUNDREDTHS,
    }
)


@given(
    mask=st.one_of(MASKS, SPARSE_MASKS),
    p=LITERAL_SETTINGS,
    scale=st.sampled_from([1, 2, 4]),
    late_frames=st.integers(0, 5),
)
@settings(max_examples=250, deadline=None)
def test_every_switch_equals_the_literal_reference(mask, p, scale, late_frames):
    region = corridor(mask, settings_of(p), scale=scale, late_frames=late_frames)
    assert np.array_equal(region, literal_corridor(mask, p, scale, late_frames))
    assert not (mask & ~region).any()


@given(mask=st.one_of(MASKS, SPARSE_MASKS))
@settings(max_examples=100, deadline=None)
def test_paper_mode_is_algorithm_1(mask):
    assert np.array_equal(corridor(mask, RoiConfig.paper()), reference.corridor(mask, reference.PAPER))


@pytest.mark.parametrize("size", [(90, 161), (270, 300), (300, 70)])
def test_paper_mode_is_algorithm_1_on_larger_masks(size):
    rng = np.random.default_rng(size[0])
    for density in (0.0005, 0.01):
        mask = rng.random(size) < density
        assert np.array_equal(corridor(mask, RoiConfig.paper()), reference.corridor(mask, reference.PAPER))


@given(mask=st.one_of(MASKS, SPARSE_MASKS))
def test_extents_are_the_outermost_rows(mask):
    columns, top, bottom = column_extents(mask)
    found = {int(x): (int(t), int(b)) for x, t, b in zip(columns, top, bottom, strict=True)}
    rows = {x: np.flatnonzero(mask[:, x]) for x in range(mask.shape[1])}
    assert found == {x: (r[0], r[-1]) for x, r in rows.items() if len(r)}


def test_views_of_larger_arrays_are_fine():
    whole = np.random.default_rng(3).random((60, 90)) < 0.05
    part = whole[5:45:2, 60:7:-1]
    assert np.array_equal(corridor(part, RoiConfig.paper()), corridor(part.copy(), RoiConfig.paper()))


def test_without_corridor_the_region_is_raw():
    raw = np.random.default_rng(0).random((40, 60)) < 0.1
    region = corridor(raw, RoiConfig(corridor=False))
    assert np.array_equal(region, raw)
    assert not np.shares_memory(region, raw)


@pytest.mark.parametrize(("empty_columns", "bands"), [(50, 1), (51, 2)])
def test_gap_wider_than_a_quarter_begins_a_new_band(empty_columns, bands):
    raw = np.zeros((100, 200), np.bool_)
    raw[50:60, 20:30] = raw[50:60, 30 + empty_columns : 100] = True
    occupied = corridor(raw, RoiConfig(side_margin_share=0, corridor_gap_share=0.25)).any(axis=0)
    assert np.flatnonzero(np.diff(occupied.astype(int)) == 1).size == bands


def test_side_margin_grows_with_the_priors_age():
    raw = np.zeros((90, 1600), np.bool_)
    raw[40:50, 700:800] = True
    for late_frames, margin in ((0, 32), (1, 48), (4, 96)):
        columns = np.flatnonzero(corridor(raw, RoiConfig(), late_frames=late_frames).any(axis=0))
        assert (columns[0], columns[-1]) == (700 - margin, 799 + margin)
    assert side_margin(RoiConfig(), 1600, -1) == 32
    assert side_margin(RoiConfig(), 1600, 10**9) == 1600


def test_widened_bands_that_meet_are_one():
    raw = np.zeros((100, 100), np.bool_)
    raw[20:25, 10:20] = raw[80:85, 50:60] = True
    config = RoiConfig(corridor_gap_share=0.2, side_margin_share=0.2, top_margin=0, bottom_margin=0)
    region = corridor(raw, config)
    assert region[20:85, 30:40].all()
    assert not region[40:70, :30].any()


@pytest.mark.parametrize(
    ("reference_width", "width", "scale", "window"),
    [(1600, 1600, 1, 15), (1600, 960, 1, 9), (1600, 400, 4, 3), (1600, 64, 1, 1), (0, 400, 4, 3), (0, 960, 1, 15)],
)
def test_smoothing_window_follows_the_width(reference_width, width, scale, window):
    assert smoothing_window(RoiConfig(smoothing_reference_width=reference_width), width, scale) == window


def test_curves_leave_out_the_columns_between_bands():
    raw = np.zeros((50, 100), np.bool_)
    raw[20:25, 10:12] = raw[30:32, 60:65] = True
    curves = corridor_curves(raw, RoiConfig(side_margin_share=0.01))
    between = curves.first_rows > curves.last_rows
    assert (curves.columns.start, curves.columns.stop) == (9, 66)
    assert np.flatnonzero(between).tolist() == list(range(13 - 9, 59 - 9))
    assert corridor_curves(np.zeros((5, 5), np.bool_), RoiConfig()) is None


def test_writes_into_a_given_array():
    rng = np.random.default_rng(8)
    out = rng.random((50, 70)) < 0.5
    for density in (0.0, 0.001, 0.02, 0.5):
        raw = rng.random(out.shape) < density
        assert corridor(raw, RoiConfig(), out=out) is out
        assert np.array_equal(out, corridor(raw, RoiConfig()))


@pytest.mark.parametrize("out", [np.zeros((4, 5), np.bool_), np.zeros((5, 5), np.uint8), "raw"])
def test_unfit_output_is_named(out):
    raw = np.ones((5, 5), np.bool_)
    with pytest.raises(FrameError, match="separate bool array"):
        corridor(raw, RoiConfig(), out=raw if isinstance(out, str) else out)
