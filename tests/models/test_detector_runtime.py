"""How a detector is run: providers that start or don't, bound inputs, mixed batches, windows around regions."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from cable_models import ModelError
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("onnx", reason="building test graphs needs onnx")
ort = pytest.importorskip("onnxruntime", reason="the detector runs on onnxruntime")

from cable_models.rtdetr import CropConfig, DetectorSettings, OnnxDetector, SessionSettings, providers  # noqa: E402
from cable_models.rtdetr.crop import crop_window  # noqa: E402

from tests.models.test_onnx_detector import rtdetr_graph  # noqa: E402

CPU, CUDA, TENSORRT = "CPUExecutionProvider", "CUDAExecutionProvider", "TensorrtExecutionProvider"


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    """A car in the middle of whatever is shown, and a person who scores as the R plane's mean."""
    return rtdetr_graph(tmp_path / "a.onnx", [2], [[0.25, 0.25, 0.75, 0.5]], [0.9])


class FakeSession:
    """ONNX Runtime as it behaves where CUDA's libraries are missing: it goes on with the CPU without a word."""

    asked: ClassVar[list[tuple[str, dict]]] = []
    real = ort.InferenceSession

    def __init__(self, path: str, options: object, providers: list[tuple[str, dict]]) -> None:
        FakeSession.asked = providers
        self.session = FakeSession.real(path, options, providers=[CPU])

    def __getattr__(self, name: str) -> object:
        return getattr(self.session, name)


@pytest.fixture
def gpu_build(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(providers.ort, "get_available_providers", lambda: [TENSORRT, CUDA, CPU])
    monkeypatch.setattr(providers.ort, "InferenceSession", FakeSession)
    monkeypatch.setattr(providers.ort, "preload_dlls", lambda: None, raising=False)


@pytest.mark.usefixtures("gpu_build")
@pytest.mark.parametrize(("name", "full"), [("cuda", CUDA), ("tensorrt", TENSORRT), (CUDA, CUDA)])
def test_a_named_provider_that_does_not_start_is_an_error(graph: Path, name: str, full: str) -> None:
    with pytest.raises(ModelError, match=f"{full} did not start for a.onnx, {CPU} did"):
        OnnxDetector(graph, SessionSettings(provider=name))


@pytest.mark.usefixtures("gpu_build")
def test_auto_falls_back_aloud(graph: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        detector = OnnxDetector(graph, SessionSettings(device_id=1))
    assert [name for name, _ in FakeSession.asked] == [CUDA, CPU]
    assert FakeSession.asked[0][1]["device_id"] == 1
    assert detector.provider == CPU
    assert f"{CUDA} did not start" in detector.provider_choice.note
    assert f"{CUDA} did not start" in caplog.text


@pytest.mark.usefixtures("gpu_build")
def test_tensorrt_keeps_its_engines_and_leans_on_cuda(graph: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError):
        OnnxDetector(graph, SessionSettings(provider="tensorrt", engine_cache=tmp_path / "engines", fp16=True))
    assert [name for name, _ in FakeSession.asked] == [TENSORRT, CUDA, CPU]
    options = FakeSession.asked[0][1]
    assert options["trt_fp16_enable"]
    assert options["trt_engine_cache_path"] == str(tmp_path / "engines")
    assert (tmp_path / "engines").is_dir()


def test_a_provider_that_is_not_installed_says_what_brings_it(graph: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(providers.ort, "get_available_providers", lambda: [CPU])
    for name, package in (("cuda", "onnxruntime-gpu"), ("openvino", "onnxruntime-openvino")):
        with pytest.raises(ModelError, match=package):
            OnnxDetector(graph, SessionSettings(provider=name))
    with pytest.raises(ModelError, match="provider 'npu' is unknown; use auto, cpu, cuda"):
        OnnxDetector(graph, SessionSettings(provider="npu"))
    assert OnnxDetector(graph).provider_choice == providers.ProviderChoice("auto", (CPU,))


def mixed_pictures() -> list[np.ndarray]:
    sizes = [(100, 200), (64, 48), (33, 77), (50, 50), (100, 200)]
    return [np.full((h, w, 3), (0, 0, 40 * index), np.uint8) for index, (h, w) in enumerate(sizes)]


@pytest.mark.parametrize("threads", [1, 2])
def test_bound_and_plain_runs_agree_over_changing_batches(graph: Path, threads: int) -> None:
    reported = DetectorSettings(min_score=0.01)
    plain = OnnxDetector(graph, SessionSettings("cpu", threads, spin=False, io_binding=False), reported)
    bound = OnnxDetector(graph, SessionSettings("cpu", threads, io_binding=True), reported)
    assert (plain.runner.bound, bound.runner.bound) == (False, True)
    images = mixed_pictures()
    for count in (1, 5, 2):
        for first, second in zip(plain.detect(images[:count]), bound.detect(images[:count]), strict=True):
            np.testing.assert_array_equal(first.boxes_xyxy, second.boxes_xyxy)
            np.testing.assert_array_equal(first.scores, second.scores)


@pytest.mark.parametrize("most", [1, 2, 3, None])
def test_streams_of_different_sizes_share_a_batch(graph: Path, most: int | None) -> None:
    detector = OnnxDetector(graph, settings=DetectorSettings(min_score=0.01, max_batch=most))
    batches: list[int] = []
    infer = detector.runner.run
    detector.runner.run = lambda names, feed: (batches.append(len(feed["images"])), infer(names, feed))[1]  # type: ignore[method-assign]
    images = mixed_pictures()
    found = detector.detect(images)
    assert batches == {1: [1] * 5, 2: [2, 2, 1], 3: [3, 2], None: [5]}[most]
    for index, (image, boxes) in enumerate(zip(images, found, strict=True)):
        height, width = image.shape[:2]
        car = boxes.select(boxes.class_ids == 2)
        np.testing.assert_allclose(car.boxes_xyxy, [[width / 4, height / 4, width * 3 / 4, height / 2]], rtol=1e-5)
        person = boxes.scores[boxes.class_ids == 0]
        np.testing.assert_allclose(person, [40 * index / 255] if index else [], atol=1e-5)


def test_boxes_inside_a_window_come_back_in_pixels_of_the_frame(graph: Path) -> None:
    image = np.zeros((100, 200, 3), np.uint8)
    region = np.zeros((100, 200), np.bool_)
    region[60:80, 120:160] = True
    crop = DetectorSettings(crop=CropConfig(margin=0.1, min_share=0.1))
    (found,) = OnnxDetector(graph, settings=crop).detect([image], [region])
    # 20 % and twice 10 % of context: a window of 80x40 around (140, 70)
    np.testing.assert_allclose(found.boxes_xyxy, [[120, 60, 160, 70]], rtol=1e-5)
    whole = [[50, 25, 150, 50]]
    for detector, regions in (
        (OnnxDetector(graph), [region]),
        (OnnxDetector(graph, settings=crop), None),
        (OnnxDetector(graph, settings=crop), [None]),
        (OnnxDetector(graph, settings=crop), [np.zeros_like(region)]),
        (OnnxDetector(graph, settings=crop), [np.ones_like(region)]),
    ):
        (found,) = detector.detect([image], regions)
        np.testing.assert_allclose(found.boxes_xyxy, whole, rtol=1e-5)


def test_the_network_sees_only_the_window(graph: Path) -> None:
    image = np.full((100, 200, 3), 255, np.uint8)
    image[40:90, 100:190] = 0
    region = np.zeros((100, 200), np.bool_)
    region[60:80, 120:160] = True
    detector = OnnxDetector(graph, settings=DetectorSettings(crop=CropConfig(0.1, 0.1)))
    assert detector.detect([image], [region])[0].class_ids.tolist() == [2]
    assert detector.detect([image])[0].class_ids.tolist() == [2, 0]


def test_regions_that_do_not_fit_are_refused(graph: Path) -> None:
    detector = OnnxDetector(graph, settings=DetectorSettings(crop=CropConfig()))
    image = np.zeros((100, 200, 3), np.uint8)
    with pytest.raises(ModelError, match=r"region 0 must be bool \[100, 200\], got bool \[10, 10\]"):
        detector.detect([image], [np.ones((10, 10), np.bool_)])
    with pytest.raises(ModelError, match="region 0 must be bool"):
        detector.detect([image], [np.ones((100, 200), np.uint8)])  # type: ignore[list-item]
    with pytest.raises(ModelError, match="2 images came with 1 regions"):
        detector.detect([image, image], [None])


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_window_holds_its_region_and_keeps_the_aspect(data: st.DataObject) -> None:
    height, width = data.draw(st.integers(1, 90)), data.draw(st.integers(1, 160))
    region = np.zeros((height, width), np.bool_)
    for _ in range(data.draw(st.integers(0, 3))):
        y, x = data.draw(st.integers(0, height - 1)), data.draw(st.integers(0, width - 1))
        region[y : y + data.draw(st.integers(1, 30)), x : x + data.draw(st.integers(1, 30))] = True
    share = st.floats(0.05, 1)
    config = CropConfig(data.draw(st.floats(0, 0.3)), data.draw(share), data.draw(share))
    window = crop_window(region, config)
    assert 0 <= window.left < window.right <= width
    assert 0 <= window.top < window.bottom <= height
    assert np.count_nonzero(region[window.slices]) == np.count_nonzero(region)
    wide, high = window.right - window.left, window.bottom - window.top
    # whole pixels: each side may be up to one larger than the common share of the frame
    assert abs(wide * height - high * width) <= max(height, width)
    if (wide, high) != (width, height):
        assert wide / width >= min(config.min_share, config.max_share)
        assert (wide - 1) / width <= config.max_share
