"""A detector that was trained on photographs finds the rendered vehicles."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource

MODEL = (
    Path(__file__).resolve().parents[2].parent
    / "shared/weights/deimv2_hgnetv2_femto_coco/deimv2_hgnetv2_femto_coco.onnx"
)
VEHICLES = (2, 5, 7)


@pytest.fixture(scope="module")
def session() -> Any:
    runtime = pytest.importorskip("onnxruntime")
    if not MODEL.exists():
        pytest.skip(f"shared detector weights are absent: {MODEL.name}")
    settings = runtime.SessionOptions()
    settings.intra_op_num_threads = 1
    return runtime.InferenceSession(str(MODEL), settings, providers=["CPUExecutionProvider"])


def found_and_wanted(session: Any, seeds: Iterable[int], frames: Iterable[int]) -> tuple[int, int]:
    found = wanted = 0
    for seed in seeds:
        source = SyntheticSource(SyntheticConfig(seed=seed))
        for index in frames:
            frame = source.frame(index)
            pixels = cv2.resize(cv2.cvtColor(frame.image, cv2.COLOR_BGR2RGB), (416, 416)).astype(np.float32) / 255
            feed = {
                "images": pixels.transpose(2, 0, 1)[None],
                "orig_target_sizes": np.array([source.size_wh], dtype=np.int64),
            }
            labels, boxes, scores = (part[0] for part in session.run(["labels", "boxes", "scores"], feed))
            boxes = boxes[np.isin(labels, VEHICLES) & (scores >= 0.4)]
            truth = frame.truth
            assert truth is not None
            for box, kind, seen in zip(truth.boxes_xyxy, truth.class_ids, truth.visibility, strict=True):
                if kind in VEHICLES and box[3] - box[1] >= 40 and seen >= 0.7:
                    wanted += 1
                    low, high = np.maximum(box[:2], boxes[:, :2]), np.minimum(box[2:], boxes[:, 2:])
                    shared = np.prod(np.clip(high - low, 0, None), axis=1)
                    union = np.prod(box[2:] - box[:2]) + np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) - shared
                    found += int(bool((shared / union >= 0.5).any()))
    return found, wanted


def test_detector_finds_rendered_vehicles(session: Any) -> None:
    found, wanted = found_and_wanted(session, range(3), (15, 90))
    assert wanted >= 10
    assert found >= 0.7 * wanted


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_detector_finds_rendered_vehicles_over_many_seeds(session: Any) -> None:
    found, wanted = found_and_wanted(session, range(20), (5, 40, 75, 110))
    assert wanted >= 100
    assert found >= 0.7 * wanted
