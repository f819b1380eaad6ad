from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.study.metrics import (
    GROUPS,
    SIZE_BINS,
    MaskOverlap,
    MatchCounts,
    RetentionCounts,
    asked_truth,
    box_iou,
    group_indices,
    macro_frame,
    mask_iou,
    mask_overlap,
    match_detections,
    percentiles,
    recognition_curve,
    retained,
    roi_overlap,
    scores_of,
    size_bins,
    visible_truth,
)
from cable_rpc.types import Detections, GroundTruth

CAR, TRUCK, PERSON = 2, 7, 0


def detections(*rows: tuple[float, float, float, float, int, float]) -> Detections:
    table = np.array(rows, np.float64).reshape(-1, 6)
    return Detections(table[:, :4].astype(np.float32), table[:, 4].astype(np.int32), table[:, 5].astype(np.float32))


def test_iou_by_hand() -> None:
    assert box_iou([[0, 0, 10, 10]], [[5, 0, 15, 10]])[0, 0] == pytest.approx(50 / 150)
    assert box_iou([[0, 0, 10, 10]], [[10, 0, 20, 10]])[0, 0] == 0
    assert box_iou([[3, 3, 3, 3]], [[3, 3, 3, 3]])[0, 0] == 0


@pytest.mark.parametrize(
    ("found", "truth", "expected"),
    [
        # a truck that is called car is the same vehicle
        ([(0, 0, 10, 10, CAR, 0.9)], [((0, 0, 10, 10), TRUCK)], (1, 0, 0)),
        # a person is no vehicle
        ([(0, 0, 10, 10, PERSON, 0.9)], [((0, 0, 10, 10), CAR)], (0, 1, 1)),
        # one-to-one: the second box on the same object is false
        ([(0, 0, 10, 10, CAR, 0.9), (0, 0, 10, 11, CAR, 0.8)], [((0, 0, 10, 10), CAR)], (1, 1, 0)),
        # IoU of exactly one half counts
        ([(0, 0, 10, 5, CAR, 0.9)], [((0, 0, 10, 10), CAR)], (1, 0, 0)),
        ([], [((0, 0, 10, 10), CAR)], (0, 0, 1)),
        ([(0, 0, 10, 10, CAR, 0.9)], [], (0, 1, 0)),
        ([], [], (0, 0, 0)),
        # the better score chooses first
        (
            [(0, 0, 10, 10, CAR, 0.5), (2, 0, 12, 10, CAR, 0.9)],
            [((1, 0, 11, 10), CAR), ((30, 0, 40, 10), CAR)],
            (1, 1, 1),
        ),
    ],
)
def test_matching_by_hand(found: list, truth: list, expected: tuple[int, int, int]) -> None:
    boxes = np.array([box for box, _ in truth], np.float32).reshape(-1, 4)
    classes = np.array([class_id for _, class_id in truth], np.int32)
    counts = match_detections(detections(*found), boxes, classes)
    assert (counts.true_positives, counts.false_positives, counts.false_negatives) == expected


def test_objects_that_are_not_asked_for_are_neither_miss_nor_mistake() -> None:
    boxes = np.array([[0, 0, 10, 10], [50, 50, 52, 52]], np.float32)
    classes = np.array([CAR, CAR], np.int32)
    found = detections((50, 50, 52, 52, CAR, 0.9))
    counts = match_detections(found, boxes, classes, counted=np.array([True, False]))
    assert (counts.true_positives, counts.false_positives, counts.false_negatives) == (0, 0, 1)


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        # half of the detection lies in the region
        ((95, 0, 105, 10), (0, 0, 1)),
        # a little less than half
        ((94, 0, 104, 10), (0, 1, 1)),
        # halves in two regions that touch make one of them hold half
        ((195, 0, 205, 10), (0, 0, 1)),
        # a region doesn't take a detection away from an object
        ((100, 0, 110, 10), (1, 0, 0)),
    ],
)
def test_detections_in_ignored_regions(found: tuple[float, ...], expected: tuple[int, int, int]) -> None:
    boxes, classes = np.array([[100, 0, 110, 10]], np.float32), np.array([CAR], np.int32)
    regions = np.array([[100, 0, 200, 50], [200, 0, 300, 50]], np.float32)
    found_row = detections((*found, CAR, 0.9))  # type: ignore[arg-type]
    counts = match_detections(found_row, boxes, classes, ignored_boxes=regions)
    assert (counts.true_positives, counts.false_positives, counts.false_negatives) == expected


def test_an_ignored_region_never_fills_up() -> None:
    many = detections(*[(10 * i, 0, 10 * i + 9, 9, CAR, 0.9) for i in range(5)])
    nothing = np.zeros((0, 4), np.float32), np.zeros(0, np.int32)
    region = np.array([[0, 0, 100, 100]], np.float32)
    assert match_detections(many, *nothing, ignored_boxes=region) == MatchCounts(0, 0, 0)
    assert match_detections(many, *nothing) == MatchCounts(0, 5, 0)


@given(
    st.integers(1, 30),
    st.integers(1, 30),
    st.lists(st.tuples(st.integers(-5, 30), st.integers(-5, 30), st.integers(1, 20), st.integers(1, 20)), max_size=6),
    st.randoms(use_true_random=False),
)
def test_overlap_equals_counting_pixels(height: int, width: int, corners: list, random: object) -> None:
    roi = np.random.default_rng(random.randint(0, 2**31)).random((height, width)) < 0.5  # type: ignore[attr-defined]
    boxes = np.array([[x, y, x + w, y + h] for x, y, w, h in corners], np.float32).reshape(-1, 4)
    got = roi_overlap(boxes, roi)
    for (x, y, w, h), share in zip(corners, got, strict=True):
        cells = [
            roi[row, column]
            for row in range(max(y, 0), min(y + h, height))
            for column in range(max(x, 0), min(x + w, width))
        ]
        assert share == pytest.approx(sum(cells) / len(cells) if cells else 0.0)


def test_recognition_curve_by_hand() -> None:
    """A box of 100 x 10 pixels of which the left 60 columns were sent."""
    roi = np.zeros((20, 200), np.bool_)
    roi[:, :60] = True
    curve = recognition_curve(np.array([[0, 0, 100, 10], [150, 0, 160, 10]], np.float32), roi)
    assert curve.tolist() == [1, 1, 1, 0, 0]


def test_retention_by_hand() -> None:
    whole = detections((0, 0, 10, 10, CAR, 0.9), (30, 0, 40, 10, CAR, 0.8))
    roi_only = detections((0, 0, 10, 10, TRUCK, 0.7), (80, 0, 90, 10, CAR, 0.6))
    counts = retained(whole, roi_only)
    assert (counts.retained, counts.reference_count, counts.spurious) == (1, 2, 1)


def test_pooled_and_per_frame_scores_differ_as_the_paper_s_table_shows() -> None:
    frames = [MatchCounts(9, 1, 0), MatchCounts(0, 0, 5)]
    pooled = scores_of(frames[0] + frames[1])
    assert pooled.recall == pytest.approx(9 / 14)
    assert pooled.precision == pytest.approx(0.9)
    mean = macro_frame(frames)
    assert mean.recall == pytest.approx(0.5)
    assert mean.f1 == pytest.approx((2 * 0.9 / 1.9 + 0) / 2)


@pytest.mark.parametrize(
    ("counts", "recall", "precision", "f1"),
    [
        (MatchCounts(0, 0, 0), 1.0, 1.0, 1.0),
        (MatchCounts(0, 2, 0), None, 0.0, 0.0),
        (MatchCounts(0, 0, 2), 0.0, 0.0, 0.0),
    ],
    ids=["nothing-there-nothing-found", "nothing-there", "nothing-found"],
)
def test_empty_frames(counts: MatchCounts, recall: float | None, precision: float, f1: float) -> None:
    scores = macro_frame([counts])
    assert (scores.recall, scores.precision, scores.f1) == (recall, precision, f1)


def test_visible_truth_asks_for_height_and_openness() -> None:
    truth = GroundTruth(
        np.array([[0, 0, 9, 25], [0, 0, 9, 24], [0, 0, 9, 90]], np.float32),
        np.array([2, 2, 2], np.int32),
        np.arange(3, dtype=np.int32),
        np.array([1.0, 1.0, 0.4], np.float32),
    )
    assert visible_truth(truth).tolist() == [True, False, False]


def test_variants_groups_and_sizes_of_the_truth() -> None:
    heights = [24.9, 25, 49, 50, 99, 100, 300]
    classes = [0, 1, 3, 2, 5, 7, 16]
    truth = GroundTruth(
        np.array([[0, 0, 9, height] for height in heights], np.float32),
        np.array(classes, np.int32),
        np.arange(7, dtype=np.int32),
        np.ones(7, np.float32),
    )
    assert [SIZE_BINS[place] for place in size_bins(truth)] == [
        "<25 px",
        *["25-50 px"] * 2,
        *["50-100 px"] * 2,
        *[">=100 px"] * 2,
    ]
    assert [GROUPS[place] for place in group_indices(truth.class_ids)[:6]] == [
        "pedestrian",
        *["cyclist"] * 2,
        *["vehicle"] * 3,
    ]
    # an animal is of no counted class
    assert asked_truth(truth, "all").tolist() == [True] * 6 + [False]
    assert asked_truth(truth, "visible").tolist() == [False, *[True] * 5, False]


def test_retention_pools() -> None:
    pooled = RetentionCounts(1, 2, 1) + RetentionCounts(3, 3, 0)
    assert (pooled.rate, pooled.spurious_rate) == (pytest.approx(4 / 5), pytest.approx(1 / 5))
    nothing = RetentionCounts(0, 0, 0)
    assert (nothing.rate, nothing.spurious_rate) == (None, None)


def test_mask_overlap_pools_pixels() -> None:
    first, second = np.zeros((4, 4), np.bool_), np.zeros((4, 4), np.bool_)
    first[:2] = second[1:3] = True
    pooled = mask_overlap(first, second) + mask_overlap(first, first)
    assert pooled == MaskOverlap(4 + 8, 12 + 8)
    assert pooled.iou == pytest.approx(12 / 20)
    assert MaskOverlap(0, 0).iou == 1


def test_mask_iou_by_hand() -> None:
    first, second = np.zeros((4, 4), np.bool_), np.zeros((4, 4), np.bool_)
    assert mask_iou(first, second) == 1
    first[:2] = second[1:3] = True
    assert mask_iou(first, second) == pytest.approx(4 / 12)


def test_percentiles_of_a_known_sample() -> None:
    values = percentiles([*range(101), None])
    assert values is not None
    assert (values.p50, values.p95, values.p99) == (50, 95, 99)
    assert percentiles([None]) is None
