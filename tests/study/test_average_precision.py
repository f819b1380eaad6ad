"""AP and match counts against faster-coco-eval, and against COCO's evaluation written out literally."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from cable_rpc.study.metrics import (
    AP_IOU_THRESHOLDS,
    GROUPS,
    average_precision,
    box_iou,
    group_indices,
    inside_share,
    join_matches,
    match_detections,
    match_frame,
    ranked_matches,
)
from cable_rpc.study.metrics.average_precision import drawn_average_precision
from cable_rpc.types import Detections

CLASSES = (0, 1, 3, 2, 5, 7, 16)
KITTI = (
    Path(__file__).resolve().parents[3]
    / "shared"
    / "data"
    / "kitti-tracking-0002"
    / "training"
    / "label_02"
    / "0002.txt"
)
KITTI_CLASSES = {"Pedestrian": 0, "Cyclist": 1, "Car": 2, "Van": 2, "Truck": 7}
OUT_OF_RANGE = 1e9


@dataclass(frozen=True)
class Scene:
    """One frame: detections, truth, which of it is asked for, and unannotated regions."""

    found: Detections
    boxes: np.ndarray
    classes: np.ndarray
    asked: np.ndarray
    regions: np.ndarray


def scenes(seed: int, count: int = 12, regions: int = 2) -> list[Scene]:
    """Crowded frames in which detections compete for objects; coordinates on a fine grid, so no sum is rounded."""
    random = np.random.default_rng(seed)

    def boxes_of(number: int, largest: float) -> np.ndarray:
        corner = random.integers(0, 800, (number, 2)) / 4
        return np.hstack([corner, corner + random.integers(8, int(4 * largest), (number, 2)) / 4]).astype(np.float32)

    made = []
    for _ in range(count):
        truth = boxes_of(int(random.integers(0, 10)), 60)
        classes = random.choice(CLASSES, len(truth)).astype(np.int32)
        near = np.repeat(truth, 3, axis=0) + random.integers(-24, 25, (3 * len(truth), 4)) / 4
        near[:, 2:] = np.maximum(near[:, 2:], near[:, :2] + 1)
        boxes = np.vstack([near, boxes_of(int(random.integers(0, 12)), 60)]).astype(np.float32)
        labels = np.concatenate([np.repeat(classes, 3), random.choice(CLASSES, len(boxes) - 3 * len(truth))])
        found = Detections(boxes, labels.astype(np.int32), random.random(len(boxes)).astype(np.float32))
        made.append(Scene(found, truth, classes, random.random(len(truth)) < 0.75, boxes_of(regions, 90)))
    return made


def kitti_scenes() -> list[Scene]:
    """Every tenth frame of a real drive with its DontCare regions; each object found three times, more or less."""
    if not KITTI.is_file():
        pytest.skip("the KITTI tracking sample is not in the shared folder")
    random = np.random.default_rng(11)
    rows = [line.split() for line in KITTI.read_text(encoding="ascii").splitlines()]
    made = []
    for frame in range(0, 1 + max(int(row[0]) for row in rows), 10):
        here = [row for row in rows if int(row[0]) == frame]
        objects = [row for row in here if row[2] in KITTI_CLASSES]
        boxes = np.array([row[6:10] for row in objects], np.float32).reshape(-1, 4)
        regions = np.array([row[6:10] for row in here if row[2] == "DontCare"], np.float32).reshape(-1, 4)
        classes = np.array([KITTI_CLASSES[row[2]] for row in objects], np.int32)
        size = np.repeat(np.hstack([boxes[:, 2:] - boxes[:, :2]] * 2), 3, axis=0)
        near = np.repeat(boxes, 3, axis=0) + random.normal(0, 0.08, size.shape) * size
        strays = np.vstack([regions, regions + 15, [[600, 150, 640, 190]]])
        found = np.round(np.vstack([near, strays]), 2).astype(np.float32)
        labels = np.concatenate([np.repeat(classes, 3), random.choice([0, 2], len(strays))]).astype(np.int32)
        visible = boxes[:, 3] - boxes[:, 1] >= 25
        made.append(
            Scene(
                Detections(found, labels, random.random(len(found)).astype(np.float32)),
                boxes,
                classes,
                visible,
                regions,
            )
        )
    return made


def coco_dict(truth: list[Scene]) -> dict:
    """COCO annotations: groups as categories, uncounted objects out of the area range, regions as crowds."""
    annotations = []
    for image, scene in enumerate(truth):
        for box, group, asked in zip(scene.boxes, group_indices(scene.classes), scene.asked, strict=True):
            if group >= 0:
                annotations.append(annotation(len(annotations) + 1, image, int(group), box, crowd=0, asked=bool(asked)))
        for box in scene.regions:
            for group in range(len(GROUPS)):
                annotations.append(annotation(len(annotations) + 1, image, group, box, crowd=1, asked=True))
    return {
        "images": [{"id": image, "width": 400, "height": 400} for image in range(len(truth))],
        "categories": [{"id": group, "name": name} for group, name in enumerate(GROUPS)],
        "annotations": annotations,
    }


def annotation(number: int, image: int, group: int, box: np.ndarray, *, crowd: int, asked: bool) -> dict:
    x0, y0, x1, y1 = map(float, box)
    area = (x1 - x0) * (y1 - y0) if asked else OUT_OF_RANGE
    corner = {"bbox": [x0, y0, x1 - x0, y1 - y0], "area": area, "iscrowd": crowd}
    return {"id": number, "image_id": image, "category_id": group, **corner}


def coco_results(frames: list[Scene]) -> list[dict]:
    rows = []
    for image, scene in enumerate(frames):
        found = scene.found
        for box, group, score in zip(found.boxes_xyxy, group_indices(found.class_ids), found.scores, strict=True):
            if group >= 0:
                x0, y0, x1, y1 = map(float, box)
                bbox = [x0, y0, x1 - x0, y1 - y0]
                rows.append({"image_id": image, "category_id": int(group), "bbox": bbox, "score": float(score)})
    return rows


def library_evaluation(frames: list[Scene]) -> dict:
    """faster-coco-eval's ``eval`` over one area range that the uncounted objects are outside of."""
    faster_coco_eval = pytest.importorskip("faster_coco_eval")
    with contextlib.redirect_stdout(io.StringIO()):
        truth = faster_coco_eval.COCO(coco_dict(frames))
        found = truth.loadRes(coco_results(frames))
        evaluation = faster_coco_eval.COCOeval_faster(truth, found, "bbox", print_function=lambda *_: None)
        evaluation.params.areaRng = [[0, OUT_OF_RANGE / 10]]
        evaluation.params.areaRngLbl = ["all"]
        evaluation.params.maxDets = [100]
        evaluation.evaluate()
        evaluation.accumulate()
    return evaluation.eval


def ours(frames: list[Scene]) -> list[list]:
    """Per frame, per class group."""
    matched = [
        match_frame(
            scene.found,
            scene.boxes,
            scene.classes,
            AP_IOU_THRESHOLDS,
            counted=scene.asked,
            ignored_boxes=scene.regions,
            region_shares=AP_IOU_THRESHOLDS,
        )
        for scene in frames
    ]
    return [list(ranked_matches(one)) for one in matched]


def pooled(frames: list[Scene]) -> list:
    return [join_matches(parts) for parts in zip(*ours(frames), strict=True)]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("regions", [0, 2])
def test_ap_is_that_of_faster_coco_eval(seed: int, regions: int) -> None:
    frames = scenes(seed, regions=regions)
    precision = np.asarray(library_evaluation(frames)["precision"])  # [T, R, K, A, M]
    found = average_precision(pooled(frames))
    assert found is not None
    groups = pooled(frames)
    for group in range(len(GROUPS)):
        alone = average_precision([groups[group]])
        assert alone is not None
        assert alone == pytest.approx(precision[:, :, group, 0, 0].mean(axis=1), abs=1e-12)
    assert found == pytest.approx(precision[:, :, :, 0, 0].mean(axis=(1, 2)), abs=1e-12)


def test_ap_of_a_real_drive_is_that_of_faster_coco_eval() -> None:
    frames = kitti_scenes()
    assert sum(len(scene.regions) for scene in frames) > 10
    precision = np.asarray(library_evaluation(frames)["precision"])[:, :, :, 0, 0]
    present = [group for group in range(len(GROUPS)) if (precision[:, :, group] > -1).any()]
    assert average_precision(pooled(frames)) == pytest.approx(precision[:, :, present].mean(axis=(1, 2)), abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_match_counts_are_those_of_faster_coco_eval(seed: int) -> None:
    """Its last recall times the objects asked for are the true positives; without regions, all else is false."""
    frames = scenes(seed, regions=0)
    recall = np.asarray(library_evaluation(frames)["recall"])[:, :, 0, 0]  # [T, K]
    for row, iou in ((0, 0.5), (5, 0.75)):
        for group in range(len(GROUPS)):
            right = asked = 0
            for scene in frames:
                keep = group_indices(scene.found.class_ids) == group
                same = group_indices(scene.classes) == group
                boxes, classes = scene.boxes[same], scene.classes[same]
                counts = match_detections(scene.found.select(keep), boxes, classes, iou, counted=scene.asked[same])
                right += counts.true_positives
                asked += counts.true_positives + counts.false_negatives
            assert right == round(recall[row, group] * asked)


def literal_match(scene: Scene, iou: float, region_share: float) -> tuple[int, int, int]:
    """``COCOeval.evaluateImg`` of all groups, loop for loop, with one share for regions."""
    overlaps = box_iou(scene.found.boxes_xyxy, scene.boxes)
    inside = inside_share(scene.found.boxes_xyxy, scene.regions)
    found_groups, true_groups = group_indices(scene.found.class_ids), group_indices(scene.classes)
    taken: set[int] = set()
    right = wrong = 0
    for row in sorted(range(len(scene.found)), key=lambda place: -scene.found.scores[place]):
        if found_groups[row] < 0:
            continue
        reachable = [
            place
            for place in range(len(scene.boxes))
            if place not in taken and true_groups[place] == found_groups[row] and overlaps[row, place] >= iou
        ]
        wanted = [place for place in reachable if scene.asked[place]]
        if wanted:
            taken.add(max(wanted, key=lambda place: overlaps[row, place]))
            right += 1
        elif inside[row] >= region_share and all(inside[row] > overlaps[row, place] for place in reachable):
            pass
        elif reachable:
            taken.add(max(reachable, key=lambda place: overlaps[row, place]))
        else:
            wrong += 1
    return right, wrong, int(np.count_nonzero(scene.asked & (true_groups >= 0))) - right


@pytest.mark.parametrize("iou", [0.3, 0.5, 0.75])
def test_counts_are_those_of_the_literal_loop(iou: float) -> None:
    excused = 0
    for scene in scenes(41, count=40):
        counts = match_detections(
            scene.found, scene.boxes, scene.classes, iou, counted=scene.asked, ignored_boxes=scene.regions
        )
        assert (counts.true_positives, counts.false_positives, counts.false_negatives) == literal_match(scene, iou, 0.5)
        excused += (
            int((group_indices(scene.found.class_ids) >= 0).sum()) - counts.true_positives - counts.false_positives
        )
    assert excused > 20


def test_the_best_detections_are_matched_as_if_they_were_alone() -> None:
    for scene in scenes(5):
        at = match_frame(scene.found, scene.boxes, scene.classes, (0.5,), counted=scene.asked)
        sure = scene.found.select(scene.found.scores >= 0.4)
        alone = match_frame(sure, scene.boxes, scene.classes, (0.5,), counted=scene.asked)
        assert at.counts(0.4).tolist() == alone.counts().tolist()


def test_ap_by_hand() -> None:
    """Two cars; found, false, found: precision 1 up to a recall of 1/2, then 2/3."""
    boxes = np.array([[0, 0, 10, 10], [50, 0, 60, 10]], np.float32)
    found = Detections(
        np.array([[0, 0, 10, 10], [100, 0, 110, 10], [50, 0, 60, 10]], np.float32),
        np.array([2, 2, 7], np.int32),
        np.array([0.9, 0.8, 0.7], np.float32),
    )
    scene = Scene(found, boxes, np.array([2, 5], np.int32), np.ones(2, np.bool_), np.zeros((0, 4), np.float32))
    ap = average_precision(pooled([scene]))
    assert ap is not None
    assert ap == pytest.approx(np.full(10, (51 * 1 + 50 * 2 / 3) / 101))


def test_no_object_no_ap() -> None:
    empty = Scene(
        Detections.empty(), np.zeros((0, 4), np.float32), np.zeros(0, np.int32), np.zeros(0, np.bool_), np.zeros((0, 4))
    )
    assert average_precision(pooled([empty])) is None


def test_a_sequence_drawn_twice_counts_as_its_frames_twice() -> None:
    sequences = [scenes(seed, count=4) for seed in (1, 2, 3)]
    by_sequence = [pooled(frames) for frames in sequences]
    by_group = list(zip(*by_sequence, strict=True))
    weights = np.array([[2, 0, 1], [1, 1, 1], [0, 3, 0]])
    drawn = drawn_average_precision(by_group, weights)
    for row, counts in enumerate(weights):
        repeated = [
            frame for count, frames in zip(counts, sequences, strict=True) for _ in range(count) for frame in frames
        ]
        assert drawn[row] == pytest.approx(average_precision(pooled(repeated)), abs=1e-12)
