"""RT-DETR checkpoints through ONNX, held against the unmodified transformers model and processor."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cable_models import ModelError

pytest.importorskip("transformers", reason="building checkpoints needs transformers")
torch = pytest.importorskip("torch", reason="building checkpoints needs torch")

import onnxruntime as ort  # noqa: E402
import transformers  # noqa: E402
from cable_models.rtdetr import DetectorSettings, OnnxDetector, SessionSettings, detector_cache, detector_file, hub  # noqa: E402
from cable_models.rtdetr.agreement import measure_agreement  # noqa: E402
from cable_models.rtdetr.checkpoints import Checkpoint, load_checkpoint, recipe_from_processor  # noqa: E402
from cable_models.rtdetr.compact import CompactRtDetrConfig, build_compact_rtdetr  # noqa: E402
from cable_models.rtdetr.export import export_checkpoint  # noqa: E402
from cable_models.rtdetr.file_plan import FilePlan, GraphOptions  # noqa: E402
from cable_models.rtdetr.precision import to_fp16, to_int8  # noqa: E402
from cable_models.rtdetr.preprocess import InputRecipe, fill_input  # noqa: E402
from cable_models.rtdetr.verify import check_export, require  # noqa: E402
from huggingface_hub.errors import LocalEntryNotFoundError  # noqa: E402
from PIL import Image as PilImage  # noqa: E402
from safetensors.torch import save_file, save_model  # noqa: E402
from transformers.models.rt_detr.image_processing_pil_rt_detr import RTDetrImageProcessorPil  # noqa: E402

from tests.models.tiny_rtdetr import LABELS, SIZE_WH, save_checkpoint, tiny_rtdetr  # noqa: E402

RANKED = DetectorSettings(min_score=0.01)


def pictures(count: int, seed: int = 0) -> list[np.ndarray]:
    """Blocks of colour in noise, every one of another size."""
    rng = np.random.default_rng(seed)
    images = []
    for index in range(count):
        coarse = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
        image = coarse.repeat(20 + index, axis=0).repeat(30 - index, axis=1).astype(int)
        images.append(np.clip(image + rng.integers(-20, 20, image.shape), 0, 255).astype(np.uint8))
    return images


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_checkpoint(tiny_rtdetr(), tmp_path_factory.mktemp("tiny") / "checkpoint")


@pytest.fixture(scope="module")
def checkpoint(folder: Path) -> Checkpoint:
    return load_checkpoint(str(folder))


@pytest.fixture(scope="module")
def plain(checkpoint: Checkpoint, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("plain") / "plain.onnx"
    plan = FilePlan(notes={"command": "cable-rpc export rtdetr --checkpoint tiny"})
    made = detector_file.make_file(checkpoint, target, plan, pictures(3))
    assert made.check is not None
    assert made.check.passed
    assert made.check.compared >= 60
    return target


@pytest.fixture(scope="module")
def processed(checkpoint: Checkpoint, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("processed") / "processed.onnx"
    export_checkpoint(checkpoint, target, GraphOptions(postprocess=True))
    return target


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"do_normalize": True, "image_mean": [0.4, 0.5, 0.6], "image_std": [0.2, 0.3, 0.4]},
        {"rescale_factor": 1 / 128, "size": {"height": 37, "width": 53}},
        {"do_rescale": False},
    ],
    ids=["published", "normalised", "rescaled", "raw"],
)
def test_preprocessing_is_the_processors_own(tmp_path: Path, settings: dict[str, object]) -> None:
    processor = RTDetrImageProcessorPil(**settings)
    recipe = recipe_from_processor(json.loads(processor.to_json_string()))
    for image in (*pictures(2), np.full((700, 1300, 3), 77, np.uint8)):
        expected = processor(images=PilImage.fromarray(image[..., ::-1]), return_tensors="np")["pixel_values"]
        ours = np.empty_like(expected)
        fill_input([image], ours, recipe)
        np.testing.assert_allclose(ours, expected, rtol=0, atol=3e-7 * max(1.0, float(np.abs(expected).max())))


def test_the_fast_filter_skips_what_lies_between_its_samples() -> None:
    stripes = np.zeros((320, 480, 3), np.uint8)
    stripes[::5] = 255
    careful, fast = (np.empty((1, 3, 64, 96), np.float32) for _ in range(2))
    for image, mean_careful, mean_fast in ((stripes, 0.2, 0.0), (np.full_like(stripes, 51), 0.2, 0.2)):
        fill_input([image], careful, InputRecipe((96, 64)))
        fill_input([image], fast, InputRecipe((96, 64), "linear"))
        # every fifth row is white: a fifth of the light, or none where only the rows between are looked at
        assert careful.mean() == pytest.approx(mean_careful, abs=0.01)
        assert fast.mean() == pytest.approx(mean_fast, abs=1e-6)
    same = pictures(1)[0][:64, :96]
    fill_input([same], careful, InputRecipe((96, 64)))
    np.testing.assert_array_equal(careful[0], same[..., ::-1].transpose(2, 0, 1) * np.float32(1 / 255))


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_any_batch_answers_as_transformers(count: int, folder: Path, plain: Path, processed: Path) -> None:
    # the unmodified model, processor and post-processing, image by image
    model = transformers.RTDetrForObjectDetection.from_pretrained(folder).train(False)
    processor = RTDetrImageProcessorPil.from_pretrained(folder)
    images = pictures(count, seed=count)
    settings = DetectorSettings(min_score=0.2, deduplicate=False)
    answers = [OnnxDetector(path, settings=settings).detect(images) for path in (plain, processed)]
    raw = ort.InferenceSession(str(plain)).run(["logits"], {"pixel_values": np.zeros((count, 3, 64, 96), np.float32)})
    assert raw[0].shape == (count, 10, len(LABELS))
    seen = 0
    for position, image in enumerate(images):
        with torch.inference_mode():
            output = model(**processor(images=PilImage.fromarray(image[..., ::-1]), return_tensors="pt"))
        (truth,) = processor.post_process_object_detection(output, 0.2, target_sizes=[image.shape[:2]])
        known = truth["labels"] != LABELS.index("tree")
        boxes = truth["boxes"][known].numpy().clip(0, [image.shape[1], image.shape[0]] * 2)
        classes = [(0, 3, 2)[index] for index in truth["labels"][known]]
        seen += len(classes)
        for found in (answers[0][position], answers[1][position]):
            assert sorted(found.class_ids.tolist()) == sorted(classes)
            for box, class_id, score in zip(boxes, classes, truth["scores"][known].tolist(), strict=True):
                distance = np.abs(found.boxes_xyxy - box).max(axis=1) + 1e6 * (found.class_ids != class_id)
                assert distance.min() < 0.05
                assert found.scores[distance.argmin()] == pytest.approx(score, abs=1e-4)
    assert seen >= 2 * count


def test_the_file_tells_what_it_is(plain: Path, checkpoint: Checkpoint) -> None:
    detector = OnnxDetector(plain)
    assert detector.labels == dict(enumerate(LABELS))
    assert detector.coco_index.tolist() == [0, 3, 2, -1]
    assert detector.recipe == checkpoint.recipe == InputRecipe(SIZE_WH)
    facts = detector.metadata
    assert facts["command"].startswith("cable-rpc export rtdetr")
    assert (facts["opset"], facts["precision"]) == ("17", "fp32")
    assert facts["torch_version"].split("+")[0] == torch.__version__.split("+")[0]
    assert len(facts["revision"]) == 40
    assert json.loads(facts["verified"])["images"] == 3
    assert "Pillow" in facts["preprocessing"]


def test_other_weights_are_caught_and_leave_no_file(folder: Path, checkpoint: Checkpoint, plain: Path, tmp_path: Path,
                                                   monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    other = replace(checkpoint, model=tiny_rtdetr(seed=1))
    check = check_export(other, plain, pictures(1))
    assert not check.passed
    with pytest.raises(ModelError, match="differs from torch"):
        require(check, plain)
    monkeypatch.setattr(detector_file, "export_checkpoint", lambda _, path, *__: shutil.copy(plain, path))
    target = tmp_path / "wrong.onnx"
    target.write_text("the earlier file")
    with pytest.raises(ModelError, match="differs from torch"):
        detector_file.make_file(other, target, FilePlan(), pictures(1))
    assert target.read_text() == "the earlier file"
    assert list(tmp_path.iterdir()) == [target]


def test_half_precision_says_what_it_costs(plain: Path, tmp_path: Path) -> None:
    reference = OnnxDetector(plain, settings=DetectorSettings(min_score=0.3))
    same = measure_agreement(reference, OnnxDetector(plain, settings=RANKED), pictures(4, seed=5))
    assert (same.ap50, same.matched, same.extra, same.score_max, same.box_px_mean) == (1.0, 1.0, 0.0, 0.0, 0.0)
    assert same.objects >= 8
    to_fp16(plain, tmp_path / "half.onnx")
    candidate = OnnxDetector(tmp_path / "half.onnx", settings=RANKED)
    assert candidate.metadata["precision"] == "fp16"
    assert candidate.labels == reference.labels
    cost = measure_agreement(reference, candidate, pictures(4, seed=5))
    assert cost.matched > 0.9
    assert 0 < cost.score_mean < 0.02
    assert 0 < cost.box_px_mean < 1
    with pytest.raises(ModelError, match="at least 8 frames"):
        to_int8(plain, tmp_path / "few.onnx", pictures(3))


def test_the_compact_network_takes_the_same_way(tmp_path: Path) -> None:
    config = CompactRtDetrConfig(
        input_size_wh=(96, 64), stem_channels=8, stage_channels=(8, 8, 16, 16), width=16, queries=12, decoder_layers=1
    )
    torch.manual_seed(3)
    model = build_compact_rtdetr(config).train(False)
    sizes = {key: getattr(config, key) for key in config.__dataclass_fields__}
    save_model(model, str(tmp_path / "compact.safetensors"), {"compact_rtdetr": json.dumps(sizes)})
    (tmp_path / "compact.state.safetensors").touch()
    for name in (tmp_path, tmp_path / "compact.safetensors"):
        loaded = load_checkpoint(str(name))
        assert loaded.labels == dict(enumerate(config.labels))
        assert loaded.recipe.size_wh == (96, 64)
    made = detector_file.make_file(loaded, tmp_path / "compact.onnx", FilePlan(), pictures(2))
    assert made.check is not None
    assert made.check.passed
    assert OnnxDetector(made.path).labels == loaded.labels
    save_model(model, str(tmp_path / "compact.safetensors"))
    with pytest.raises(ModelError, match="no weights of the compact RT-DETR"):
        load_checkpoint(str(tmp_path / "compact.safetensors"))


def test_what_is_no_rtdetr_is_refused(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "llama"
    other.mkdir()
    (other / "config.json").write_text('{"model_type": "llama"}')
    with pytest.raises(ModelError, match=r"no \*\.safetensors"):
        load_checkpoint(str(other))
    save_file({"x": torch.zeros(1)}, other / "model.safetensors")
    with pytest.raises(ModelError, match="'llama' model, not an RT-DETR"):
        load_checkpoint(str(other))
    (other / "config.json").write_text((folder / "config.json").read_text())
    with pytest.raises(ModelError, match=r"lacks \d+ weights"):
        load_checkpoint(str(other))
    (other / "config.json").write_text("[]")
    with pytest.raises(ModelError, match="JSON object"):
        load_checkpoint(str(other))


@pytest.mark.parametrize(
    ("processor", "message"),
    [
        ({"size": {"shortest_edge": 640}}, "straight resize"),
        ({"resample": 3}, "only bilinear"),
        ({"do_resize": False}, "doesn't resize"),
        ({"size": {"height": 60, "width": 64}}, "multiples of 32"),
    ],
)
def test_other_preprocessing_is_refused(processor: dict, message: str, folder: Path, tmp_path: Path) -> None:
    for name in ("config.json", "model.safetensors"):
        (tmp_path / name).symlink_to(folder / name)
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(processor))
    with pytest.raises(ModelError, match=message):
        load_checkpoint(str(tmp_path))


def test_names_that_lead_nowhere_say_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ModelError, match="no such folder or file"):
        load_checkpoint(str(tmp_path / "gone"))
    with pytest.raises(ModelError, match="holds no checkpoint"):
        load_checkpoint(str(tmp_path))
    (tmp_path / "a.onnx").touch()
    with pytest.raises(ModelError, match="exported already"):
        load_checkpoint(str(tmp_path / "a.onnx"))

    def unreachable(*_: object, **__: object) -> str:
        raise LocalEntryNotFoundError("no route to host")

    monkeypatch.setattr(hub, "snapshot_download", unreachable)
    with pytest.raises(ModelError, match=r"can't be reached \(no route to host\)"):
        load_checkpoint("PekingU/rtdetr_r50vd")


def test_a_hub_checkpoint_is_exported_once_and_outlives_the_network(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    snapshot = tmp_path / "snapshots" / ("0123456789abcdef" * 3)[:40]
    shutil.copytree(folder, snapshot)
    processor = {"do_normalize": True, "image_mean": [0.4, 0.5, 0.6], "image_std": [0.2, 0.3, 0.4]}
    (snapshot / "preprocessor_config.json").write_text(json.dumps(processor))
    asked: list[tuple[str, object]] = []

    def download(name: str, *, revision: str | None, allow_patterns: list[str]) -> str:
        asked.append((name, revision))
        assert not any(pattern.endswith(".bin") for pattern in allow_patterns)
        return str(snapshot)

    monkeypatch.setattr(hub, "snapshot_download", download)
    said: list[str] = []
    cache = tmp_path / "cache"
    name, plan = "PekingU/rtdetr_tiny", FilePlan(GraphOptions(batch=2), size_wh=(64, 32))
    first = detector_cache.cached_file(name, "main", plan, lambda: pictures(1), cache, said.append)
    assert first.name == "PekingU--rtdetr_tiny@0123456789ab-fp32-64x32-b2-op17.onnx"
    detector = OnnxDetector(first, SessionSettings(provider="cpu"))
    assert detector.metadata["revision"] == snapshot.name
    assert detector.layout.fixed_batch == 2
    # the file prepares images as this processor would
    assert detector.recipe == InputRecipe((64, 32), mean=(0.4, 0.5, 0.6), std=(0.2, 0.3, 0.4))
    assert any("torch" in line for line in said)

    def never() -> list[np.ndarray]:
        raise AssertionError("exported twice")

    stamp = first.stat().st_mtime_ns
    assert detector_cache.cached_file(name, "main", plan, never, cache) == first
    monkeypatch.setattr(
        hub, "snapshot_download", lambda *_, **__: (_ for _ in ()).throw(LocalEntryNotFoundError("off"))
    )
    assert detector_cache.cached_file(name, None, plan, never, cache) == first
    assert first.stat().st_mtime_ns == stamp
    assert "serving the earlier export" in caplog.text
    with pytest.raises(ModelError, match="can't be reached"):
        detector_cache.cached_file(name, None, FilePlan(), never, cache)
