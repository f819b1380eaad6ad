"""`cable-rpc export rtdetr`: what it writes, says, and refuses."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("transformers", reason="building checkpoints needs transformers")
from cable_models.rtdetr import OnnxDetector

from cable_rpc.cli.export import export_app, spread_frames
from cable_rpc.data.synthetic import SyntheticSource
from cable_rpc.errors import CableError, ConfigurationError, ModelError
from cable_rpc.types import Frame
from tests.models.tiny_rtdetr import save_checkpoint, tiny_rtdetr


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_checkpoint(tiny_rtdetr(), tmp_path_factory.mktemp("export") / "tiny")


def picture_folder(folder: Path, count: int, seed: int) -> str:
    folder.mkdir()
    rng = np.random.default_rng(seed)
    for index in range(count):
        picture = rng.integers(0, 255, (6, 10, 3), dtype=np.uint8).repeat(20, axis=0).repeat(20, axis=1)
        cv2.imwrite(str(folder / f"{index:03d}.png"), picture)
    return f"video:{folder}"


def export(*arguments: str) -> str:
    result = CliRunner().invoke(export_app, ["rtdetr", *arguments])
    if result.exception is not None:
        raise result.exception
    return result.stdout


def test_exported_calibrated_and_measured(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["export", "rtdetr", "--checkpoint", "a folder"]
    monkeypatch.setattr(sys, "argv", ["cable-rpc", *words])
    verify, calibrate = picture_folder(tmp_path / "judged", 3, 1), picture_folder(tmp_path / "seen", 9, 2)
    target = tmp_path / "deep" / "tiny.onnx"
    said = export(
        "--checkpoint", str(checkpoint), "--out", str(target), "--verify", verify, "--int8", "--calibrate", calibrate,
        "--postprocess", "--calibrate-frames", "8",
    )  # fmt: skip
    assert "calibrating 8 bits on 8 frames" in said
    assert "detections on 3 frames: boxes within 0.0" in said
    assert "objects on 3 frames found again" in said
    detector = OnnxDetector(target)
    assert detector.signature == "rtdetr"
    assert detector.metadata["command"] == "cable-rpc export rtdetr --checkpoint 'a folder'"
    assert detector.metadata["precision"] == "int8"
    assert [path.name for path in target.parent.iterdir()] == ["tiny.onnx"]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (["--fp16", "--int8"], ConfigurationError, "exclude each other"),
        (["--int8"], ConfigurationError, "add --calibrate"),
        (["--calibrate", "synthetic:1"], ConfigurationError, "is for --int8"),
        (["--int8", "--calibrate", "synthetic:7", "--verify", "synthetic:7"], ConfigurationError, "other frames"),
        (["--out", "model.pt"], ConfigurationError, r"ends in \.onnx"),
        (["--size", "640"], ConfigurationError, "WIDTHxHEIGHT"),
        (["--size", "100x64"], ModelError, "multiples of 32"),
        (["--checkpoint", "gone/"], ModelError, "no such folder"),
        (["--verify", "nowhere:1"], ConfigurationError, "can't open source"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_misuse_is_told(
    checkpoint: Path, tmp_path: Path, options: list[str], error: type[CableError], message: str
) -> None:
    with pytest.raises(error, match=message):
        export("--checkpoint", str(checkpoint), "--out", str(tmp_path / "a.onnx"), "--verify", "none", *options)
    assert not list(tmp_path.iterdir())


def test_calibration_and_judgement_share_no_frame(checkpoint: Path, tmp_path: Path) -> None:
    first, second = picture_folder(tmp_path / "a", 8, 1), picture_folder(tmp_path / "b", 8, 1)
    with pytest.raises(ConfigurationError, match="share frames"):
        export("--checkpoint", str(checkpoint), "--out", str(tmp_path / "a.onnx"), "--int8", "--verify", first,
               "--calibrate", second)  # fmt: skip


def frame_of(picture: np.ndarray) -> Frame:
    return Frame(picture, 0, 0)


def test_frames_are_spread_over_a_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = spread_frames(picture_folder(tmp_path / "a", 9, 1), 3)
    expected = [cv2.imread(str(tmp_path / "a" / f"{index:03d}.png")) for index in (0, 4, 8)]
    for frame, picture in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame, picture)
    rendered: list[int] = []
    monkeypatch.setattr(SyntheticSource, "frame", lambda source, index: rendered.append(index) or frame_of(picture))
    assert len(spread_frames("synthetic:3", 2)) == 2
    # rendering is slow: only what is asked for
    assert rendered == [0, 119]
