"""Figures of sequences and data sets against values worked out by hand and against the frame-wise metrics."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import (
    MatchCounts,
    TruthVariant,
    asked_truth,
    macro_frame,
    match_detections,
    scores_of,
)
from cable_rpc.study.prefill import (
    speedup_flops,
    speedup_mean_of_ratios,
    speedup_of_mean,
    speedup_quadratic,
    token_reduction,
)
from cable_rpc.study.sequence_metrics import (
    AP_FIGURES,
    FIGURES,
    Bootstrap,
    ByteLayers,
    DatasetMetrics,
    FramePrefill,
    MaskOverlap,
    MeasuredFrame,
    SequenceMetrics,
    frame_prefill,
    measure_sequence,
    paired_difference,
    pool,
)
from cable_rpc.types import Detections, GroundTruth, PrefillCost, Segmentation

CAR, PERSON = 2, 0


def truth_of(*rows: tuple[float, float, float, float, int, float]) -> GroundTruth:
    """Rows of x0, y0, x1, y1, class, visibility."""
    table = np.array(rows, np.float64).reshape(-1, 6)
    boxes, classes = table[:, :4].astype(np.float32), table[:, 4].astype(np.int32)
    return GroundTruth(boxes, classes, np.arange(len(table), dtype=np.int32), table[:, 5].astype(np.float32))


def found_of(*rows: tuple[float, float, float, float, int, float]) -> Detections:
    """Rows of x0, y0, x1, y1, class, score."""
    table = np.array(rows, np.float64).reshape(-1, 6)
    return Detections(table[:, :4].astype(np.float32), table[:, 4].astype(np.int32), table[:, 5].astype(np.float32))


def bare_frame(index: int) -> MeasuredFrame:
    """A frame on which nothing was measured but its bytes."""
    nothing = Detections.empty()
    return MeasuredFrame(
        index=index,
        keyframe=False,
        coverage_roi=None,
        coverage_tx=0.0,
        staleness=None,
        truth=None,
        detections=nothing,
        full_detections=nothing,
        overlap_roi=None,
        overlap_sent=None,
        mask_overlap=None,
        bytes_up=ByteLayers(0, 0, 0, 0),
        bytes_down=ByteLayers(0, 0, 0, 0),
        full_bytes_up=None,
    )


def dataset_of(*frames: MeasuredFrame, fps: float | None = None) -> DatasetMetrics:
    return pool([measure_sequence(frames, fps=fps)])


def value(dataset: DatasetMetrics, name: str) -> float | None:
    return dataset.figure(name).value


def random_sequence(seed: int, name: str = "", count: int = 5) -> SequenceMetrics:
    """Frames with competing detections, unannotated regions, low scores and frames without truth."""
    random = np.random.default_rng(seed)
    frames = []
    for index in range(count):
        size = int(random.integers(0, 7))
        corner = random.uniform(0, 300, (size, 2))
        boxes = np.hstack([corner, corner + random.uniform(5, 150, (size, 2))]).astype(np.float32)
        classes = random.choice([0, 1, 2, 7], size).astype(np.int32)
        region = np.array([[0, 0, 60, 60]], np.float32) if index % 2 else None
        truth = replace(truth_of(), boxes_xyxy=boxes, class_ids=classes, track_ids=np.arange(size, dtype=np.int32))
        truth = replace(truth, visibility=random.random(size).astype(np.float32), ignored_boxes_xyxy=region)

        def found(truth: GroundTruth = truth) -> Detections:
            near = truth.boxes_xyxy + random.normal(0, 6, truth.boxes_xyxy.shape)
            corner = random.uniform(0, 300, (4, 2))
            boxes = np.vstack([near, np.hstack([corner, corner + 30])]).astype(np.float32)
            classes = np.concatenate([truth.class_ids, random.choice([0, 1, 2, 7], 4)]).astype(np.int32)
            return Detections(boxes, classes, random.random(len(boxes)).astype(np.float32))

        frames.append(
            MeasuredFrame(
                index=index,
                keyframe=bool(random.random() < 0.2),
                coverage_roi=float(random.random()),
                coverage_tx=float(random.random()),
                staleness=int(random.integers(1, 4)),
                truth=truth if index != 3 else None,
                detections=found(),
                full_detections=found(),
                overlap_roi=random.random(size),
                overlap_sent=random.random(size),
                mask_overlap=MaskOverlap(*sorted(random.integers(0, 99, 2).tolist())),
                bytes_up=ByteLayers(*np.sort(random.integers(1, 999, 4)).tolist()),
                bytes_down=ByteLayers(*np.sort(random.integers(1, 999, 4)).tolist()),
                full_bytes_up=ByteLayers(*np.sort(random.integers(1000, 9999, 4)).tolist()),
                stage_ns={"roi": int(random.integers(1, 10**9))},
                end_to_end_ns=int(random.integers(1, 10**9)),
                prefill=FramePrefill(100, 256, 94, 3.25, 1.75, 7, 11),
            )
        )
    return measure_sequence(frames, name=name, fps=10.0)


def test_coverage_of_r_k_and_of_what_was_sent() -> None:
    """k = 0 has no R_k and counts as sent; the keyframe's R_k counts as R_k."""
    frames = [
        replace(bare_frame(0), coverage_roi=0.9, coverage_tx=0.9),
        replace(bare_frame(1), coverage_roi=0.2, coverage_tx=0.3),
        replace(bare_frame(2), coverage_roi=0.1, coverage_tx=0.5, keyframe=True),
        replace(bare_frame(3), coverage_roi=None, coverage_tx=0.25),
    ]
    data = dataset_of(*frames)
    assert value(data, "coverage_roi") == pytest.approx(0.15)
    assert value(data, "pixel_saving_paper") == pytest.approx(0.85)
    assert value(data, "coverage_tx") == pytest.approx((1 + 0.3 + 1 + 0.25) / 4)
    assert value(data, "pixel_saving") == pytest.approx(1 - 2.55 / 4)
    assert value(data, "keyframe_rate") == pytest.approx(1 / 4 + 1 / 4)
    assert value(data, "refresh_rate") == pytest.approx(1 / 3)


@pytest.mark.parametrize(
    ("coverage", "reduction"),
    [(23.7, 55.8), (13.9, 62.9), (20.3, 58.3), (26.4, 53.8), (19.8, 58.6), (88.2, 8.6), (56.6, 31.8), (6.0, 68.7)],
)
def test_the_papers_token_column_from_its_coverage_column(coverage: float, reduction: float) -> None:
    """Frames that scatter about the printed mean: the token column is linear in coverage."""
    frames = [
        replace(bare_frame(k), coverage_roi=(coverage + offset) / 100, coverage_tx=1.0)
        for k, offset in enumerate((0.0, -5.0, 5.0, -2.5, 2.5))
    ]
    data = dataset_of(*frames)
    assert value(data, "coverage_roi") == pytest.approx(coverage / 100)
    assert 100 * (value(data, "token_reduction_paper") or 0) == pytest.approx(reduction, abs=0.1)
    assert value(data, "token_reduction") == pytest.approx(0.0)


@given(st.lists(st.floats(0, 1), min_size=2, max_size=8))
@settings(max_examples=30)
def test_prefill_estimates_are_those_of_the_frames_coverages(coverages: list[float]) -> None:
    data = dataset_of(*[replace(bare_frame(k), coverage_roi=c, coverage_tx=c) for k, c in enumerate(coverages)])
    later, sent = coverages[1:], [1.0, *coverages[1:]]
    assert value(data, "prefill_quadratic_paper") == pytest.approx(speedup_mean_of_ratios(later))
    assert value(data, "prefill_quadratic_roi") == pytest.approx(speedup_of_mean(later))
    assert value(data, "prefill_quadratic") == pytest.approx(speedup_of_mean(sent))
    assert value(data, "prefill_flops_paper") == pytest.approx(np.mean([speedup_flops(c) for c in later]))
    assert value(data, "prefill_flops") == pytest.approx(1 / np.mean([1 / speedup_flops(c) for c in sent]))
    assert value(data, "token_reduction") == pytest.approx(np.mean([token_reduction(c) for c in sent]))
    assert (value(data, "prefill_quadratic") or 0) <= (value(data, "prefill_quadratic_paper") or 0) * (1 + 1e-12)


def test_prefill_by_what_entered_the_model() -> None:
    """350 tokens whole; one frame kept all of them, one kept 175."""
    frames = [
        replace(bare_frame(0), prefill=FramePrefill(256, 256, 94, 1.0, 1.0, 100, 100)),
        replace(bare_frame(1), prefill=FramePrefill(81, 256, 94, 4.0, 2.0, 40, 120)),
        replace(bare_frame(2), prefill=FramePrefill(81, 256, 94, 4.0, 2.0)),
    ]
    data = dataset_of(*frames)
    assert value(data, "token_reduction_model") == pytest.approx(1 - (350 + 175 + 175) / 1050)
    assert value(data, "prefill_quadratic_model_paper") == pytest.approx((1 + 4 + 4) / 3)
    assert value(data, "prefill_quadratic_model") == pytest.approx(3 / (1 + 1 / 4 + 1 / 4))
    assert value(data, "prefill_flops_model") == pytest.approx(3 / (1 + 1 / 2 + 1 / 2))
    assert value(data, "prefill_measured_paper") == pytest.approx((1 + 3) / 2)
    assert value(data, "prefill_measured") == pytest.approx(220 / 140)


def test_prefill_that_a_segmenter_tells() -> None:
    mask = np.zeros((2, 2), np.bool_)
    ours = Segmentation(mask, 1.0, 50, 256, prefill=PrefillCost(94, speedup_quadratic(0.2), 2.5, 30, 77))
    whole = Segmentation(mask, 1.0, 256, 256, prefill=PrefillCost(94, 1.0, 1.0, 80))
    told = frame_prefill(ours, whole)
    assert told == FramePrefill(50, 256, 94, speedup_quadratic(0.2), 2.5, 30, 80)
    alone = frame_prefill(ours)
    assert alone is not None
    assert alone.whole_ns == 77
    assert frame_prefill(Segmentation(mask, 1.0)) is None
    assert frame_prefill(None, whole) is None


def test_recognition_by_region_variant_group_and_size() -> None:
    truth = truth_of(
        (0, 0, 50, 120, CAR, 1.0),
        (0, 0, 50, 60, CAR, 0.2),
        (0, 0, 10, 30, PERSON, 1.0),
        (0, 0, 90, 90, 16, 1.0),
    )
    first = replace(bare_frame(0), truth=truth, overlap_roi=np.ones(4), overlap_sent=np.ones(4))
    second = replace(first, overlap_roi=np.array([0.5, 0.04, 0.3, 1.0]), overlap_sent=np.array([1.0, 0.05, 0.0, 1.0]))
    data = dataset_of(first, second)
    # R_k counts from the second frame on; the animal never
    assert value(data, "recognition_05") == pytest.approx(2 / 3)
    assert value(data, "recognition_25") == pytest.approx(2 / 3)
    assert value(data, "recognition_50") == pytest.approx(1 / 3)
    assert value(data, "recognition_75") == 0
    assert value(data, "recognition_50_visible") == pytest.approx(1 / 2)
    # and what was sent from the first
    assert value(data, "recognition_05_sent") == pytest.approx(5 / 6)
    assert value(data, "recognition_95_sent_visible") == pytest.approx(3 / 4)
    assert data.recognition(0.5, group="vehicle").value == pytest.approx(1 / 2)
    assert data.recognition(0.05, group="vehicle", size="50-100 px").value == 0
    assert data.recognition(0.05, size="25-50 px").value == 1
    assert data.recognition(0.05, size="<25 px").value is None
    with pytest.raises(ConfigurationError, match="huge"):
        data.recognition(size="huge")


@given(st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_detection_figures_are_those_of_the_frames(seed: int) -> None:
    """The cube against `match_detections` frame by frame, at several thresholds and for both variants."""
    random = np.random.default_rng(seed)
    frames, variants = [], ("all", "visible")
    expected: dict[tuple[str, float], list[MatchCounts]] = {}
    for index in range(3):
        rows = [
            (*(xy := random.uniform(0, 100, 2)), *(xy + random.uniform(10, 80, 2)), random.choice([0, 2, 7]), share)
            for share in random.random(4)
        ]
        truth = truth_of(*rows)  # type: ignore[arg-type]
        near = truth.boxes_xyxy + random.normal(0, 8, (4, 4))
        found = found_of(
            *[(*box, random.choice([0, 2]), score) for box, score in zip(near, random.random(4), strict=True)]
        )
        frames.append(replace(bare_frame(index), truth=truth, detections=found))
        sure = found.select(found.scores >= 0.4)
        for variant in variants:
            asked = asked_truth(truth, variant)  # type: ignore[arg-type]
            for iou in (0.3, 0.5, 0.75):
                counts = match_detections(sure, truth.boxes_xyxy, truth.class_ids, iou, counted=asked)
                expected.setdefault((variant, iou), []).append(counts)
    data = dataset_of(*frames)
    for (variant, iou), counts in expected.items():
        kind: TruthVariant = "all" if variant == "all" else "visible"
        pooled = sum(counts, MatchCounts(0, 0, 0))
        assert data.matches(variant=kind, iou=iou) == pooled
        micro, by_hand = data.detection(variant=kind, iou=iou), scores_of(pooled)
        assert micro.f1.value == pytest.approx(by_hand.f1)
        if pooled.true_positives:
            assert (micro.precision.value, micro.recall.value) == pytest.approx((by_hand.precision, by_hand.recall))
        macro, per_frame = data.detection(variant=kind, iou=iou, average="macro_frame"), macro_frame(counts)
        assert (macro.precision.value, macro.recall.value, macro.f1.value) == pytest.approx(
            (per_frame.precision, per_frame.recall, per_frame.f1)
        )


def test_detection_by_hand() -> None:
    """One car found at IoU 0.6, one weak detection that only AP sees, one person missed."""
    truth = truth_of((0, 0, 10, 100, CAR, 1.0), (50, 0, 60, 100, PERSON, 1.0))
    found = found_of((0, 0, 10, 60, CAR, 0.9), (50, 0, 60, 100, PERSON, 0.2))
    data = dataset_of(replace(bare_frame(0), truth=truth, detections=found, full_detections=found_of()))
    scores = data.detection()
    assert (scores.precision.value, scores.recall.value, scores.f1.value) == pytest.approx((1, 1 / 2, 2 / 3))
    # right at 0.5, 0.55 and 0.6 of the ten thresholds
    assert data.detection(iou=None).recall.value == value(data, "roi_recall_iou50_95") == pytest.approx(0.3 / 2)
    assert value(data, "roi_recall_iou30") == 0.5
    assert data.detection(group="pedestrian").recall.value == 0
    assert data.detection("full").precision.value is None
    assert data.detection("full").recall.value == 0
    assert value(data, "roi_ap50") == pytest.approx(1)
    assert value(data, "roi_ap") == pytest.approx((0.3 + 1) / 2)
    assert data.average_precision(group="vehicle").value == pytest.approx(0.3)
    assert data.average_precision(group="cyclist").value is None
    assert data.average_precision(iou=0.75, group="vehicle").value == 0
    assert value(data, "full_ap50") == 0
    with pytest.raises(ConfigurationError, match=r"0\.4"):
        data.detection(iou=0.4)
    with pytest.raises(ConfigurationError, match=r"0\.3"):
        data.average_precision(iou=0.3)
    with pytest.raises(ConfigurationError, match="all groups together"):
        data.detection(average="macro_frame", group="vehicle")


def test_retention_is_not_blind_to_what_is_invented() -> None:
    whole = found_of((0, 0, 10, 10, CAR, 0.9), (30, 0, 40, 10, CAR, 0.8), (60, 0, 70, 10, CAR, 0.3))
    ours = found_of((0, 0, 10, 6, CAR, 0.9), (80, 0, 90, 10, CAR, 0.5), (30, 0, 40, 10, CAR, 0.39))
    data = dataset_of(replace(bare_frame(0), detections=ours, full_detections=whole))
    assert (value(data, "retention"), value(data, "spurious_rate")) == (0.5, 0.5)
    assert (value(data, "retention_75"), value(data, "spurious_rate_75")) == (0, 1)


def test_masks_layers_latency_and_age() -> None:
    sizes = ByteLayers(100, 110, 120, 200)
    frame = replace(
        bare_frame(0),
        mask_overlap=MaskOverlap(0, 0),
        bytes_up=sizes,
        bytes_down=ByteLayers(10, 10, 30, 60),
        full_bytes_up=ByteLayers(400, 400, 420, 800),
        stage_ns={"roi": 1_000_000},
        end_to_end_ns=5_000_000,
        staleness=1,
    )
    other = replace(
        frame, mask_overlap=MaskOverlap(1, 4), full_bytes_up=None, end_to_end_ns=7_000_000, staleness=3, stage_ns={}
    )
    data = dataset_of(frame, other, fps=4.0)
    assert (value(data, "mask_iou_frames"), value(data, "mask_iou")) == (pytest.approx(1.25 / 2), pytest.approx(1 / 4))
    layer = data.layer("message")
    assert (layer.up_per_frame, layer.down_per_frame, layer.full_up_per_frame) == (120, 30, 420)
    # 240 bytes in half a second
    assert layer.up_kbps == pytest.approx(240 * 8 / 0.5 / 1000)
    # only the frame that was sent whole as well is held against it
    assert layer.saving.value == pytest.approx(1 - 120 / 420)
    assert [one.layer for one in data.layers()] == ["bitstream", "with_roi", "message", "transport"]
    total = data.end_to_end_ms()
    assert total is not None
    assert total.p50 == pytest.approx(6.0)
    assert {stage: tails.p99 for stage, tails in data.stages_ms().items()} == {"roi": 1.0}
    assert (data.staleness(), data.staleness_mean, data.staleness_max) == ({1: 1, 3: 1}, 2.0, 3)


def test_nothing_measured_is_none_throughout() -> None:
    data = dataset_of(bare_frame(0))
    told = {name for name, estimate in data.figures().items() if estimate.value is not None}
    assert told == {
        "coverage_tx",
        "pixel_saving",
        "keyframe_rate",
        "token_reduction",
        "prefill_quadratic",
        "prefill_flops",
    }
    assert (data.end_to_end_ms(), data.staleness_mean, data.seconds) == (None, None, None)


def test_json_and_back_loses_nothing() -> None:
    metrics = random_sequence(3, "drive")
    text = json.dumps(metrics.to_json(), allow_nan=False)
    again = SequenceMetrics.from_json(json.loads(text))
    assert json.dumps(again.to_json()) == text
    assert pool([again]).figures() == pool([metrics]).figures()
    assert again.name == "drive"
    assert again.ranked["roi", "all"][0].scores.dtype == np.float32


@pytest.mark.parametrize(
    "damage",
    [
        {"schema_version": 0},
        {"retention": [[1, 2]]},
        {"layers": {}},
        {"ranked": [{"picture": "roi", "variant": "all", "groups": [{"asked": 1, "scores": "!", "correct": ""}]}]},
        {"masks": {"frames": 1, "colour": 2}},
    ],
)
def test_metrics_that_cant_be_read(damage: dict) -> None:
    with pytest.raises(ConfigurationError, match="again"):
        SequenceMetrics.from_json({**random_sequence(1).to_json(), **damage})


def test_pooling_is_over_frames_and_objects() -> None:
    """Each figure of three sequences is the mean of theirs, weighed by their denominators."""
    sequences = [random_sequence(seed, str(seed), count) for seed, count in ((1, 3), (2, 9), (3, 5))]
    data = pool(sequences, bootstrap=Bootstrap(200))
    for name, figure in FIGURES.items():
        parts = [figure.parts(sequence) for sequence in sequences]
        ratio = sum(np.atleast_1d(part[0]) for part in parts) / sum(np.atleast_1d(part[1]) for part in parts)
        estimate = data.figure(name)
        assert estimate.value == pytest.approx(float(figure.transform(np.mean(ratio, keepdims=True))[0])), name
        assert estimate.interval is not None, name
        assert estimate.interval.low <= estimate.interval.high
    for name in AP_FIGURES:
        interval = data.figure(name).interval
        assert interval is not None
        assert interval.low <= interval.high
    assert pool(sequences[:2], bootstrap=Bootstrap(20)).figure("coverage_tx").interval is None


def test_paired_differences() -> None:
    one = [random_sequence(seed, str(seed)) for seed in (1, 2, 3)]
    other = [random_sequence(seed + 10, str(seed)) for seed in (1, 2, 3)]
    # the order in which the sequences were run does not matter
    shuffled = pool([other[2], other[0], other[1]])
    for name in ("coverage_tx", "roi_recall", "roi_ap50"):
        found = paired_difference(pool(one), shuffled, name, Bootstrap(100))
        first, second = value(pool(one), name), value(pool(other), name)
        assert first is not None
        assert second is not None
        assert found.value == pytest.approx(first - second)
        assert found.interval is not None
        assert found.interval.low <= found.value <= found.interval.high  # type: ignore[operator]
    same = paired_difference(pool(one), pool(one), "coverage_tx", Bootstrap(50))
    assert (same.value, same.interval and same.interval.low, same.interval and same.interval.high) == (0, 0, 0)
    both = paired_difference(pool(one), pool(one), "roi_recall", Bootstrap(50), second_name="full_recall")
    gap = (value(pool(one), "roi_recall") or 0) - (value(pool(one), "full_recall") or 0)
    assert both.value == pytest.approx(gap)
    with pytest.raises(ConfigurationError, match="same sequences"):
        paired_difference(pool(one), pool(other[:2]), "coverage_tx", Bootstrap(5))


def test_what_cant_be_asked() -> None:
    with pytest.raises(ConfigurationError, match="no frame"):
        pool([])
    with pytest.raises(ConfigurationError, match="no frame"):
        pool([measure_sequence([])])
    with pytest.raises(ConfigurationError, match="bandwidth"):
        dataset_of(bare_frame(0)).figure("bandwidth")
