"""The edge's per-frame loop (the paper's Algorithm 1), with answers that may come late."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_rpc.edge.corridor import corridor
from cable_rpc.edge.dilation import dilate, dilation_radius, fuse
from cable_rpc.edge.ego_motion import EgoStep, GreyImage, ego_step, warp_frame, warp_mask
from cable_rpc.edge.refresh import mask_iou, refresh_flag
from cable_rpc.edge.residual import grey, residual_motion
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.errors import ConfigurationError, FrameError
from cable_rpc.types import BoolMask, Frame, RoiMask, StageTimings

HISTORY_FRAMES = 64
"""Frames an answer may come late by; an older one finds its frame forgotten and is ignored."""

NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class RoiProposal:
    """What the edge sends of one frame, and how it came to that."""

    roi: RoiMask
    """The region that travels: R_k grown to the block grid, the whole frame on keyframes."""
    keyframe: bool
    """c_k: the frame is sent whole."""
    coverage: float
    """Share of the frame in the pixel-exact R_k, 0..1, on keyframes too; 1 where no mask has come yet."""
    prior_index: int | None
    """Index of the frame whose mask was the prior; None before the first mask."""
    staleness: int | None
    """Proposals from the prior's frame to this one, 1 in lock-step; None before the first mask."""
    dilation_px: float
    """b_k; 0 before the first mask."""
    shift_px: float
    """Horizontal shift of the prior, positive to the right; 0 before the first mask."""
    raw_coverage: float
    """Share of the frame in Rraw_k, before the corridor; 1 where no mask has come yet."""
    timings: StageTimings
    """Stages ``warp``, ``residual``, ``dilate``, ``fuse`` and ``corridor``."""


@dataclass(frozen=True, slots=True)
class Prior:
    """The newest mask, and what the vehicle did since its frame."""

    index: int
    mask: BoolMask
    step: EgoStep
    staleness: int


@dataclass(frozen=True, slots=True)
class ProposedFrame:
    """What must be known of a proposed frame when its mask comes."""

    step: EgoStep
    """From the frame before."""
    packed_prior: npt.NDArray[np.uint8] | None
    """The warped prior that was used there, eight pixels a byte; None before the first mask."""


@dataclass(frozen=True, slots=True)
class Region:
    """R_k and the steps on the way to it."""

    warped_prior: BoolMask
    pixels: BoolMask
    coverage: float
    raw_coverage: float
    dilation_px: float


class StageClock:
    """Splits the time of one frame into named stages."""

    def __init__(self) -> None:
        self.stages_ns: dict[str, int] = {}
        self._since = time.perf_counter_ns()

    def lap(self, stage: str) -> None:
        """Charge the time since the last lap to a stage."""
        now = time.perf_counter_ns()
        self.stages_ns[stage] = self.stages_ns.get(stage, 0) + now - self._since
        self._since = now


class RoiTracker:
    """Predicts the region of interest of each frame from the newest mask of the cloud.

    In lock-step (propose k, update k, propose k+1, ...) this is the paper's Algorithm 1. When answers are
    late, ego-motion is composed and the dilation grows over the gap, and the agreement of prior and mask is
    judged at the mask's own frame. Until the first mask has come there is nothing to predict from, and every
    proposal is a keyframe.

    One tracker serves one stream, from one thread. A frame that was proposed but never sent needs no call,
    unless it was a keyframe: then call ``request_keyframe``.

    Attributes:
        late_masks: answers ignored because a newer one was there already.
        unknown_masks: answers ignored because their frame was never proposed or is forgotten.

    Args:
        config: the method's settings.
        block_size: grid of the region that travels, in pixels; 1 sends R_k exactly.

    Raises:
        ConfigurationError: ``block_size`` is below 1.
    """

    def __init__(self, config: RoiConfig | None = None, block_size: int = 8) -> None:
        if block_size < 1:
            raise ConfigurationError(f"RoiTracker block_size is {block_size}; give at least 1 pixel")
        self.config = RoiConfig() if config is None else config
        self.block_size = block_size
        self.late_masks = 0
        self.unknown_masks = 0
        self.reset()

    def reset(self) -> None:
        """Forget the stream; the next frame starts a new one, of any size. The counters stay."""
        self._size_hw: tuple[int, int] | None = None
        self._last_index: int | None = None
        self._last_time_ns = 0
        self._last_grey: GreyImage | None = None
        self._last_coverage: float | None = None
        self._prior: Prior | None = None
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
        self._check(frame)
        step = self._step_to(frame)
        clock = StageClock()
        current = grey(frame.image)
        clock.lap("residual")

        prior = self._prior
        if prior is not None:
            prior = Prior(prior.index, prior.mask, prior.step.then(step), prior.staleness + 1)
        region = None if prior is None else self._region(prior, current, step, clock)
        keyframe = region is None or self._keyframe_due(frame, prior)
        if region is None or keyframe:
            roi = RoiMask.full(*frame.size_hw, self.block_size)
        else:
            roi = RoiMask.from_pixels(region.pixels, self.block_size)

        self._remember(frame, current, step, region, prior)
        if keyframe:
            self._keyframe_requested = False
            self._heard_time_ns = frame.capture_time_ns
        return RoiProposal(
            roi=roi,
            keyframe=keyframe,
            coverage=1.0 if region is None else region.coverage,
            prior_index=None if prior is None else prior.index,
            staleness=None if prior is None else prior.staleness,
            dilation_px=0.0 if region is None else region.dilation_px,
            shift_px=0.0 if prior is None else float(prior.step.homography[0, 2]),
            raw_coverage=1.0 if region is None else region.raw_coverage,
            timings=StageTimings(clock.stages_ns),
        )

    def update(self, index: int, mask: BoolMask) -> None:
        """Take the cloud's mask of an earlier frame as the new prior.

        An answer older than the present prior, or to a frame that was never proposed or is forgotten, is
        counted and ignored.

        Args:
            index: the frame's index.
            mask: bool [height, width]; copied.

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
        if mask.dtype != np.bool_ or mask.shape != self._size_hw:
            raise FrameError(
                f"mask of frame {index} is {mask.dtype} {mask.shape}, the stream's frames need bool {self._size_hw}"
            )
        if proposed.packed_prior is not None:
            warped_prior = np.unpackbits(proposed.packed_prior, count=mask.size).view(np.bool_)
            iou = mask_iou(warped_prior.reshape(mask.shape), mask)
            self._prior_iou = iou if self._prior_iou is None else min(iou, self._prior_iou)
        for older in [known for known in self._history if known <= index]:
            del self._history[older]
        step = EgoStep()
        for following in self._history.values():
            step = step.then(following.step)
        self._prior = Prior(index, mask.copy(), step, len(self._history))
        self._heard_time_ns = self._last_time_ns

    def _check(self, frame: Frame) -> None:
        image, ego = frame.image, frame.ego
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
            raise FrameError(
                f"image of frame {frame.index} is {image.dtype} {image.shape}; need uint8 [height, width, 3]"
            )
        if self._size_hw is not None and frame.size_hw != self._size_hw:
            raise ConfigurationError(
                f"frame {frame.index} is {frame.size_hw[1]}x{frame.size_hw[0]}, the stream began at "
                f"{self._size_hw[1]}x{self._size_hw[0]}; reset the tracker or resize the source"
            )
        if self._last_index is not None and frame.index <= self._last_index:
            raise FrameError(f"frame {frame.index} came after frame {self._last_index}; indices must rise")
        if self._last_index is not None and frame.capture_time_ns < self._last_time_ns:
            raise FrameError(
                f"frame {frame.index} was captured at {frame.capture_time_ns} ns, "
                f"before frame {self._last_index} at {self._last_time_ns} ns; check the source's clock"
            )
        if ego is not None and not all(map(math.isfinite, (ego.speed_mps, ego.lateral_mps, ego.yaw_rate_radps))):
            raise FrameError(f"ego-motion of frame {frame.index} isn't finite: {ego}; leave it out instead")

    def _step_to(self, frame: Frame) -> EgoStep:
        if self._last_index is None:
            return EgoStep()
        dt_s = (frame.capture_time_ns - self._last_time_ns) / NS_PER_S
        return ego_step(frame.ego, frame.intrinsics, dt_s, self.config)

    def _region(self, prior: Prior, current: GreyImage, step: EgoStep, clock: StageClock) -> Region:
        warped_prior = warp_mask(prior.mask, prior.step.homography)
        before = current if self._last_grey is None else self._last_grey
        warped_frame, valid = warp_frame(before, step.homography)
        clock.lap("warp")
        motion = residual_motion(current, warped_frame, valid, self.config.residual_threshold_levels)
        clock.lap("residual")
        radius_px = dilation_radius(self.config, prior.step.displacement_m, prior.step.yaw_change_deg)
        dilated = dilate(warped_prior, radius_px)
        clock.lap("dilate")
        raw = fuse(warped_prior, dilated, motion)
        clock.lap("fuse")
        pixels = corridor(raw, self.config)
        clock.lap("corridor")
        return Region(
            warped_prior=warped_prior,
            pixels=pixels,
            coverage=float(np.count_nonzero(pixels) / pixels.size),
            raw_coverage=float(np.count_nonzero(raw) / raw.size),
            dilation_px=radius_px,
        )

    def _keyframe_due(self, frame: Frame, prior: Prior | None) -> bool:
        limit_s = self.config.stale_after_s
        late = prior is not None and prior.staleness > 1 and limit_s is not None
        silent_s = (frame.capture_time_ns - self._heard_time_ns) / NS_PER_S
        stale = late and limit_s is not None and silent_s > limit_s
        return self._keyframe_requested or stale or refresh_flag(self._last_coverage, self._prior_iou, self.config)

    def _remember(
        self, frame: Frame, current: GreyImage, step: EgoStep, region: Region | None, prior: Prior | None
    ) -> None:
        self._prior = prior
        # Each answer is judged once, by the proposal after it.
        self._prior_iou = None
        self._size_hw = frame.size_hw
        self._last_index = frame.index
        self._last_time_ns = frame.capture_time_ns
        self._last_grey = current
        self._last_coverage = None if region is None else region.coverage
        packed = None if region is None else np.packbits(region.warped_prior)
        self._history[frame.index] = ProposedFrame(step, packed)
        if len(self._history) > HISTORY_FRAMES:
            self._history.popitem(last=False)
