"""What happened between two camera frames: the vehicle's step, and the residual motion that it does not explain."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from cable_rpc.edge.ego_motion import EgoStep, ego_step
from cable_rpc.edge.residual import analysis_grey, motion_map
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.stage_clock import StageClock
from cable_rpc.edge.view_warp import GreyImage, warp_frame
from cable_rpc.edge.visual_motion import estimate_view_motion
from cable_rpc.errors import ConfigurationError, FrameError
from cable_rpc.types import BoolMask, Frame

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ViewChange:
    """From the frame before to this one; maps are bool on the analysis grid."""

    step: EgoStep
    motion: BoolMask
    """D_k, empty on a stream's first frame."""
    valid: BoolMask | None
    """Where the warped frame before is defined; None for everywhere."""


class ViewChangeEstimator:
    """Keeps the last frame's grey picture, and compares the next one with it.

    Refuses frames that don't continue the stream, and is then as before the call.
    """

    def __init__(self, config: RoiConfig) -> None:
        self.config = config
        self.size_hw: tuple[int, int] | None = None
        self._index: int | None = None
        self._time_ns = 0
        self._grey: GreyImage | None = None

    def advance(self, frame: Frame, moving: BoolMask | None, clock: StageClock) -> ViewChange:
        """Take the next frame.

        Args:
            frame: its index must rise and its capture time must not fall.
            moving: bool on the analysis grid, where actors were in the frame before; the ``flow`` model looks
                elsewhere.
            clock: is charged for ``grey``, ``warp`` and ``residual``.

        Raises:
            ConfigurationError: the frame's size differs from the stream's.
            FrameError: the image isn't uint8 [height, width, 3], index or time runs backwards, or the
                ego-motion isn't finite.
        """
        self._check(frame)
        scale = self.config.analysis_scale
        current = analysis_grey(frame.image, scale)
        clock.lap("grey")
        if self._grey is None:
            change = ViewChange(EgoStep(), np.zeros(current.shape, np.bool_), None)
        else:
            step = self._step(frame, self._grey, current, moving)
            warped, valid = warp_frame(self._grey, step.warp.scaled(1 / scale))
            clock.lap("warp")
            motion = motion_map(current, warped, valid if self.config.mask_warp_border else None, self.config, scale)
            change = ViewChange(step, motion, valid)
            clock.lap("residual")
        self.size_hw = frame.size_hw
        self._index = frame.index
        self._time_ns = frame.capture_time_ns
        self._grey = current
        return change

    def _step(self, frame: Frame, before: GreyImage, current: GreyImage, moving: BoolMask | None) -> EgoStep:
        dt_s = (frame.capture_time_ns - self._time_ns) / NS_PER_S
        step = ego_step(frame.ego, frame.intrinsics, frame.mount, dt_s, self.config, frame.size_hw[1])
        if step.model != "flow":
            return step
        seen = estimate_view_motion(before, current, moving)
        if seen is None:
            return replace(step, model="identity")
        return replace(step, warp=seen.scaled(self.config.analysis_scale))

    def _check(self, frame: Frame) -> None:
        image, ego = frame.image, frame.ego
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
            raise FrameError(
                f"image of frame {frame.index} is {image.dtype} {image.shape}; need uint8 [height, width, 3]"
            )
        if self.size_hw is not None and frame.size_hw != self.size_hw:
            raise ConfigurationError(
                f"frame {frame.index} is {frame.size_hw[1]}x{frame.size_hw[0]}, the stream began at "
                f"{self.size_hw[1]}x{self.size_hw[0]}; reset the tracker or resize the source"
            )
        if self._index is not None and frame.index <= self._index:
            raise FrameError(f"frame {frame.index} came after frame {self._index}; indices must rise")
        if self._index is not None and frame.capture_time_ns < self._time_ns:
            raise FrameError(
                f"frame {frame.index} was captured at {frame.capture_time_ns} ns, "
                f"before frame {self._index} at {self._time_ns} ns; check the source's clock"
            )
        if ego is not None and not all(map(math.isfinite, (ego.speed_mps, ego.lateral_mps, ego.yaw_rate_radps))):
            raise FrameError(f"ego-motion of frame {frame.index} isn't finite: {ego}; leave it out instead")
