"""The compact RT-DETR: network, training step, export, the figures it is judged by, and the weights that ship."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
from cable_models import DetectedBoxes, ModelError, embedded_detector_path
from cable_models.rtdetr import OnnxDetector
from cable_models.rtdetr.postprocess import pairwise_iou
from cable_models.training.augment import AugmentConfig, augment, covered_share, mirrored
from cable_models.training.average_precision import Truth, average_precision, class_figures
from cable_models.training.samples import LabelledImage, append_sample, learnable, read_entries

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource

pytest.importorskip("transformers", reason="building the network needs transformers")
torch = pytest.importorskip("torch", reason="building the network needs torch")

from cable_models.rtdetr.compact import CompactRtDetrConfig, build_compact_rtdetr, parameter_count  # noqa: E402
from cable_models.rtdetr.export import export_onnx, verify_export  # noqa: E402
from cable_models.training.train_rtdetr import (  # noqa: E402
    TrainConfig,
    endless_samples,
    learning_rate,
    load_weights,
    train,
    training_size,
)

TINY = CompactRtDetrConfig(
    input_size_wh=(128, 64),
    stem_channels=8,
    stage_channels=(8, 8, 16, 16),
    width=16,
    queries=12,
    decoder_layers=1,
    denoising_queries=4,
)


def squares(rng: np.random.Generator) -> LabelledImage:
    """One bright rectangle, a car, on a dark ground."""
    image = rng.integers(0, 40, (96, 160, 3), dtype=np.uint8)
    x, y = int(rng.integers(0, 100)), int(rng.integers(0, 50))
    image[y : y + 40, x : x + 50] = 230
    box = np.array([[x, y, x + 50, y + 40]], np.float32)
    return LabelledImage(image, box, np.array([2], np.int32), np.ones(1, np.float32))


def test_network_has_the_stated_outputs_and_size() -> None:
    model = build_compact_rtdetr(CompactRtDetrConfig()).train(False)
    assert 0.9e6 < parameter_count(model) < 1.4e6
    with torch.inference_mode():
        output = model(pixel_values=torch.rand(1, 3, 288, 512))
    assert output.logits.shape == (1, CompactRtDetrConfig().queries, 5)
    assert output.pred_boxes.shape == (1, CompactRtDetrConfig().queries, 4)
    # the prior: a fresh network claims about one object in a hundred queries
    assert 0.001 < float(output.logits.sigmoid().mean()) < 0.08


def test_training_lowers_the_loss_and_its_weights_export_truly(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    (tmp_path / "frames").mkdir()
    for index in range(12):
        append_sample(tmp_path / "frames", f"{index:03d}", squares(rng))
    ticks = iter(range(10_000))
    config = TrainConfig(minutes=0.5, batch=2, warmup_steps=2, checkpoint_minutes=0.2)
    held_out = [squares(rng) for _ in range(2)]
    checkpoint = tmp_path / "weights.safetensors"
    samples = endless_samples(tmp_path / "frames", seed=0)
    evaluation = train(samples, held_out, TINY, config, checkpoint, clock=lambda: float(next(ticks)))
    assert evaluation.classes[2].objects == 2
    assert json.loads(evaluation.as_json())["classes"]["2"]["objects"] == 2

    model = load_weights(TINY, checkpoint)
    path = tmp_path / "tiny.onnx"
    export_onnx(model, TINY, path, {"source": "a test", "licence": "Apache-2.0"})
    images = [squares(rng).image for _ in range(3)]
    verify_export(model, TINY, path, images)
    with torch.inference_mode():
        expected = model(pixel_values=torch.zeros(3, 3, 64, 128))
    logits, _ = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"]).run(
        ["logits", "pred_boxes"], {"pixel_values": np.zeros((3, 3, 64, 128), np.float32)}
    )
    np.testing.assert_allclose(np.sort(logits, axis=1), np.sort(expected.logits.numpy(), axis=1), atol=1e-3)
    assert OnnxDetector(path).input_size_wh == (128, 64)


def test_export_of_other_weights_is_caught(tmp_path: Path) -> None:
    torch.manual_seed(0)
    first, second = build_compact_rtdetr(TINY), build_compact_rtdetr(TINY)
    for model, bias in ((first, 1.0), (second, 1.5)):
        for head in model.model.decoder.class_embed:
            torch.nn.init.constant_(head.bias, bias)
    path = tmp_path / "first.onnx"
    export_onnx(first, TINY, path, {})
    with pytest.raises(ModelError, match="differs from torch"):
        verify_export(second, TINY, path, [squares(np.random.default_rng(0)).image])


def test_weights_of_another_size_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="holds no weights"):
        load_weights(TINY, tmp_path / "gone.safetensors")


def test_learning_rate_warms_up_and_falls_to_two_per_cent() -> None:
    config = TrainConfig(learning_rate=1.0, warmup_steps=10)
    assert learning_rate(config, 0, 0.0) == pytest.approx(0.1)
    assert learning_rate(config, 50, 0.0) == pytest.approx(1.0)
    assert learning_rate(config, 50, 0.5) == pytest.approx(0.51)
    assert learning_rate(config, 50, 1.0) == pytest.approx(0.02)
    assert training_size((512, 288), coarse=True) == (384, 224)
    assert training_size((512, 288), coarse=False) == (512, 288)


def test_samples_survive_the_disk(tmp_path: Path) -> None:
    sample = squares(np.random.default_rng(3))
    append_sample(tmp_path, "a", sample)
    (entry,) = read_entries(tmp_path)
    loaded = entry.load()
    np.testing.assert_array_equal(loaded.boxes_xyxy, sample.boxes_xyxy)
    assert loaded.class_ids.tolist() == [2]
    assert np.abs(loaded.image.astype(int) - sample.image).mean() < 12
    (tmp_path / "a.jpg").unlink()
    with pytest.raises(ModelError, match="can't be read"):
        entry.load()
    with pytest.raises(ModelError, match=r"no labels\.jsonl"):
        read_entries(tmp_path / "elsewhere")
    with (tmp_path / "labels.jsonl").open("a") as lines:
        lines.write('{"image": 1\n')
    with pytest.raises(ModelError, match="line 2"):
        read_entries(tmp_path)


def test_small_and_hidden_objects_are_not_taught() -> None:
    boxes = np.array([[0, 0, 10, 12], [0, 0, 10, 11], [0, 0, 10, 50]], np.float32)
    seen = np.array([1, 1, 0.2], np.float32)
    assert learnable(boxes, seen, 540, 12 / 540, 0.25).tolist() == [True, False, False]


def test_augmented_boxes_still_frame_their_object() -> None:
    rng = np.random.default_rng(7)
    config = AugmentConfig(colour=0, blacken=0, jpeg=0, crop=1.0)
    checked = 0
    for _ in range(40):
        changed = augment(squares(rng), (128, 80), config, rng)
        assert changed.image.shape == (80, 128, 3)
        for box in changed.boxes_xyxy:
            bright = np.argwhere(changed.image.mean(axis=2) > 135)
            y0, x0 = bright.min(axis=0)
            y1, x1 = bright.max(axis=0) + 1
            np.testing.assert_allclose(box, [x0, y0, x1, y1], atol=1.6)
            checked += 1
    assert checked > 20


def test_blackened_images_keep_only_what_is_left_to_see() -> None:
    rng = np.random.default_rng(5)
    config = AugmentConfig(flip=0, crop=0, colour=0, blacken=1.0, jpeg=0)
    filled = 0
    for _ in range(30):
        changed = augment(squares(rng), (160, 96), config, rng)
        filled += len(changed.boxes_xyxy) == 0
        for box in changed.boxes_xyxy:
            x0, y0, x1, y1 = box.astype(int)
            assert changed.image[y0:y1, x0:x1].mean() > 200
    assert 0 < filled < 15


def test_mirroring_twice_changes_nothing() -> None:
    sample = squares(np.random.default_rng(9))
    twice = mirrored(mirrored(sample))
    np.testing.assert_array_equal(twice.image, sample.image)
    np.testing.assert_allclose(twice.boxes_xyxy, sample.boxes_xyxy)


def test_covered_share_counts_pixels() -> None:
    mask = np.zeros((10, 10), np.bool_)
    mask[:, :4] = True
    boxes = np.array([[0, 0, 8, 10], [4, 0, 10, 10], [0, 0, 4, 4]], np.float32)
    np.testing.assert_allclose(covered_share(boxes, mask), [0.5, 0, 1])


def test_average_precision_of_hand_worked_cases() -> None:
    assert average_precision(np.array([1, 1], np.int8), 2) == 1.0
    assert average_precision(np.array([0, 1], np.int8), 1) == 0.5
    # envelope 1, 2/3, 2/3 over recall steps of a quarter; the fourth object is never found
    assert average_precision(np.array([1, 0, 1, 0], np.int8), 4) == pytest.approx(0.25 * 1 + 0.25 * 2 / 3)
    assert average_precision(np.zeros(0, np.int8), 3) == 0.0


def test_class_figures_ignore_what_is_not_counted() -> None:
    truth = Truth(
        np.array([[0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10]], np.float32),
        np.array([2, 2, 2], np.int32),
        np.array([True, True, False]),
    )
    found = DetectedBoxes(
        np.array([[0, 0, 10, 10], [1, 0, 11, 10], [40, 0, 50, 10], [70, 0, 80, 10]], np.float32),
        np.array([2, 2, 2, 2], np.int32),
        np.array([0.9, 0.8, 0.7, 0.3], np.float32),
    )
    figures = class_figures([found], [truth], 2, operating_score=0.4)
    # at .4: one hit, one double; the uncounted third is neither, the fourth lies below
    assert figures.objects == 2
    assert (figures.precision, figures.recall, figures.f1) == (0.5, 0.5, 0.5)
    assert figures.ap50 == 0.5


def test_embedded_weights_are_small_and_say_what_they_are() -> None:
    path = embedded_detector_path()
    assert path.stat().st_size < 15_000_000
    metadata = ort.InferenceSession(str(path)).get_modelmeta().custom_metadata_map
    assert set(metadata) >= {"labels", "input_width", "input_height", "preprocessing", "source", "licence"}
    detector = OnnxDetector(path)
    assert detector.signature == "transformers"
    assert set(detector.labels.values()) == {"person", "bicycle", "car", "bus", "truck"}
    assert detector.input_size_wh == CompactRtDetrConfig().input_size_wh


def test_embedded_detector_finds_cars_in_scenes_it_never_saw() -> None:
    detector = OnnxDetector(embedded_detector_path())
    overlaps: list[float] = []
    for seed in range(91_000, 91_006):
        frame = SyntheticSource(SyntheticConfig(seed=seed, width=640, height=360)).frame(30)
        truth = frame.truth
        assert truth is not None
        heights = truth.boxes_xyxy[:, 3] - truth.boxes_xyxy[:, 1]
        cars = truth.boxes_xyxy[(truth.class_ids == 2) & (heights >= 25) & (truth.visibility >= 0.6)]
        (found,) = detector.detect([frame.image])
        vehicles = found.boxes_xyxy[np.isin(found.class_ids, (2, 5, 7))]
        overlaps += pairwise_iou(cars, vehicles).max(axis=1, initial=0).tolist()
    assert len(overlaps) >= 8
    assert np.mean(np.array(overlaps) >= 0.5) >= 0.6


def test_missing_embedded_weights_say_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cable_models.embedded.EMBEDDED_DETECTOR", "gone.onnx")
    with pytest.raises(ModelError, match=r"gone\.onnx is missing.*train_embedded"):
        embedded_detector_path()
