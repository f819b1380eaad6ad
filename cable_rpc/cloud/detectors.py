"""Detector back ends: an ONNX file, or the one that ships with the package."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from cable_models import ModelError as DetectorLoadError
from cable_models import embedded_detector_path
from cable_models.rtdetr.onnx_detector import OnnxDetector as OnnxSession

from cable_rpc.cloud.backends import BackendOptions
from cable_rpc.errors import ConfigurationError, ModelError
from cable_rpc.types import Detections, Image


class OnnxDetector:
    """An RT-DETR style detector in ONNX Runtime; both export signatures (see `cable_models.rtdetr`)."""

    def __init__(self, path: Path, options: BackendOptions) -> None:
        providers = {"cpu": ["CPUExecutionProvider"], "cuda": ["CUDAExecutionProvider"], "auto": None}
        if options.device not in providers:
            raise ConfigurationError(f"device '{options.device}' is unknown; use auto, cpu or cuda")
        try:
            self._model = OnnxSession(
                path,
                providers=providers[options.device],
                threads=options.threads,
                min_score=options.min_score,
            )
        except DetectorLoadError as error:
            raise ModelError(str(error)) from error
        self.name = f"onnx:{path.stem}"
        self.revision = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
        self.device = self._model.provider

    def detect(self, images: Sequence[Image]) -> list[Detections]:
        """Boxes for each BGR image, best score first."""
        return [Detections(found.boxes_xyxy, found.class_ids, found.scores) for found in self._model.detect(images)]


def load_onnx(argument: str, options: BackendOptions) -> OnnxDetector:
    """Entry point ``onnx:FILE``."""
    if not argument:
        raise ConfigurationError("the onnx detector needs a file: --detector onnx:FILE.onnx")
    return OnnxDetector(Path(argument).expanduser(), options)


def load_embedded(argument: str, options: BackendOptions) -> OnnxDetector:
    """Entry point ``embedded``: the compact RT-DETR trained on the rendered world."""
    if argument:
        raise ConfigurationError(f"the embedded detector takes no argument, got '{argument}'")
    try:
        return OnnxDetector(embedded_detector_path(), options)
    except DetectorLoadError as error:
        raise ModelError(str(error)) from error
