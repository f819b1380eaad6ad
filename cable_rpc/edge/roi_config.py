"""Settings of the region-of-interest method, with the paper's defaults."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

from cable_rpc.errors import ConfigurationError

SHARES = (
    "min_coverage",
    "min_iou",
    "top_margin",
    "bottom_margin",
    "min_height_fraction",
)


@dataclass(frozen=True, slots=True)
class RoiConfig:
    """How R_k is predicted and when the whole frame is sent; one setting for every data set.

    Raises:
        ConfigurationError: a value is outside its range; the text names the field.
    """

    mode: Literal["paper"] = "paper"
    """``paper`` is the published method to the letter."""
    residual_threshold_levels: int = 25
    """tau_e, grey levels of 0..255; motion is strictly above it."""
    min_coverage: float = 0.02
    """tau_min, share of the frame below which R_k is taken for lost."""
    min_iou: float = 0.3
    """tau_iou, agreement of warped prior and new mask below which the prior is taken for lost."""
    smoothing_window_columns: int = 15
    """w_s, odd."""
    top_margin: float = 0.10
    """eta_t, share of the distance to the upper border."""
    bottom_margin: float = 0.15
    """eta_b, share of the distance to the lower border."""
    min_height_fraction: float = 0.1
    """h_min, share of the frame's height."""
    dilation_base_px: float = 8.0
    """b_0."""
    dilation_per_metre_px: float = 1.5
    """alpha, per metre of ego translation."""
    dilation_per_degree_px: float = 20.0
    """beta, per degree of heading change."""
    epsilon_m: float = 1e-6
    """eps, least forward displacement the ego homography divides by."""
    stale_after_s: float | None = 1.0
    """T_stale, capture time without any answer after which a keyframe is sent; None never does that."""

    def __post_init__(self) -> None:
        if self.mode != "paper":
            raise ConfigurationError(f"RoiConfig.mode is {self.mode!r}; known modes: 'paper'")
        for setting in fields(self):
            value = getattr(self, setting.name)
            if isinstance(value, (int, float)) and not (math.isfinite(value) and value >= 0):
                raise ConfigurationError(f"RoiConfig.{setting.name} is {value}; give a finite number of at least 0")
        for name in SHARES:
            if getattr(self, name) > 1:
                raise ConfigurationError(
                    f"RoiConfig.{name} is {getattr(self, name)}; it is a share, give a number of 0..1"
                )
        if self.smoothing_window_columns % 2 != 1:
            raise ConfigurationError(
                f"RoiConfig.smoothing_window_columns is {self.smoothing_window_columns}; give an odd number"
            )
        if self.epsilon_m == 0:
            raise ConfigurationError("RoiConfig.epsilon_m is 0; give a small positive distance in metres")
