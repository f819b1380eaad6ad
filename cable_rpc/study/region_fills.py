"""What stands outside the region in the masked images that the shipped models learn from."""

from __future__ import annotations

from cable_codecs import diffuse_background
from cable_models.training.upload_views import WeightedFill, black, mean_colour

FILLS = (WeightedFill(diffuse_background, 0.6), WeightedFill(black, 0.2), WeightedFill(mean_colour, 0.2))
"""Mostly what the service shows its models."""
