"""RT-DETR: any ONNX export of it behind one detector class, and the compact one of this package."""

from __future__ import annotations

from cable_models.rtdetr.crop import CropConfig
from cable_models.rtdetr.onnx_detector import DetectorSettings, OnnxDetector
from cable_models.rtdetr.providers import ProviderChoice, SessionSettings

__all__ = ["CropConfig", "DetectorSettings", "OnnxDetector", "ProviderChoice", "SessionSettings"]
