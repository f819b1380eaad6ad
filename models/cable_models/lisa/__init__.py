"""LISA++: reasoning segmentation by a language model with a [SEG] token, run only where the region asks for it."""

from __future__ import annotations

from cable_models.lisa.loader import LoadedLisa, load_lisa
from cable_models.lisa.options import PLAIN, LisaOptions
from cable_models.lisa.pipeline import FrameAnswer, FrameRequest, LisaPipeline

__all__ = ["PLAIN", "FrameAnswer", "FrameRequest", "LisaOptions", "LisaPipeline", "LoadedLisa", "load_lisa"]
