"""What the method is compared with: regions from motion alone, from the first mask alone, and from boxes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from cable_rpc.edge.corridor import corridor
from cable_rpc.edge.ego_motion import EgoStep
from cable_rpc.edge.proposal import RoiProposal
from cable_rpc.edge.region import Prior, RegionPredictor, region_blocks
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.stage_clock import StageClock
from cable_rpc.edge.strategy import WithoutFeedback
from cable_rpc.edge.view_change import ViewChangeEstimator
from cable_rpc.errors import FrameError
from cable_rpc.types import BoolMask, Frame, RoiMask, UncertaintyMap

BoxFinder = Callable[[Frame], npt.NDArray[np.float32]]
"""Boxes of a frame, float32 [N, 4], xyxy in pixels."""

WAITING_FRAMES = 64
"""Frames that the first answer may come late by."""


class MotionOnly(WithoutFeedback):
    """R_k = Corridor(D_k): whatever the ego-motion does not explain; the cloud is never asked where actors are."""

    def __init__(self, config: RoiConfig, block_size: int = 8) -> None:
        self._config = config
        self._block_size = block_size
        self._view = ViewChangeEstimator(config)
        self._keyframe_requested = True

    def propose(self, frame: Frame) -> RoiProposal:
        """Everything that moves, widened to the corridor; the first frame is sent whole."""
        clock = StageClock()
        change = self._view.advance(frame, None, clock)
        scale = self._config.analysis_scale
        cells = corridor(change.motion, self._config, scale=scale)
        clock.lap("corridor")
        keyframe, self._keyframe_requested = self._keyframe_requested, False
        whole = RoiMask.full(*frame.size_hw, self._block_size)
        return RoiProposal(
            whole if keyframe else region_blocks(cells, scale, frame.size_hw, self._block_size),
            keyframe,
            1.0 if keyframe else RoiMask(cells, scale, *frame.size_hw).coverage,
            keyframe_reason="requested" if keyframe else None,
            raw_coverage=RoiMask(change.motion, scale, *frame.size_hw).coverage,
            ego_model=change.step.model,
            timings=clock.timings,
        )

    def request_keyframe(self) -> None:
        """Make the next proposal whole."""
        self._keyframe_requested = True


class OpenLoop(WithoutFeedback):
    """Follows the mask of the first whole frame by itself: the prior of frame k + 1 is Rraw_k, never a new mask.

    Frames are sent whole until the first answer has come. A requested keyframe starts it again.
    """

    def __init__(self, config: RoiConfig, block_size: int = 8, *, keep_steps: bool = False) -> None:
        self._config = config
        self._block_size = block_size
        self._view = ViewChangeEstimator(config)
        self._predictor = RegionPredictor(config, keep_steps=keep_steps)
        self._prior: Prior | None = None
        self._waiting: OrderedDict[int, EgoStep] = OrderedDict()

    def propose(self, frame: Frame) -> RoiProposal:
        """The region that propagation alone has led to."""
        clock = StageClock()
        change = self._view.advance(frame, None if self._prior is None else self._prior.mask, clock)
        if self._prior is None:
            self._waiting[frame.index] = change.step
            if len(self._waiting) > WAITING_FRAMES:
                self._waiting.popitem(last=False)
            whole = RoiMask.full(*frame.size_hw, self._block_size)
            return RoiProposal(whole, True, 1.0, keyframe_reason="first", timings=clock.timings)
        prior = self._prior.moved(change.step)
        region = self._predictor.predict(frame, prior, change, clock)
        self._prior = Prior(prior.index, region.raw, region.raw, EgoStep(), prior.staleness)
        return RoiProposal(
            region_blocks(region.cells, self._config.analysis_scale, frame.size_hw, self._block_size),
            False,
            region.coverage,
            prior_index=prior.index,
            staleness=prior.staleness,
            dilation_px=region.dilation_px,
            shift_px=prior.step.warp.centre_shift_px(frame.size_hw),
            raw_coverage=region.raw_coverage,
            ego_model=change.step.model,
            timings=clock.timings,
            steps=region.steps,
        )

    def update(
        self, index: int, mask: BoolMask, *, confidence: float = 1.0, uncertainty: UncertaintyMap | None = None
    ) -> None:
        """Takes the first answer to a whole frame; all later ones are ignored."""
        if index not in self._waiting:
            return
        step = EgoStep()
        for later, following in self._waiting.items():
            if later > index:
                step = step.then(following)
        cells = RoiMask.from_pixels(mask, self._config.analysis_scale).blocks
        self._prior = Prior(index, cells, cells, step, sum(later > index for later in self._waiting))
        self._waiting.clear()

    def request_keyframe(self) -> None:
        """Forget the propagated region; frames are whole until the next answer."""
        self._prior = None


class BoxRegions(WithoutFeedback):
    """R_k = the boxes of this very frame, found at the edge or known as truth, with a margin around each.

    Args:
        find: the boxes of a frame.
        margin_share: widening of each box to all sides, share of the frame's width.
        block_size: grid of the region that travels.
    """

    def __init__(self, find: BoxFinder, margin_share: float = 0.01, block_size: int = 8) -> None:
        self._find = find
        self._margin_share = margin_share
        self._block_size = block_size
        self._keyframe_requested = False

    def propose(self, frame: Frame) -> RoiProposal:
        """The boxes, grown to blocks."""
        clock = StageClock()
        boxes = self._find(frame)
        clock.lap("detect")
        height, width = frame.size_hw
        margin = self._margin_share * width
        limit = np.array([width, height, width, height], np.float64)
        edges = np.clip(boxes + np.array([-margin, -margin, margin, margin]), 0, limit)
        region = np.zeros(frame.size_hw, np.bool_)
        for left, top, right, bottom in edges:
            region[int(top) : int(np.ceil(bottom)), int(left) : int(np.ceil(right))] = True
        keyframe, self._keyframe_requested = self._keyframe_requested, False
        whole = RoiMask.full(height, width, self._block_size)
        coverage = float(np.count_nonzero(region) / region.size)
        clock.lap("decide")
        return RoiProposal(
            whole if keyframe else RoiMask.from_pixels(region, self._block_size),
            keyframe,
            coverage,
            keyframe_reason="requested" if keyframe else None,
            raw_coverage=coverage,
            timings=clock.timings,
        )

    def request_keyframe(self) -> None:
        """Make the next proposal whole."""
        self._keyframe_requested = True


def truth_boxes(frame: Frame) -> npt.NDArray[np.float32]:
    """The annotated boxes of a frame: an upper bound for evaluation.

    Raises:
        FrameError: the frame has no truth.
    """
    if frame.truth is None:
        raise FrameError(f"frame {frame.index} has no annotated boxes; oracle boxes need a source with truth")
    return frame.truth.boxes_xyxy
