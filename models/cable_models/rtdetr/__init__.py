"""RT-DETR: any ONNX export of it behind one detector class, and the compact one of this package."""

from __future__ import annotations

from cable_models.rtdetr.onnx_detector import OnnxDetector

__all__ = ["OnnxDetector"]
