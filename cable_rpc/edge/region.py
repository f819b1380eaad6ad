"""From the prior and what has moved to R_k (the paper's equations in their order)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cable_rpc.edge.actor_warp import warp_actors
from cable_rpc.edge.corridor import corridor
from cable_rpc.edge.dilation import dilate, dilation_radius, fuse, gated_dilation
from cable_rpc.edge.ego_motion import EgoStep
from cable_rpc.edge.entry import NoveltyDetector, entry_bands, first_actor_row, new_view
from cable_rpc.edge.proposal import RoiSteps
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.stage_clock import StageClock
from cable_rpc.edge.view_change import ViewChange
from cable_rpc.edge.view_warp import ViewWarp, warp_mask
from cable_rpc.types import BoolMask, Frame, RoiMask

NEW_VIEW_LIMIT_SHARE = 0.25
"""Beyond this share of the width a step has no past to speak of; only a keyframe helps."""


@dataclass(frozen=True, slots=True)
class Prior:
    """The newest mask, and what the vehicle did since its frame."""

    index: int
    """Frame of the mask."""
    mask: BoolMask
    """M_j, bool on the analysis grid."""
    support: BoolMask
    """The mask grown where the cloud was uncertain; the mask itself where it wasn't."""
    step: EgoStep
    """From the mask's frame to the newest."""
    staleness: int
    """Frames from the mask's to the newest."""

    def moved(self, step: EgoStep) -> Prior:
        """The same mask, seen one frame later."""
        return Prior(self.index, self.mask, self.support, self.step.then(step), self.staleness + 1)


@dataclass(frozen=True, slots=True)
class Region:
    """R_k, bool on the analysis grid, and what led to it."""

    warped_prior: BoolMask
    cells: BoolMask
    coverage: float
    raw_coverage: float
    dilation_px: float
    raw: BoolMask
    """Rraw_k, before the corridor."""
    steps: RoiSteps | None


def moved_mask(mask: BoolMask, step: EgoStep, config: RoiConfig) -> BoolMask:
    """Mhat, bool on the analysis grid; the argument itself where nothing moves."""
    warp = step.warp.scaled(1 / config.analysis_scale)
    return warp_actors(mask, warp) if config.upright_actors else warp_mask(mask, warp)


def with_moving_actors(standing: BoolMask, prior: Prior, config: RoiConfig) -> BoolMask:
    """The prior's support where its actors stand, and where they would be had they driven along with the vehicle.

    Seen from a vehicle, who drives along keeps his place but for the camera's turn.
    """
    warp = prior.step.warp
    if warp.far is None:
        return standing
    along = moved_mask(prior.support, EgoStep(ViewWarp(warp.far)), config)
    return standing | along


def vanished_pieces(before: BoolMask, now: BoolMask) -> BoolMask:
    """Connected pieces of an earlier mask, moved to the newest mask's frame, that nothing of that mask touches.

    A piece that is touched is an actor still seen, and its old place is none of the prior's business.

    Args:
        before: bool [rows, columns].
        now: bool [rows, columns].
    """
    count, labels = cv2.connectedComponentsWithAlgorithm(
        (before | now).view(np.uint8), 8, cv2.CV_32S, cv2.CCL_SPAGHETTI
    )
    seen = np.zeros(count, np.bool_)
    seen[labels[now]] = True
    seen[0] = True
    vanished: BoolMask = ~seen[labels]
    return vanished


def region_blocks(cells: BoolMask, scale: int, size_hw: tuple[int, int], block_size: int) -> RoiMask:
    """The smallest block mask that covers a region.

    Args:
        cells: bool [ceil(height / scale), ceil(width / scale)].
        scale: pixels per cell, along each axis.
        size_hw: (height, width) of the frame.
        block_size: side of a block in pixels.
    """
    if scale == 1:
        return RoiMask.from_pixels(cells, block_size)
    if block_size % scale == 0:
        return RoiMask(RoiMask.from_pixels(cells, block_size // scale).blocks, block_size, *size_hw)
    return RoiMask.from_pixels(RoiMask(cells, scale, *size_hw).pixels(), block_size)


class RegionPredictor:
    """Turns a moved prior and the view's change into R_k; keeps what it saw of novel motion."""

    def __init__(self, config: RoiConfig, *, keep_steps: bool = False) -> None:
        self._config = config
        self._keep_steps = keep_steps
        self._novelty = NoveltyDetector(config)

    def predict(self, frame: Frame, prior: Prior, change: ViewChange, clock: StageClock) -> Region:
        """R_k = corridor(Mhat ∪ (Mplus ∩ D_k)) ∪ what has newly come into the picture.

        Args:
            frame: the frame that the prior has been moved to.
            prior: newest mask with the ego-motion since.
            change: since the frame before.
            clock: is charged for ``warp``, ``dilate``, ``corridor`` and ``entry``.
        """
        config, scale = self._config, self._config.analysis_scale
        warped_prior = moved_mask(prior.mask, prior.step, config)
        support = warped_prior if prior.support is prior.mask else moved_mask(prior.support, prior.step, config)
        if config.moving_actors:
            support = with_moving_actors(support, prior, config)
        clock.lap("warp")
        fx = None if frame.intrinsics is None else frame.intrinsics.fx
        radius_px = dilation_radius(
            config, prior.step.displacement_m, prior.step.yaw_change_deg, fx=fx, width=frame.size_hw[1]
        )
        dilated = None
        if config.novelty_area_share > 0 or self._keep_steps:
            dilated = dilate(support, radius_px / scale)
            raw = fuse(support, dilated, change.motion)
        else:
            raw = gated_dilation(support, change.motion, radius_px / scale)
        clock.lap("dilate")
        cells = corridor(raw, config, scale=scale, late_frames=prior.staleness - 1)
        clock.lap("corridor")
        entered = self._entered(dilated, change)
        if entered is not None:
            np.logical_or(cells, entered, out=cells)
        clock.lap("entry")
        steps = None
        if self._keep_steps and dilated is not None:
            steps = RoiSteps(
                scale=scale,
                warped_prior=warped_prior,
                motion=change.motion,
                dilated=dilated,
                raw=raw,
                entered=np.zeros_like(cells) if entered is None else entered,
                region=cells,
            )
        return Region(
            warped_prior=warped_prior,
            cells=cells,
            coverage=RoiMask(cells, scale, *frame.size_hw).coverage,
            raw_coverage=RoiMask(raw, scale, *frame.size_hw).coverage,
            dilation_px=radius_px,
            raw=raw,
            steps=steps,
        )

    def _entered(self, dilated: BoolMask | None, change: ViewChange) -> BoolMask | None:
        """What entry bands, the new view and novel motion add; None where that is nothing."""
        config = self._config
        horizon_row = change.step.warp.scaled(1 / config.analysis_scale).horizon_row
        first_row = first_actor_row(change.motion.shape[0], horizon_row)
        found: list[BoolMask | None] = []
        if config.entry_band_share > 0:
            found.append(entry_bands(change.motion, config.entry_band_share, first_row=first_row))
        if config.new_view:
            found.append(new_view(change.valid, NEW_VIEW_LIMIT_SHARE, first_row=first_row))
        if dilated is not None:
            found.append(self._novelty.update(change.motion, dilated, first_row=first_row))
        entered: BoolMask | None = None
        for one in found:
            if one is not None:
                entered = one if entered is None else np.logical_or(entered, one, out=entered)
        return entered
