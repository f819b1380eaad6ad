"""Detectors by the names that a user types: ``onnx:FILE?..``, ``embedded?..``, ``rtdetr:CHECKPOINT?..``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the detectors run on onnxruntime")
from cable_models import embedded_detector_path

from cable_rpc.cloud import detectors
from cable_rpc.cloud.backends import BackendOptions, RegionDetector
from cable_rpc.cloud.detectors import load_embedded, load_onnx, load_rtdetr
from cable_rpc.cloud.perception import PerceptionModels, PerceptionRequest
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.errors import ConfigurationError, ModelError

SERVER = BackendOptions(device="cpu", threads=3, min_score=0.35)
LOW = BackendOptions(device="cpu", min_score=0.001)


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)


def test_options_stand_in_for_the_servers_flags() -> None:
    plain = load_embedded("", SERVER)._model
    assert plain.runner.session.get_session_options().intra_op_num_threads == 3
    assert (plain.settings.min_score, plain.settings.crop, plain.settings.resample) == (0.35, None, None)
    path = embedded_detector_path()
    chosen = load_onnx(
        f"{path}?threads=2&provider=cpu&spin=no&io_binding=yes&min_score=0.2&classes=2,7&duplicates=keep&resize=linear"
        "&crop=roi&crop_margin=0.2&crop_min=0.5&batch=4",
        BackendOptions(device="cuda"),
    )
    model = chosen._model
    assert model.runner.session.get_session_options().intra_op_num_threads == 2
    assert model.runner.bound
    assert np.flatnonzero(model.wanted).tolist() == [2, 7]
    assert (model.settings.min_score, model.settings.deduplicate, model.settings.max_batch) == (0.2, False, 4)
    assert model.recipe.resample == "linear"
    assert (model.settings.crop.margin, model.settings.crop.min_share) == (0.2, 0.5)
    assert isinstance(chosen, RegionDetector)
    assert (chosen.name, chosen.device) == (f"onnx:{path.stem}", "CPUExecutionProvider")


@pytest.mark.parametrize(
    ("load", "argument", "message"),
    [
        (load_onnx, "", "needs a file"),
        (load_onnx, "a.onnx?thread=2", "unknown option 'thread'"),
        (load_onnx, "a.onnx?threads=two", "INTEGER"),
        (load_onnx, "a.onnx?revision=main", "unknown option 'revision'"),
        (load_embedded, "a.onnx", "no argument"),
        (load_embedded, "?crop=yes", r"none\|roi"),
        (load_rtdetr, "", "rtdetr:PekingU/rtdetr_r50vd"),
        (load_rtdetr, "a/b?precision=int8", r"fp32\|fp16"),
        (load_rtdetr, "a/b?size=wide", "WIDTHxHEIGHT"),
    ],
)
def test_misspelt_options_are_refused(load: object, argument: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        load(argument, SERVER)  # type: ignore[operator]


def test_what_the_models_refuse_is_an_error_of_ours(tmp_path: Path) -> None:
    for load, argument, message in (
        (load_onnx, f"{tmp_path}/gone.onnx", "no detector file"),
        (load_embedded, "?threads=0", "threads"),
        (load_embedded, "?provider=tensorrt", "TensorRT"),
        (load_rtdetr, f"{tmp_path}/gone", "no such folder"),
    ):
        with pytest.raises(ModelError, match=message):
            load(argument, SERVER)
    with pytest.raises(ModelError, match="image 0 must be uint8"):
        load_embedded("", SERVER).detect([np.zeros((4, 4), np.uint8)])


def test_regions_reach_the_network_only_where_asked_for() -> None:
    frame = noise(540, 960)
    region = np.zeros(frame.shape[:2], np.bool_)
    region[250:400, 300:600] = True
    whole, cropped = load_embedded("", LOW), load_embedded("?crop=roi", LOW)
    full = whole.detect([frame])[0]
    np.testing.assert_array_equal(whole.detect_regions([frame], [region])[0].boxes_xyxy, full.boxes_xyxy)
    np.testing.assert_array_equal(cropped.detect_regions([frame], [None])[0].boxes_xyxy, full.boxes_xyxy)
    # 300 of 960 columns and twice 5 % of context: 0.4125 of the frame, 396x223 around (450, 325.5)
    (inside,) = cropped.detect_regions([frame], [region])
    (expected,) = whole.detect([frame[214:437, 252:648]])
    assert len(inside) == len(expected) > 0
    np.testing.assert_allclose(inside.boxes_xyxy, expected.boxes_xyxy + np.array([252, 214, 252, 214]), atol=0.01)


def test_a_checkpoint_is_all_that_a_user_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("transformers", reason="building checkpoints needs transformers")
    from tests.models.tiny_rtdetr import save_checkpoint, tiny_rtdetr

    monkeypatch.setattr(detectors, "rendered_frames", lambda: [noise(90, 120)])
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = save_checkpoint(tiny_rtdetr(), tmp_path / "tiny")
    first = load_rtdetr(str(folder), SERVER)
    assert first.name == f"rtdetr:{folder}"
    (kept,) = (tmp_path / "cache" / "cable-rpc" / "rtdetr").glob("*.onnx")
    stamp = kept.stat().st_mtime_ns
    again = load_rtdetr(f"{folder}?min_score=0.1", SERVER)
    assert kept.stat().st_mtime_ns == stamp
    assert again.revision == first.revision


async def test_a_session_s_region_reaches_the_detector() -> None:
    frame = noise(540, 960)
    region = np.zeros(frame.shape[:2], np.bool_)
    region[250:400, 300:600] = True
    cropped = load_embedded("?crop=roi", LOW)
    models = PerceptionModels.in_process(cropped, BoxSegmenter())
    seen = await models.perceive(PerceptionRequest(frame, region, min_score=0.0))
    models.close()
    np.testing.assert_array_equal(seen.detections.boxes_xyxy, cropped.detect_regions([frame], [region])[0].boxes_xyxy)
    assert not np.array_equal(seen.detections.boxes_xyxy, cropped.detect([frame])[0].boxes_xyxy)
