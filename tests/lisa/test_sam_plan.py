"""Which tokens of SAM are computed, against literal readings of the rules."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from cable_models.errors import ModelError
from cable_models.lisa.sam_plan import BoolGrid, SamGrid, grow, picture_tokens, plan_sam, touched_tokens
from hypothesis import given, settings
from hypothesis import strategies as st

GRIDS = [SamGrid(), SamGrid(256, 16, 14), SamGrid(96, 8, 4), SamGrid(80, 8, 3)]


def region(frame_hw: tuple[int, int], box: tuple[int, int, int, int]) -> BoolGrid:
    top, left, bottom, right = box
    roi = np.zeros(frame_hw, np.bool_)
    roi[top:bottom, left:right] = True
    return roi


@st.composite
def frames_with_roi(draw: st.DrawFn) -> tuple[BoolGrid, SamGrid]:
    height, width = draw(st.integers(20, 120)), draw(st.integers(20, 120))
    roi = np.zeros((height, width), np.bool_)
    for _ in range(draw(st.integers(0, 3))):
        y, x = draw(st.integers(0, height - 1)), draw(st.integers(0, width - 1))
        roi[y : y + draw(st.integers(1, 40)), x : x + draw(st.integers(1, 40))] = True
    return roi, draw(st.sampled_from(GRIDS[1:]))


@settings(max_examples=40, deadline=None)
@given(frames_with_roi())
def test_a_token_is_touched_where_it_shares_area_with_a_pixel_of_the_region(
    case: tuple[BoolGrid, SamGrid],
) -> None:
    """Pixel by pixel in exact fractions: frame pixel y covers [y, y + 1) * h / H of SAM's input."""
    roi, grid = case
    height, width = roi.shape
    scale = Fraction(grid.image_size, max(height, width))
    tall, wide = (int(side * scale + Fraction(1, 2)) for side in (height, width))
    expected = np.zeros((grid.side, grid.side), np.bool_)
    for y, x in np.argwhere(roi):
        rows = [Fraction(int(y) + end) * tall / height / grid.patch_size for end in (0, 1)]
        columns = [Fraction(int(x) + end) * wide / width / grid.patch_size for end in (0, 1)]
        expected[int(rows[0]) : -int(-rows[1] // 1), int(columns[0]) : -int(-columns[1] // 1)] = True
    assert np.array_equal(touched_tokens(roi, grid), expected)


@settings(max_examples=60, deadline=None)
@given(frames_with_roi(), st.sampled_from(["keep", "drop", "always"]), st.sampled_from(["all", "skip", "tokens"]))
def test_plan_follows_the_rules(case: tuple[BoolGrid, SamGrid], padding: str, windows: str) -> None:
    roi, grid = case
    frame_hw = (roi.shape[0], roi.shape[1])
    plan = plan_sam(roi, frame_hw, grid, padding=padding, windows=windows)  # type: ignore[arg-type]
    touched, picture = touched_tokens(roi, grid), picture_tokens(frame_hw, grid)
    assert plan.tokens[touched & picture].all() or roi.all()
    if windows == "tokens" and not roi.all():
        assert np.array_equal(plan.tokens, touched)
        return
    for row in range(0, grid.side, grid.window):
        for column in range(0, grid.side, grid.window):
            window = (slice(row, row + grid.window), slice(column, column + grid.window))
            holds_picture, holds_roi = picture[window].any(), touched[window].any()
            if roi.all():
                computed = holds_picture or padding != "always"
            elif windows == "skip":
                computed = holds_roi
            else:
                computed = holds_picture or padding == "keep"
            assert (plan.tokens[window] == computed).all()


@pytest.mark.parametrize("roi", [None, np.ones((900, 1600), np.bool_)], ids=["none", "full"])
@pytest.mark.parametrize("windows", ["all", "skip", "tokens"])
def test_a_whole_frame_is_computed_whole_but_for_padding_always(roi: BoolGrid | None, windows: str) -> None:
    for padding in ("keep", "drop"):
        plan = plan_sam(roi, (900, 1600), SamGrid(), padding=padding, windows=windows)  # type: ignore[arg-type]
        assert plan.whole
    always = plan_sam(roi, (900, 1600), SamGrid(), padding="always", windows=windows)  # type: ignore[arg-type]
    assert not always.whole
    assert always.windows.tolist() == [[True] * 5] * 3 + [[False] * 5] * 2


def test_landscape_and_portrait_of_the_usual_camera() -> None:
    """36 of 64 token rows hold picture in 1600 x 900; window borders lie at 350 frame pixels."""
    landscape = plan_sam(region((900, 1600), (0, 0, 350, 700)), (900, 1600), SamGrid(), windows="skip")
    assert np.argwhere(landscape.windows).tolist() == [[0, 0], [0, 1]]
    assert landscape.token_count == 2 * 14 * 14
    portrait = plan_sam(region((1600, 900), (1400, 899, 1401, 900)), (1600, 900), SamGrid(), windows="skip")
    assert np.argwhere(portrait.windows).tolist() == [[4, 2]]
    assert portrait.token_count == 8 * 14
    dropped = plan_sam(region((1600, 900), (0, 0, 1, 1)), (1600, 900), SamGrid(), padding="drop")
    assert dropped.windows.tolist() == [[True, True, True, False, False]] * 5


def test_margin_grows_the_region_but_not_into_the_padding() -> None:
    roi = region((900, 1600), (340, 340, 350, 350))
    assert plan_sam(roi, (900, 1600), SamGrid(), windows="skip").windows.sum() == 1
    assert plan_sam(roi, (900, 1600), SamGrid(), windows="skip", margin=1).windows.sum() == 4
    bottom = region((900, 1600), (899, 800, 900, 801))
    plan = plan_sam(bottom, (900, 1600), SamGrid(), windows="tokens", margin=2)
    assert np.argwhere(plan.tokens).min(axis=0).tolist() == [33, 30]
    assert np.argwhere(plan.tokens).max(axis=0).tolist() == [35, 34]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 3), st.lists(st.tuples(st.integers(0, 11), st.integers(0, 11)), max_size=4))
def test_growing_marks_every_token_within_the_margin(margin: int, marked: list[tuple[int, int]]) -> None:
    tokens = np.zeros((12, 12), np.bool_)
    for place in marked:
        tokens[place] = True
    far = 99
    rows, columns = np.indices(tokens.shape)
    distance = [np.maximum(abs(rows - y), abs(columns - x)) for y, x in marked] or [np.full(tokens.shape, far)]
    assert np.array_equal(grow(tokens, margin), np.min(distance, axis=0) <= margin)


@settings(max_examples=30, deadline=None)
@given(frames_with_roi(), st.sampled_from(["skip", "tokens"]))
def test_layout_puts_every_token_into_its_place_of_its_window(case: tuple[BoolGrid, SamGrid], windows: str) -> None:
    roi, grid = case
    plan = plan_sam(roi, (roi.shape[0], roi.shape[1]), grid, windows=windows)  # type: ignore[arg-type]
    layout = plan.layout()
    assert sorted(zip(layout.rows, layout.columns, strict=True)) == [tuple(place) for place in np.argwhere(plan.tokens)]
    used = [tuple(place) for place in np.argwhere(plan.windows)]
    assert len(layout.hidden) == len(used)
    taken = np.zeros(layout.hidden.shape, np.bool_)
    for row, column, slot in zip(layout.rows, layout.columns, layout.slots, strict=True):
        window = used[slot // grid.window**2]
        assert window == (row // grid.window, column // grid.window)
        assert slot % grid.window**2 == row % grid.window * grid.window + column % grid.window
        taken.ravel()[slot] = True
    for number, (row, column) in enumerate(used):
        for place in range(grid.window**2):
            y, x = row * grid.window + place // grid.window, column * grid.window + place % grid.window
            inside = y < grid.side and x < grid.side
            assert layout.hidden[number, place] == (inside and not taken[number, place])


def test_unusable_requests_are_refused() -> None:
    with pytest.raises(ModelError, match="padding 'never'"):
        plan_sam(None, (9, 9), SamGrid(), padding="never")  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="margin -1"):
        plan_sam(None, (9, 9), SamGrid(), margin=-1)
    with pytest.raises(ModelError, match=r"region bool \(9, 8\)"):
        plan_sam(np.ones((9, 8), np.bool_), (9, 9), SamGrid())
    with pytest.raises(ModelError, match="multiple of the patch"):
        SamGrid(100, 16, 14)
