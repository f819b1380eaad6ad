"""The edge's per-frame loop (the paper's Algorithm 1), with answers that may come late."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cable_rpc.edge.dilation import grow_uncertain
from cable_rpc.edge.ego_motion import EgoStep
from cable_rpc.edge.keyframe_policy import KeyframeScheduler, KeyframeSignals, NewAnswer
from cable_rpc.edge.proposal import RoiProposal
from cable_rpc.edge.refresh import mask_iou, revealed_share
from cable_rpc.edge.region import Prior, Region, RegionPredictor, moved_mask, region_blocks, vanished_pieces
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.stage_clock import StageClock
from cable_rpc.edge.view_change import ViewChange, ViewChangeEstimator
from cable_rpc.errors import ConfigurationError, FrameError
from cable_rpc.types import BoolMask, Frame, RoiMask, UncertaintyMap

HISTORY_FRAMES = 64
"""Frames an answer may come late by; an older one finds its frame forgotten and is ignored."""

PackedMask = npt.NDArray[np.uint8]
"""Eight cells of a mask to the byte."""


@dataclass(frozen=True, slots=True)
class ProposedFrame:
    """What must be known of a proposed frame when its mask comes."""

    step: EgoStep
    """From the frame before."""
    time_ns: int
    keyframe: bool
    prior_index: int | None
    """Frame of the mask that was its prior; None before the first mask."""
    prior: PackedMask | None
    """That prior, warped to the frame."""
    region: PackedMask | None
    """R_k, also where the frame was sent whole; None where nothing will ask for it."""


def unpacked(packed: PackedMask, shape: tuple[int, ...]) -> BoolMask:
    """The mask of a given shape."""
    return np.unpackbits(packed, count=math.prod(shape)).view(np.bool_).reshape(shape)


class RoiTracker:
    """Predicts the region of interest of each frame from the newest mask of the cloud.

    In lock-step (propose k, update k, propose k+1, ...) with ``RoiConfig.paper()`` this is the paper's
    Algorithm 1. When answers are late, ego-motion is composed and the dilation grows over the gap, and the
    agreement of prior and mask is judged at the mask's own frame. Until the first mask has come there is nothing
    to predict from, and every proposal is a keyframe.

    One tracker serves one stream, from one thread. A frame that was proposed but never sent needs no call,
    unless it was a keyframe: then call ``request_keyframe``.

    Attributes:
        late_masks: answers ignored because a newer one was there already.
        unknown_masks: answers ignored because their frame was never proposed or is forgotten.
        clamped_shifts: frames whose ego-motion was beyond ``max_shift_share``.

    Args:
        config: the method's settings; robust by default.
        block_size: grid of the region that travels, in pixels; 1 sends R_k as it is.
        keep_steps: put the maps on the way to R_k into each proposal.

    Raises:
        ConfigurationError: ``block_size`` is below 1.
    """

    def __init__(self, config: RoiConfig | None = None, block_size: int = 8, *, keep_steps: bool = False) -> None:
        if block_size < 1:
            raise ConfigurationError(f"RoiTracker block_size is {block_size}; give at least 1 pixel")
        self.config = RoiConfig() if config is None else config
        self.block_size = block_size
        self.late_masks = 0
        self.unknown_masks = 0
        self.clamped_shifts = 0
        self._keep_steps = keep_steps
        self.reset()

    def reset(self) -> None:
        """Forget the stream; the next frame starts a new one, of any size. The counters stay."""
        self._view = ViewChangeEstimator(self.config)
        self._predictor = RegionPredictor(self.config, keep_steps=self._keep_steps)
        self._scheduler = KeyframeScheduler(self.config)
        self._last_time_ns = 0
        self._last_region: Region | None = None
        self._prior: Prior | None = None
        self._missed: list[tuple[BoolMask, int]] = []
        self._answer: NewAnswer | None = None
        self._prior_iou: float | None = None
        self._history: OrderedDict[int, ProposedFrame] = OrderedDict()
        self._heard_time_ns = 0
        self._keyframe_requested = False

    def request_keyframe(self) -> None:
        """Make the next proposal a keyframe: after a reconnect, or when the server asks for one."""
        self._keyframe_requested = True

    def propose(self, frame: Frame) -> RoiProposal:
        """The region to send of a frame.

        Args:
            frame: the next frame; its index must rise and its capture time must not fall.

        Raises:
            ConfigurationError: the frame's size differs from the stream's.
            FrameError: the image isn't uint8 [height, width, 3], index or time runs backwards, or the
                ego-motion isn't finite. The tracker is as before the call.
        """
        clock = StageClock()
        moving = None if self._last_region is None else self._last_region.warped_prior
        change = self._view.advance(frame, moving, clock)
        self.clamped_shifts += change.step.clamped
        prior = None if self._prior is None else self._prior.moved(change.step)
        region = None if prior is None else self._predictor.predict(frame, prior, change, clock)
        reason = self._keyframe_reason(frame, prior, region, change)
        if region is None or reason is not None:
            roi = RoiMask.full(*frame.size_hw, self.block_size)
        else:
            roi = region_blocks(region.cells, self.config.analysis_scale, frame.size_hw, self.block_size)
        self._remember(frame, change.step, reason is not None, region, prior)
        clock.lap("decide")
        proposal = RoiProposal(
            roi, reason is not None, 1.0, keyframe_reason=reason, ego_model=change.step.model, timings=clock.timings
        )
        if prior is None or region is None:
            return proposal
        return replace(
            proposal,
            coverage=region.coverage,
            prior_index=prior.index,
            staleness=prior.staleness,
            dilation_px=region.dilation_px,
            shift_px=prior.step.warp.centre_shift_px(frame.size_hw),
            raw_coverage=region.raw_coverage,
            steps=region.steps,
        )

    def update(
        self, index: int, mask: BoolMask, *, confidence: float = 1.0, uncertainty: UncertaintyMap | None = None
    ) -> None:
        """Take the cloud's mask of an earlier frame as the new prior.

        An answer older than the present prior, or to a frame that was never proposed or is forgotten, is
        counted and ignored. Tell what the frame cost (``sent``) before its answer.

        Args:
            index: the frame's index.
            mask: bool [height, width]; copied.
            confidence: 0..1, of the mask as a whole.
            uncertainty: uint8 [height, width] of each pixel, where the cloud tells it; copied.

        Raises:
            FrameError: the mask's type or size is wrong.
        """
        if self._prior is not None and index <= self._prior.index:
            self.late_masks += 1
            return
        proposed = self._history.get(index)
        if proposed is None:
            self.unknown_masks += 1
            return
        if mask.dtype != np.bool_ or mask.shape != self._view.size_hw:
            raise FrameError(
                f"mask of frame {index} is {mask.dtype} {mask.shape}, the stream's frames need bool "
                f"{self._view.size_hw}"
            )
        scale = self.config.analysis_scale
        cells = mask.copy() if scale == 1 else RoiMask.from_pixels(mask, scale).blocks
        self._judge(proposed, cells, confidence)
        since_prior = self._step_from_prior_to(index)
        before = self._prior_at(proposed, cells.shape, since_prior)
        cells = self._with_unseen(proposed, cells, before)
        self._missed = self._still_missed(cells, before, since_prior)
        for older in [known for known in self._history if known <= index]:
            del self._history[older]
        step = EgoStep()
        for following in self._history.values():
            step = step.then(following.step)
        support = cells
        if uncertainty is not None and self.config.dilation_uncertainty_px > 0:
            support = grow_uncertain(cells, uncertainty, scale, self.config.dilation_uncertainty_px)
        if self._missed:
            support = np.logical_or.reduce([support, *(mask for mask, _ in self._missed)])
        self._prior = Prior(index, cells, support, step, len(self._history))
        self._heard_time_ns = self._last_time_ns

    def sent(self, index: int, byte_count: int) -> None:
        """A proposed frame was really sent, in so many bytes; the ``budget`` policy pays for keyframes with it."""
        proposed = self._history.get(index)
        if proposed is not None:
            self._scheduler.sent(proposed.keyframe, byte_count, proposed.time_ns)

    def _step_from_prior_to(self, index: int) -> EgoStep:
        """The way from the present prior's frame to a later one that is still remembered."""
        step = EgoStep()
        if self._prior is not None:
            for following, one in self._history.items():
                if self._prior.index < following <= index:
                    step = step.then(one.step)
        return step

    def _prior_at(self, proposed: ProposedFrame, shape: tuple[int, ...], since_prior: EgoStep) -> BoolMask | None:
        """The present prior's mask, seen from an answered frame."""
        if self._prior is None:
            return None
        if proposed.prior is not None and proposed.prior_index == self._prior.index:
            return unpacked(proposed.prior, shape)
        return moved_mask(self._prior.mask, since_prior, self.config)

    def _still_missed(
        self, cells: BoolMask, before: BoolMask | None, since_prior: EgoStep
    ) -> list[tuple[BoolMask, int]]:
        """Pieces of earlier masks that the cloud has not seen again, with the answers for which they stay."""
        if before is None or self.config.linger_answers == 0:
            return []
        missed = [(moved_mask(mask, since_prior, self.config), left - 1) for mask, left in self._missed if left > 1]
        missed.append((before, self.config.linger_answers))
        gone = [(vanished_pieces(mask, cells), left) for mask, left in missed]
        return [(mask, left) for mask, left in gone if mask.any()]

    def _with_unseen(self, proposed: ProposedFrame, cells: BoolMask, before: BoolMask | None) -> BoolMask:
        """A frame's mask, joined outside its region by a prior that is newer than the one it was sent with."""
        prior = self._prior
        if not self.config.keep_unseen or prior is None or proposed.keyframe or proposed.region is None:
            return cells
        if proposed.prior_index is not None and proposed.prior_index >= prior.index:
            return cells
        return cells if before is None else cells | (before & ~unpacked(proposed.region, cells.shape))

    def _judge(self, proposed: ProposedFrame, cells: BoolMask, confidence: float) -> None:
        if proposed.prior is not None:
            prior = unpacked(proposed.prior, cells.shape)
            iou = mask_iou(prior, cells, empty_masks_agree=self.config.empty_masks_agree)
            self._prior_iou = iou if self._prior_iou is None else min(iou, self._prior_iou)
        revealed = float(cells.any())
        if proposed.region is not None:
            revealed = revealed_share(cells, unpacked(proposed.region, cells.shape))
        if self._answer is None or proposed.keyframe or not self._answer.of_keyframe:
            self._answer = NewAnswer(not cells.any(), proposed.keyframe, revealed, confidence)

    def _keyframe_reason(
        self, frame: Frame, prior: Prior | None, region: Region | None, change: ViewChange
    ) -> str | None:
        outside = 0.0
        if region is not None and self.config.keyframe_policy == "uncertainty":
            outside = float(np.count_nonzero(change.motion & ~region.cells) / change.motion.size)
        signals = KeyframeSignals(
            time_ns=frame.capture_time_ns,
            first=region is None,
            requested=self._keyframe_requested,
            coverage=None if self._last_region is None else self._last_region.coverage,
            prior_iou=self._prior_iou,
            answer=self._answer,
            staleness=None if prior is None else prior.staleness,
            residual_outside=outside,
            heard_time_ns=self._heard_time_ns,
        )
        return self._scheduler.decide(signals)

    def _remember(
        self, frame: Frame, step: EgoStep, keyframe: bool, region: Region | None, prior: Prior | None
    ) -> None:
        if keyframe:
            self._keyframe_requested = False
            self._heard_time_ns = frame.capture_time_ns
        self._prior = prior
        # Each answer is judged once, by the proposal after it.
        self._prior_iou = None
        self._answer = None
        self._last_time_ns = frame.capture_time_ns
        self._last_region = region
        needs_region = region is not None and (keyframe or self.config.keep_unseen)
        self._history[frame.index] = ProposedFrame(
            step,
            frame.capture_time_ns,
            keyframe,
            None if prior is None else prior.index,
            None if region is None else np.packbits(region.warped_prior),
            np.packbits(region.cells) if region is not None and needs_region else None,
        )
        if len(self._history) > HISTORY_FRAMES:
            self._history.popitem(last=False)
