"""What the edge decides for one frame, and the maps that led to it."""

from __future__ import annotations

from dataclasses import dataclass, field

from cable_rpc.types import BoolMask, RoiMask, StageTimings


@dataclass(frozen=True)
class RoiSteps:
    """The maps on the way to R_k, bool on the analysis grid, for pictures and measurements."""

    scale: int
    """Full-frame pixels per cell, along each axis."""
    warped_prior: BoolMask
    """Mhat."""
    motion: BoolMask
    """D_k."""
    dilated: BoolMask
    """Mplus."""
    raw: BoolMask
    """Rraw_k."""
    entered: BoolMask
    """What entry bands, new view and novelty add."""
    region: BoolMask
    """R_k."""


@dataclass(frozen=True)
class RoiProposal:
    """What the edge sends of one frame, and how it came to that."""

    roi: RoiMask
    """The region that travels: R_k grown to the block grid, the whole frame on keyframes."""
    keyframe: bool
    """c_k: the frame is sent whole."""
    coverage: float
    """Share of the frame in R_k before it is grown to blocks, 0..1, on keyframes too; 1 where no mask has come yet."""
    keyframe_reason: str | None = None
    """Why the frame is sent whole (`keyframe_policy`); None if it isn't."""
    prior_index: int | None = None
    """Index of the frame whose mask was the prior; None before the first mask."""
    staleness: int | None = None
    """Proposals from the prior's frame to this one, 1 in lock-step; None before the first mask."""
    dilation_px: float = 0.0
    """b_k, full-frame pixels; 0 before the first mask."""
    shift_px: float = 0.0
    """Horizontal shift of the prior at the frame's centre, full-frame pixels, positive to the right; 0 before the
    first mask."""
    raw_coverage: float = 1.0
    """Share of the frame in Rraw_k, before the corridor; 1 where no mask has come yet."""
    ego_model: str = ""
    """The ego-motion model that the frame's data allowed."""
    timings: StageTimings = field(default_factory=StageTimings)
    """Stages ``grey``, ``warp``, ``residual``, ``dilate``, ``corridor``, ``entry``, ``decide``."""
    steps: RoiSteps | None = None
    """Only where the strategy was asked to keep them."""
