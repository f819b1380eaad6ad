"""The ONNX detector on graphs with known answers, on a literal slow reference, and on a real frame."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from cable_models import DetectedBoxes, ModelError
from hypothesis import given, settings
from hypothesis import strategies as st

onnx = pytest.importorskip("onnx", reason="building test graphs needs onnx")
ort = pytest.importorskip("onnxruntime", reason="the detector runs on onnxruntime")

from cable_models.rtdetr import CropConfig, DetectorSettings, OnnxDetector, SessionSettings  # noqa: E402
from cable_models.rtdetr.labels import COCO80_NAMES, coco_index_table  # noqa: E402
from cable_models.rtdetr.postprocess import decode_logits, first_of_duplicates, pairwise_iou  # noqa: E402
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

SHARED = Path(__file__).resolve().parents[3] / "shared"
FEMTO = SHARED / "weights/deimv2_hgnetv2_femto_coco/deimv2_hgnetv2_femto_coco.onnx"
KITTI = SHARED / "data/kitti-tracking-0002/training"


def constant(name: str, values: object, dtype: type) -> onnx.NodeProto:
    return helper.make_node("Constant", [], [name], value=numpy_helper.from_array(np.array(values, dtype)))


def save(path: Path, nodes: list, inputs: list, outputs: list, metadata: dict[str, str] | None = None) -> Path:
    graph = helper.make_graph(nodes, "tiny", inputs, outputs)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, metadata or {})
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


def batch_repeat(source: str, target: str, image: str) -> list:
    """Nodes that repeat ``source`` [1, ...] over the batch of ``image``; + 0 * mean keeps the image in use."""
    return [
        helper.make_node("ReduceMean", [image], [f"{target}_mean"], axes=[1, 2, 3], keepdims=1),
        helper.make_node("Squeeze", [f"{target}_mean", "axis_3"], [f"{target}_mean3"]),
        helper.make_node("Mul", [f"{target}_mean3", "zero"], [f"{target}_nought"]),
        helper.make_node("Add", [source, f"{target}_nought"], [target]),
    ]


def rtdetr_graph(
    path: Path,
    labels: list[int],
    boxes: list[list[float]],
    scores: list[float],
    batch: int | str = "N",
    size: tuple[int | str, int | str] = (32, 48),
    metadata: dict[str, str] | None = None,
) -> Path:
    """Boxes are shares of the original size; a last detection of class 0 scores the mean of the R plane."""
    labels, boxes = [*labels, 0], [*boxes, [0.0, 0.0, 1.0, 1.0]]
    nodes = [
        constant("zero", 0.0, np.float32),
        constant("axis_3", [3], np.int64),
        constant("box_shares", [boxes], np.float32),
        constant("label_values", np.array(labels, np.float32)[None, :, None], np.float32),
        constant("score_values", np.array([*scores, 0.0], np.float32)[None], np.float32),
        constant("last", np.array([0.0] * len(scores) + [1.0], np.float32)[None], np.float32),
        constant("axis_1", [1], np.int64),
        constant("axis_2", [2], np.int64),
        constant("plane_0", [0], np.int64),
        constant("plane_1", [1], np.int64),
        helper.make_node("Cast", ["orig_target_sizes"], ["sizes"], to=TensorProto.FLOAT),
        helper.make_node("Concat", ["sizes", "sizes"], ["sizes4"], axis=1),
        helper.make_node("Unsqueeze", ["sizes4", "axis_1"], ["scale"]),
        helper.make_node("Mul", ["box_shares", "scale"], ["boxes"]),
        *batch_repeat("label_values", "labels_float", "images"),
        helper.make_node("Squeeze", ["labels_float", "axis_2"], ["labels_flat"]),
        helper.make_node("Cast", ["labels_flat"], ["labels"], to=TensorProto.INT64),
        helper.make_node("Slice", ["images", "plane_0", "plane_1", "axis_1"], ["red"]),
        helper.make_node("ReduceMean", ["red"], ["red_mean"], axes=[2, 3], keepdims=0),
        helper.make_node("Mul", ["red_mean", "last"], ["red_score"]),
        helper.make_node("Add", ["red_score", "score_values"], ["scores"]),
    ]
    count = len(labels)
    return save(
        path,
        nodes,
        [
            helper.make_tensor_value_info("images", TensorProto.FLOAT, [batch, 3, *size]),
            helper.make_tensor_value_info("orig_target_sizes", TensorProto.INT64, [batch, 2]),
        ],
        [
            helper.make_tensor_value_info("labels", TensorProto.INT64, [batch, count]),
            helper.make_tensor_value_info("boxes", TensorProto.FLOAT, [batch, count, 4]),
            helper.make_tensor_value_info("scores", TensorProto.FLOAT, [batch, count]),
        ],
        metadata,
    )


def transformers_graph(
    path: Path,
    logits: np.ndarray,
    boxes: np.ndarray,
    batch: int | str = "N",
    size: tuple[int | str, int | str] = (32, 48),
    metadata: dict[str, str] | None = None,
) -> Path:
    nodes = [
        constant("zero", 0.0, np.float32),
        constant("axis_3", [3], np.int64),
        constant("logit_values", logits[None], np.float32),
        constant("box_values", boxes[None], np.float32),
        *batch_repeat("logit_values", "logits", "pixel_values"),
        *batch_repeat("box_values", "pred_boxes", "pixel_values"),
    ]
    return save(
        path,
        nodes,
        [helper.make_tensor_value_info("pixel_values", TensorProto.FLOAT, [batch, 3, *size])],
        [
            helper.make_tensor_value_info("logits", TensorProto.FLOAT, [batch, *logits.shape]),
            helper.make_tensor_value_info("pred_boxes", TensorProto.FLOAT, [batch, *boxes.shape]),
        ],
        metadata,
    )


def logit(probability: float) -> float:
    return math.log(probability / (1 - probability))


@pytest.fixture
def black() -> np.ndarray:
    return np.zeros((100, 200, 3), np.uint8)


@pytest.mark.parametrize("batch", ["N", 1, 3])
def test_rtdetr_layout_gives_pixels_of_each_original_image(tmp_path: Path, batch: int | str, black: np.ndarray) -> None:
    path = rtdetr_graph(
        tmp_path / "a.onnx", [2, 0, 11, 7], [[0.1, 0.2, 0.5, 0.6], [0.6, 0, 0.7, 1], [0, 0, 1, 1], [0, 0, 1, 1]],
        [0.9, 0.5, 0.99, 0.39], batch,
    )  # fmt: skip
    detector = OnnxDetector(path, SessionSettings(provider="cpu"))
    assert (detector.signature, detector.input_size_wh, detector.name) == ("rtdetr", (48, 32), "a")
    images = [black, np.zeros((50, 400, 3), np.uint8)] * 2
    found = detector.detect(images)
    assert len(found) == 4
    for image, boxes in zip(images, found, strict=True):
        height, width = image.shape[:2]
        scale = [width, height, width, height]
        assert boxes.class_ids.tolist() == [2, 0]
        np.testing.assert_allclose(boxes.scores, [0.9, 0.5], rtol=1e-6)
        np.testing.assert_allclose(
            boxes.boxes_xyxy, np.array([[0.1, 0.2, 0.5, 0.6], [0.6, 0, 0.7, 1]]) * scale, rtol=1e-5
        )
        assert (boxes.boxes_xyxy.dtype, boxes.class_ids.dtype) == (np.float32, np.int32)


def test_network_sees_rgb_in_0_to_1(tmp_path: Path, black: np.ndarray) -> None:
    detector = OnnxDetector(
        rtdetr_graph(tmp_path / "a.onnx", [2], [[0, 0, 1, 1]], [0.0]), settings=DetectorSettings(min_score=0.1)
    )
    red = black.copy()
    red[..., 2] = 204
    results = detector.detect([red, black, red])
    assert [len(found) for found in results] == [1, 0, 1]
    assert results[0].scores[0] == pytest.approx(204 / 255, abs=1e-5)


def test_transformers_layout_with_its_own_labels(tmp_path: Path, black: np.ndarray) -> None:
    labels = {"0": "Pedestrian", "1": "tree", "2": "van"}
    logits = np.full((3, 3), -20.0)
    logits[0, 2], logits[1, 0], logits[2, 1] = logit(0.8), logit(0.6), logit(0.9)
    boxes = np.array([[0.5, 0.5, 0.2, 0.4], [0.1, 0.5, 0.4, 0.2], [0.5, 0.5, 1, 1]])
    path = transformers_graph(tmp_path / "a.onnx", logits, boxes, metadata={"labels": json.dumps(labels)})
    detector = OnnxDetector(path)
    assert detector.signature == "transformers"
    assert detector.labels == {0: "Pedestrian", 1: "tree", 2: "van"}
    (found,) = detector.detect([black])
    assert found.class_ids.tolist() == [2, 0]
    np.testing.assert_allclose(found.scores, [0.8, 0.6], atol=1e-6)
    # the second box reaches out of the image on the left and is clipped
    np.testing.assert_allclose(found.boxes_xyxy, [[80, 30, 120, 70], [0, 40, 60, 60]], atol=1e-3)


def test_dynamic_image_size_comes_from_metadata_or_is_640(tmp_path: Path) -> None:
    logits, boxes = np.zeros((2, 80)), np.full((2, 4), 0.5)
    plain = transformers_graph(tmp_path / "a.onnx", logits, boxes, size=("h", "w"))
    assert OnnxDetector(plain).input_size_wh == (640, 640)
    sized = transformers_graph(
        tmp_path / "b.onnx", logits, boxes, size=("h", "w"), metadata={"input_width": "96", "input_height": "64"}
    )
    detector = OnnxDetector(sized)
    assert detector.input_size_wh == (96, 64)
    assert detector.tensor.shape == (1, 3, 64, 96)


def test_second_label_of_one_object_is_dropped_but_neighbours_stay(tmp_path: Path, black: np.ndarray) -> None:
    box, shifted = [0.1, 0.1, 0.5, 0.5], [0.12, 0.1, 0.52, 0.5]
    path = rtdetr_graph(
        tmp_path / "a.onnx", [7, 2, 0, 2, 3, 1], [box, shifted, box, [0.3, 0.1, 0.7, 0.5], box, box],
        [0.6, 0.9, 0.8, 0.5, 0.45, 0.41],
    )  # fmt: skip
    (found,) = OnnxDetector(path).detect([black])
    # truck .6 is the car .9 again, and bicycle .41 the motorcycle .45; a person there is someone else
    assert found.class_ids.tolist() == [2, 0, 2, 3]
    (everything,) = OnnxDetector(path, settings=DetectorSettings(deduplicate=False)).detect([black])
    assert everything.class_ids.tolist() == [2, 0, 7, 2, 3, 1]


def test_only_wanted_classes_and_scores_are_reported(tmp_path: Path, black: np.ndarray) -> None:
    boxes = [[0, 0, 0.2, 0.2], [0.4, 0.4, 0.6, 0.6], [0.7, 0.7, 1, 1]]
    path = rtdetr_graph(tmp_path / "a.onnx", [2, 11, 0], boxes, [0.3, 0.9, 0.9])
    (found,) = OnnxDetector(path, settings=DetectorSettings(0.25, (2, 11))).detect([black])
    assert found.class_ids.tolist() == [11, 2]
    assert OnnxDetector(path).detect([]) == []


def literal_reference(logits: np.ndarray, boxes: np.ndarray, width: int, height: int) -> list[tuple]:
    """RTDetrImageProcessor.post_process_object_detection, one entry at a time."""
    entries = []
    for query, row in enumerate(logits):
        for label, value in enumerate(row):
            cx, cy, w, h = boxes[query]
            corners = ((cx - w / 2) * width, (cy - h / 2) * height, (cx + w / 2) * width, (cy + h / 2) * height)
            entries.append((1 / (1 + math.exp(-value)), label, corners))
    entries.sort(key=lambda entry: -entry[0])
    return entries[: len(logits)]


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 12), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_decode_logits_equals_the_literal_post_processing(queries: int, classes: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    logits = rng.normal(0, 3, (queries, classes)).astype(np.float32)
    boxes = rng.random((queries, 4)).astype(np.float32)
    labels, corners, scores = decode_logits(logits, boxes, (320, 180))
    for row, (score, label, box) in enumerate(literal_reference(logits, boxes, 320, 180)):
        assert scores[row] == pytest.approx(score, abs=1e-6)
        assert labels[row] == label
        np.testing.assert_allclose(corners[row], box, atol=1e-3)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 15), st.integers(0, 2**32 - 1))
def test_duplicate_removal_equals_a_loop(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 6, (count, 2))
    boxes = np.concatenate([low, low + rng.integers(4, 14, (count, 2))], axis=1).astype(np.float32)
    groups = rng.integers(0, 2, count).astype(np.int32)
    keep = first_of_duplicates(boxes, groups)
    kept: list[int] = []
    for row in range(count):
        rivals = [
            other for other in kept if groups[other] == groups[row] and literal_iou(boxes[other], boxes[row]) > 0.7
        ]
        if not rivals:
            kept.append(row)
    assert np.flatnonzero(keep).tolist() == kept


def literal_iou(a: np.ndarray, b: np.ndarray) -> float:
    w = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
    h = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - w * h
    return float(w * h / union)


def test_coco_names_stand_in_their_places() -> None:
    assert len(set(COCO80_NAMES)) == 80
    places = {0: "person", 1: "bicycle", 2: "car", 3: "motorcycle", 5: "bus", 7: "truck", 79: "toothbrush"}
    assert {index: COCO80_NAMES[index] for index in places} == places
    assert coco_index_table({0: "cyclist", 1: "unicorn"}).tolist() == [1, -1]


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((10, 10, 3), np.float32), "float32"),
        (np.zeros((10, 10), np.uint8), r"\(10, 10\)"),
        (np.zeros((10, 10, 4), np.uint8), "BGR"),
        (np.zeros((0, 10, 3), np.uint8), r"\(0, 10, 3\)"),
        ("frame.png", "str"),
    ],
)
def test_bad_images_are_refused(tmp_path: Path, image: object, message: str, black: np.ndarray) -> None:
    detector = OnnxDetector(rtdetr_graph(tmp_path / "a.onnx", [2], [[0, 0, 1, 1]], [0.9]))
    with pytest.raises(ModelError, match=message):
        detector.detect([black, image])  # type: ignore[list-item]


def test_missing_and_damaged_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"no detector file .*gone\.onnx"):
        OnnxDetector(tmp_path / "gone.onnx")
    damaged = tmp_path / "text.onnx"
    damaged.write_text("not a graph")
    with pytest.raises(ModelError, match="not a usable ONNX model"):
        OnnxDetector(damaged)


def test_unknown_layouts_list_what_was_found_and_what_is_accepted(tmp_path: Path) -> None:
    path = save(
        tmp_path / "other.onnx",
        [helper.make_node("Identity", ["frames"], ["raw"])],
        [helper.make_tensor_value_info("frames", TensorProto.FLOAT, [1, 3, 8, 8])],
        [helper.make_tensor_value_info("raw", TensorProto.FLOAT, [1, 3, 8, 8])],
    )
    with pytest.raises(ModelError, match=r"frames tensor\(float\) \[1, 3, 8, 8\] -> raw.*pixel_values"):
        OnnxDetector(path)


@pytest.mark.parametrize(
    ("classes", "metadata", "message"),
    [
        (5, None, "5 classes but COCO"),
        (80, {"labels": '{"0": "car"}'}, "80 classes but its 'labels' metadata names 1"),
        (1, {"labels": "car, bus"}, "JSON"),
        (2, {"labels": '{"0": "car", "5": "bus"}'}, r"0\.\.n-1"),
    ],
)
def test_class_counts_must_fit_the_labels(
    tmp_path: Path, classes: int, metadata: dict[str, str] | None, message: str
) -> None:
    path = transformers_graph(tmp_path / "a.onnx", np.zeros((2, classes)), np.zeros((2, 4)), metadata=metadata)
    with pytest.raises(ModelError, match=message):
        OnnxDetector(path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SessionSettings(threads=0), "threads"),
        (lambda: SessionSettings(device_id=-1), "GPU"),
        (lambda: DetectorSettings(min_score=1.5), "min_score"),
        (lambda: DetectorSettings(class_ids=(2, 80)), "80"),
        (lambda: DetectorSettings(max_batch=0), "max_batch"),
        (lambda: CropConfig(min_share=0), "crop"),
    ],
)
def test_impossible_settings_are_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        make()


def kitti_cars(frame: int, min_height: float) -> np.ndarray:
    rows = [line.split() for line in (KITTI / "label_02/0002.txt").read_text().splitlines()]
    boxes = [
        [float(value) for value in row[6:10]]
        for row in rows
        if int(row[0]) == frame and row[2] == "Car" and row[3] == "0" and row[4] == "0"
    ]
    return np.array([box for box in boxes if box[3] - box[1] >= min_height], np.float32).reshape(-1, 4)


@pytest.mark.skipif(not (FEMTO.is_file() and KITTI.is_dir()), reason="shared weights or KITTI frames are absent")
def test_real_detector_finds_the_large_free_cars_of_kitti() -> None:
    detector = OnnxDetector(FEMTO, settings=DetectorSettings(min_score=0.3))
    assert detector.signature == "rtdetr"
    truth = {frame: boxes for frame in range(36, 66) if len(boxes := kitti_cars(frame, min_height=30))}
    overlaps: list[float] = []
    for frame, cars in truth.items():
        (found,) = detector.detect([cv2.imread(str(KITTI / f"image_02/0002/{frame:06d}.png"))])
        assert isinstance(found, DetectedBoxes)
        vehicles = found.select(np.isin(found.class_ids, (2, 5, 7)))
        overlaps += pairwise_iou(cars, vehicles.boxes_xyxy).max(axis=1, initial=0).tolist()
    assert len(overlaps) >= 10
    assert min(overlaps) > 0.7
