"""Settings of the region-of-interest method: the paper's to the letter, and ours for the road."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args, get_type_hints

from cable_rpc.errors import ConfigurationError

EgoModel = Literal["paper", "identity", "rotation", "ground_plane", "flow"]
KeyframePolicyName = Literal["paper", "periodic", "budget", "uncertainty"]

POSITIVE = ("analysis_scale", "epsilon_m", "max_keyframe_interval", "keyframe_period", "keyframe_budget_kbps")
"""Settings for which 0 has no meaning."""


@dataclass(frozen=True, slots=True)
class RoiConfig:
    """How R_k is predicted and when the whole frame is sent; one setting for every data set.

    The defaults are the ``robust`` mode. ``RoiConfig.paper()`` is the published method: each field that differs
    there is one deviation from it, so an ablation flips one field. Lengths named ``_px`` are pixels of the full
    frame; shares are of the frame's width, height or area.

    Raises:
        ConfigurationError: a value is outside its range; the text names the field.
    """

    # Analysis
    analysis_scale: int = 4
    """Full-frame pixels per analysis pixel, along each axis: masks and residual are computed on a grid that much
    coarser, and masks only grow by it. 1 is exact."""
    # Ego-motion
    ego_model: EgoModel = "ground_plane"
    """How the vehicle's motion moves the picture. ``ground_plane`` needs camera, mount and ego-motion,
    ``rotation`` camera and ego-motion, ``flow`` only pictures."""
    ego_fallback: Literal["flow", "identity"] = "flow"
    """What stands in for a model whose inputs a frame lacks."""
    standstill_mps: float = 0.3
    """Below this speed the vehicle stands and nothing moves; 0 never assumes that."""
    epsilon_m: float = 0.05
    """eps, least forward displacement that the paper's homography divides by."""
    max_shift_share: float = 0.05
    """Limit of the paper's horizontal shift, share of the width; 0 never limits."""
    upright_actors: bool = True
    """Under ``ground_plane`` each piece of the mask keeps its shape and follows the road at its foot, rather than
    being spread over the road behind it."""
    moving_actors: bool = True
    """Under ``ground_plane`` an actor may stand or drive along; where it would be in either case belongs to the
    prior."""
    mask_warp_border: bool = True
    """No residual motion where the warped frame is undefined."""
    # Residual motion
    residual_threshold_levels: int = 25
    """tau_e, grey levels of 0..255; motion is strictly above it."""
    residual_noise_factor: float = 6.0
    """Threshold in robust standard deviations (1.4826 MAD) of the frame's own residual; 0 uses tau_e alone."""
    residual_blur: bool = False
    """3x3 mean of both pictures before they are compared."""
    residual_opening: bool = True
    """3x3 opening of the motion map."""
    min_residual_area_px: int = 16
    """Smaller connected pieces of the motion map are noise."""
    # Feedback
    keep_unseen: bool = True
    """An answer says nothing of what lay outside the region that was sent: a newer prior that was not known when
    that region was chosen stays there. In lock-step there is no such prior."""
    linger_answers: int = 8
    """A piece of the mask that the cloud no longer sees stays in the prior for so many answers: detections flicker."""
    # Dilation
    dilation_base_px: float = 8.0
    """b_0."""
    dilation_per_metre_px: float = 1.5
    """alpha, per metre of ego translation."""
    dilation_per_degree_px: float = 20.0
    """beta, per degree of heading change."""
    dilation_from_focal_length: bool = True
    """beta = f_x pi / 180 where the camera is known."""
    max_dilation_share: float = 0.05
    """Limit of b_k, share of the width; 0 never limits."""
    dilation_uncertainty_px: float = 16.0
    """Growth of the region around pixels that the cloud is wholly undecided about, less where it is surer."""
    # Entry of new actors
    entry_band_share: float = 0.04
    """Width of the bands at the left and right border in which all motion counts."""
    new_view: bool = True
    """Columns that the camera's turn has just brought into view belong to the region."""
    novelty_area_share: float = 0.001
    """Motion outside the dilated prior counts from this area on; 0 never counts."""
    novelty_frames: int = 2
    """Frames in which it must be seen in a row."""
    novelty_limit_share: float = 0.05
    """Where more of the frame than this moves outside the dilated prior, it is the background that moves, and no
    motion counts as novel."""
    # Corridor
    corridor: bool = True
    """Whether the region is widened to a band at all."""
    corridor_gap_share: float = 0.25
    """Empty columns, as a share of the width, that begin a new band; 1 makes one band of everything."""
    smoothing_window_columns: int = 15
    """w_s, odd."""
    smoothing_reference_width: int = 1600
    """Frame width at which ``smoothing_window_columns`` holds as it is, scaled elsewhere; 0 never scales."""
    top_margin: float = 0.10
    """eta_t, share of the distance to the upper border."""
    bottom_margin: float = 0.15
    """eta_b, share of the distance to the lower border."""
    side_margin_share: float = 0.02
    """eta_x, widening of each band to both sides."""
    side_margin_per_late_frame_share: float = 0.01
    """Further widening for each frame that the prior is older than one."""
    min_height_fraction: float = 0.1
    """h_min, share of the frame's height."""
    # Keyframes
    keyframe_policy: KeyframePolicyName = "paper"
    """What asks for a whole frame: ``paper`` a lost region or prior, ``periodic`` the count of frames, ``budget``
    the paper's causes within a byte rate, ``uncertainty`` the sum of what the edge can't know. First and requested
    frames and silence (``stale_after_s``) ask for one under every policy."""
    min_coverage: float = 0.02
    """tau_min, share of the frame below which R_k is taken for lost."""
    min_iou: float = 0.3
    """tau_iou, agreement of warped prior and new mask below which the prior is taken for lost."""
    empty_masks_agree: bool = True
    """IoU of two empty masks: 1 here, 0 to the letter."""
    settle_after_keyframe: bool = True
    """Nothing that goes back to a prior older than the last keyframe's mask can ask for the next keyframe, unless
    that mask is empty."""
    keyframe_backoff: bool = True
    """Each keyframe that reveals nothing outside the region doubles the wait until coverage asks again, from the
    minimum to the maximum interval; a lost prior, a find, or a region grown back ends it."""
    min_keyframe_interval: int = 3
    """Frames from one keyframe to the next at least, but for first and requested ones; a lost prior waits for it.
    Not under ``periodic``."""
    max_keyframe_interval: int = 50
    """Frames from one keyframe to the next at most, under ``paper`` and ``uncertainty``; also the longest wait of the
    back-off."""
    stale_after_s: float | None = 1.0
    """T_stale, capture time without any answer after which a keyframe is sent; None never does that. Once per such
    period, not within the minimum interval."""
    keyframe_period: int = 10
    """Frames between keyframes under ``periodic``."""
    keyframe_budget_kbps: float = 200.0
    """Byte rate of keyframes under ``budget``, kbit/s; a full budget buys a refresh."""
    keyframe_budget_burst_s: float = 5.0
    """How many seconds' worth of that rate may be saved up."""
    uncertainty_limit: float = 1.0
    """Uncertainty gathered since the last keyframe that asks for one under ``uncertainty``."""

    @classmethod
    def paper(cls, **changes: Any) -> RoiConfig:
        """The published method to the letter, with its defaults; ``changes`` replaces fields."""
        return replace(PAPER, **changes)

    @property
    def mode(self) -> str:
        """``paper`` or ``robust``, or ``paper + 2 changes`` for settings near to one of them."""
        near = min((("robust", ROBUST), ("paper", PAPER)), key=lambda preset: len(self.changes_from(preset[1])))
        count = len(self.changes_from(near[1]))
        return near[0] if count == 0 else f"{near[0]} + {count} change{'s' if count > 1 else ''}"

    def changes_from(self, other: RoiConfig) -> dict[str, Any]:
        """Fields whose values differ from another setting's, with the values here."""
        mine = {setting.name: getattr(self, setting.name) for setting in fields(self)}
        return {name: value for name, value in mine.items() if value != getattr(other, name)}

    def __post_init__(self) -> None:
        hints = get_type_hints(RoiConfig)
        for setting in fields(self):
            name, value = setting.name, getattr(self, setting.name)
            choices = get_args(hints[name])
            if isinstance(value, str) and value not in choices:
                raise ConfigurationError(f"RoiConfig.{name} is {value!r}; known: {', '.join(choices)}")
            if isinstance(value, (int, float)) and not (math.isfinite(value) and value >= 0):
                raise ConfigurationError(f"RoiConfig.{name} is {value}; give a finite number of at least 0")
            if name in POSITIVE and value == 0:
                raise ConfigurationError(f"RoiConfig.{name} is 0; give more")
            is_share = name.endswith(("_share", "_margin", "_fraction")) or name in ("min_coverage", "min_iou")
            if is_share and value > 1:
                raise ConfigurationError(f"RoiConfig.{name} is {value}; it is a share, give a number of 0..1")
        if self.smoothing_window_columns % 2 != 1:
            raise ConfigurationError(
                f"RoiConfig.smoothing_window_columns is {self.smoothing_window_columns}; give an odd number"
            )
        if self.min_keyframe_interval > self.max_keyframe_interval:
            raise ConfigurationError(
                f"RoiConfig.min_keyframe_interval is {self.min_keyframe_interval}, above max_keyframe_interval "
                f"{self.max_keyframe_interval}"
            )


ROBUST = RoiConfig()
PAPER = RoiConfig(
    analysis_scale=1,
    ego_model="paper",
    ego_fallback="identity",
    standstill_mps=0.0,
    epsilon_m=1e-6,
    max_shift_share=0.0,
    upright_actors=False,
    moving_actors=False,
    keep_unseen=False,
    linger_answers=0,
    residual_noise_factor=0.0,
    residual_opening=False,
    min_residual_area_px=0,
    dilation_from_focal_length=False,
    max_dilation_share=0.0,
    dilation_uncertainty_px=0.0,
    entry_band_share=0.0,
    new_view=False,
    novelty_area_share=0.0,
    corridor_gap_share=1.0,
    smoothing_reference_width=0,
    side_margin_share=0.0,
    side_margin_per_late_frame_share=0.0,
    empty_masks_agree=False,
    settle_after_keyframe=False,
    keyframe_backoff=False,
    min_keyframe_interval=0,
    max_keyframe_interval=1_000_000_000,
)
