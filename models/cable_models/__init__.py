"""Detectors and segmenters behind the cloud service, and the small models that ship with the package."""

from __future__ import annotations

from cable_models.detection import DetectedBoxes
from cable_models.embedded import embedded_detector_path, embedded_segmenter_path
from cable_models.errors import ModelError

__all__ = ["DetectedBoxes", "ModelError", "embedded_detector_path", "embedded_segmenter_path"]
