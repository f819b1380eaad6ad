"""The compact RT-DETR: network, its form for inference, export, and the weights that ship."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
from cable_models import ModelError, embedded_detector_path
from cable_models.rtdetr import OnnxDetector
from cable_models.rtdetr.postprocess import pairwise_iou

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource

pytest.importorskip("transformers", reason="building the network needs transformers")
torch = pytest.importorskip("torch", reason="building the network needs torch")

from cable_models.rtdetr.compact import (  # noqa: E402
    CompactRtDetrConfig,
    build_compact_rtdetr,
    for_inference,
    parameter_count,
)
from cable_models.rtdetr.export import export_onnx, verify_export  # noqa: E402
from cable_models.training.train_rtdetr import load_weights  # noqa: E402

TINY = CompactRtDetrConfig(
    input_size_wh=(128, 64),
    stem_channels=8,
    stage_channels=(8, 8, 16, 16),
    width=16,
    queries=12,
    decoder_layers=1,
    denoising_queries=4,
)


def lively(seed: int, bias: float = 0.0) -> torch.nn.Module:
    """A tiny network with batch norms that have seen something, and scores about a half."""
    torch.manual_seed(seed)
    model = build_compact_rtdetr(TINY)
    with torch.no_grad():
        model(pixel_values=torch.rand(4, 3, 64, 128))
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.normal_(module.running_mean, std=0.2)
            torch.nn.init.uniform_(module.running_var, 0.5, 2.0)
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.normal_(module.bias, std=0.2)
    for head in model.model.decoder.class_embed:
        torch.nn.init.normal_(head.weight, std=0.5)
        torch.nn.init.constant_(head.bias, bias)
    return model.train(False)


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (96, 160, 3), dtype=np.uint8)


def test_network_has_the_stated_outputs_and_size() -> None:
    model = build_compact_rtdetr(CompactRtDetrConfig()).train(False)
    assert 0.9e6 < parameter_count(model) < 1.4e6
    with torch.inference_mode():
        output = model(pixel_values=torch.rand(1, 3, 288, 512))
    assert output.logits.shape == (1, CompactRtDetrConfig().queries, 5)
    assert output.pred_boxes.shape == (1, CompactRtDetrConfig().queries, 4)
    # the prior: a fresh network claims about one object in a hundred queries
    assert 0.001 < float(output.logits.sigmoid().mean()) < 0.08


def test_inference_form_answers_alike() -> None:
    model = lively(3)
    compact = for_inference(model, TINY.input_size_wh)
    pixels = torch.rand(2, 3, 64, 128)
    with torch.inference_mode():
        expected, found = model(pixel_values=pixels), compact(pixel_values=pixels)
    np.testing.assert_allclose(found.logits, expected.logits, atol=1e-4)
    np.testing.assert_allclose(found.pred_boxes, expected.pred_boxes, atol=1e-5)
    assert parameter_count(compact) < parameter_count(model)
    assert model.model.config.anchor_image_size is None


def test_exported_file_answers_as_torch_at_any_batch(tmp_path: Path) -> None:
    model = lively(4)
    path = tmp_path / "tiny.onnx"
    export_onnx(for_inference(model, TINY.input_size_wh), TINY, path, {"source": "a test", "licence": "Apache-2.0"})
    verify_export(model, TINY, path, [noise(seed) for seed in range(3)])
    with pytest.raises(ModelError, match="differs from torch"):
        verify_export(lively(4, bias=0.5), TINY, path, [noise(0)])
    pixels = torch.rand(3, 3, 64, 128)
    with torch.inference_mode():
        expected = model(pixel_values=pixels)
    logits, boxes = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"]).run(
        ["logits", "pred_boxes"], {"pixel_values": pixels.numpy()}
    )
    np.testing.assert_allclose(np.sort(logits, axis=1), np.sort(expected.logits.numpy(), axis=1), atol=1e-3)
    np.testing.assert_allclose(np.sort(boxes, axis=1), np.sort(expected.pred_boxes.numpy(), axis=1), atol=1e-3)
    assert OnnxDetector(path).input_size_wh == (128, 64)


def test_weights_of_another_size_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="holds no weights"):
        load_weights(TINY, tmp_path / "gone.safetensors")


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
    with pytest.raises(ModelError, match=r"gone\.onnx is missing.*train detector"):
        embedded_detector_path()
