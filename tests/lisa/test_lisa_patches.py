"""Patch selection against a literal loop over patches in exact whole numbers."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from cable_models.errors import ModelError
from cable_models.lisa.images import Size, clip_geometry, clip_input
from cable_models.lisa.patch_selection import kept_patches
from hypothesis import given, settings
from hypothesis import strategies as st

FITS = ["crop", "pad", "squash"]


def footprint(frame: Size, size: int, fit: str, axis: int, start: int, end: int) -> tuple[int, int, int]:
    """CLIP pixels start..end along one axis as frame pixels, written out per fit: low, high and their denominator."""
    extent = frame[axis]
    if fit == "squash":
        return start * extent, end * extent, size
    if fit == "pad":
        side = max(frame)
        before = (side - extent) // 2
        return start * side - before * size, end * side - before * size, size
    resized = int(size * extent / min(frame))
    before = (resized - size) // 2
    return (start + before) * extent, (end + before) * extent, resized


def covered_lengths(low: int, high: int, denominator: int, extent: int) -> np.ndarray:
    """How much of each frame pixel lies between low and high, in exact parts of 1 / denominator."""
    begins = np.arange(extent) * denominator
    return np.maximum(0, np.minimum(high, begins + denominator) - np.maximum(low, begins))


def slow_kept(
    roi: np.ndarray, size: int, patch: int, fit: str, min_overlap: Fraction = Fraction(1, 100), ring: int = 0
) -> np.ndarray:
    count = size // patch
    kept = np.zeros((count, count), bool)
    for row in range(count):
        for column in range(count):
            rows = covered_lengths(*footprint(roi.shape, size, fit, 0, row * patch, (row + 1) * patch), roi.shape[0])
            columns = footprint(roi.shape, size, fit, 1, column * patch, (column + 1) * patch)
            shares = np.outer(rows, covered_lengths(*columns, roi.shape[1]))
            covered, area = int(shares[roi].sum()), int(shares.sum())
            kept[row, column] = roi.all() or (covered > 0 and covered >= min_overlap * area)
    grown = kept.copy()
    for row, column in np.argwhere(kept):
        grown[max(0, row - ring) : row + ring + 1, max(0, column - ring) : column + ring + 1] = True
    return grown


@st.composite
def regions(draw: st.DrawFn) -> np.ndarray:
    height, width = draw(st.integers(1, 26)), draw(st.integers(1, 26))
    if draw(st.booleans()):
        roi = np.zeros((height, width), bool)
        top, left = draw(st.integers(0, height)), draw(st.integers(0, width))
        roi[top : top + draw(st.integers(0, height)), left : left + draw(st.integers(0, width))] = True
        return roi
    return np.random.default_rng(draw(st.integers(0, 99))).random((height, width)) < draw(
        st.sampled_from([0.02, 0.5, 1])
    )


@given(
    roi=regions(),
    grid=st.sampled_from([(8, 2), (12, 4), (14, 14), (15, 4)]),
    fit=st.sampled_from(FITS),
    min_overlap=st.sampled_from([Fraction(0), Fraction(1, 128), Fraction(1, 4), Fraction(1, 2), Fraction(1)]),
    ring=st.integers(0, 2),
)
@settings(max_examples=100, deadline=None)
def test_equals_the_literal_loop(
    roi: np.ndarray, grid: tuple[int, int], fit: str, min_overlap: Fraction, ring: int
) -> None:
    size, patch = grid
    kept = kept_patches(roi, clip_geometry(roi.shape, size, fit), patch, min_overlap=float(min_overlap), ring=ring)
    np.testing.assert_array_equal(kept, slow_kept(roi, size, patch, fit, min_overlap, ring))


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize("frame", [(900, 1600), (1600, 900), (37, 91), (224, 224)])
def test_whole_frame_keeps_every_patch(frame: tuple[int, int], fit: str) -> None:
    kept = kept_patches(np.ones(frame, bool), clip_geometry(frame, 224, fit), 14)
    assert kept.shape == (16, 16)
    assert kept.all()


@pytest.mark.parametrize("fit", FITS)
def test_empty_region_keeps_none_even_with_a_ring(fit: str) -> None:
    assert not kept_patches(np.zeros((90, 160), bool), clip_geometry((90, 160), 56, fit), 14, ring=3).any()


def test_region_beside_the_centre_crop_keeps_none() -> None:
    roi = np.zeros((900, 1600), bool)
    roi[:, :349] = roi[:, 1251:] = True
    assert not kept_patches(roi, clip_geometry((900, 1600), 224), 14, ring=2).any()
    squashed = kept_patches(roi, clip_geometry((900, 1600), 224, "squash"), 14)
    np.testing.assert_array_equal(squashed, [[*[True] * 4, *[False] * 8, *[True] * 4]] * 16)


def test_region_reaching_into_the_edge_patch_counts_by_area() -> None:
    """CLIP's first column covers x = 349.749 .. 406.03 of a 1600x900 frame: 1 % of it is 0.563 px."""
    geometry = clip_geometry((900, 1600), 224)
    for edge, expected in [(349, False), (350, False), (351, True)]:
        roi = np.zeros((900, 1600), bool)
        roi[:, :edge] = True
        kept = kept_patches(roi, geometry, 14)
        assert kept[:, 0].all() == expected
        assert not kept[:, 1:].any()


def test_padding_belongs_to_no_patch() -> None:
    """1600x900 padded: patch rows of 100 frame pixels, the frame fills rows 3.5 to 12.5."""
    geometry = clip_geometry((900, 1600), 224, "pad")
    roi = np.ones((900, 1600), bool)
    roi[450] = False
    kept = kept_patches(roi, geometry, 14)
    np.testing.assert_array_equal(kept.any(1), [False] * 3 + [True] * 10 + [False] * 3)
    thin = np.zeros((900, 1600), bool)
    thin[0] = True  # 2 % of the 50 rows the half-covered patch has in the frame, 1 % of the patch
    assert kept_patches(thin, geometry, 14, min_overlap=0.015)[3].all()


def test_very_wide_odd_frame() -> None:
    roi = np.zeros((375, 1242), bool)
    roi[170:300, 433:700] = True
    for fit in FITS:
        kept = kept_patches(roi, clip_geometry(roi.shape, 56, fit), 14)
        np.testing.assert_array_equal(kept, slow_kept(roi, 56, 14, fit))


@pytest.mark.parametrize("fit", FITS)
def test_patches_that_change_with_the_region_are_kept(fit: str) -> None:
    """Painting a region changes the kept patches of CLIP's input; elsewhere only the resize's reach shows."""
    frame = np.full((180, 320, 3), 120, np.uint8)
    roi = np.zeros((180, 320), bool)
    roi[45:110, 140:215] = True
    geometry = clip_geometry((180, 320), 56, fit)
    painted = frame.copy()
    painted[roi] = 255
    changed = np.abs(clip_input(painted, geometry) - clip_input(frame, geometry)).max(0)
    strong = changed.reshape(4, 14, 4, 14).max((1, 3)) > 0.5 * changed.max()
    np.testing.assert_array_equal(strong, kept_patches(roi, geometry, 14, min_overlap=0.005))


def test_refusals() -> None:
    geometry = clip_geometry((20, 30), 28)
    roi = np.ones((20, 30), bool)
    with pytest.raises(ModelError, match="ROI"):
        kept_patches(roi.astype(np.uint8), geometry, 14)
    with pytest.raises(ModelError, match="ROI"):
        kept_patches(roi.T, geometry, 14)
    with pytest.raises(ModelError, match="min_overlap"):
        kept_patches(roi, geometry, 14, min_overlap=1.5)
    with pytest.raises(ModelError, match="min_overlap"):
        kept_patches(roi, geometry, 14, min_overlap=float("nan"))
    with pytest.raises(ModelError, match="ring"):
        kept_patches(roi, geometry, 14, ring=-1)
    with pytest.raises(ModelError, match="patch"):
        kept_patches(roi, geometry, 0)
