"""The strategies that a study compares, by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cable_rpc.cloud.backends import BackendOptions, Detector, load_detector
from cable_rpc.edge.baselines import BoxFinder, BoxRegions, MotionOnly, OpenLoop, truth_boxes
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.edge.strategy import FullFrame, RoiStrategy
from cable_rpc.errors import ConfigurationError
from cable_rpc.types import Frame

STRATEGIES = {
    "cable": "the loop: cloud mask, ego-motion, residual motion, corridor",
    "no-corridor": "the loop without the corridor",
    "open-loop": "the first mask, propagated by motion alone",
    "motion-only": "residual motion and corridor, no mask",
    "full-frame": "everything: what savings are measured against",
    "oracle-boxes": "annotated boxes of the frame itself: an upper bound",
    "edge-boxes:DETECTOR": "boxes of a detector at the edge, e.g. edge-boxes:embedded",
}
"""Name to a short description."""

EDGE_MIN_SCORE = 0.2
"""Score from which an edge detector's box is sent: a doubtful object is worth its bytes, the cloud decides."""


def open_strategy(name: str, config: RoiConfig, block_size: int = 8, *, keep_steps: bool = False) -> RoiStrategy:
    """A fresh strategy for one stream.

    Args:
        name: a key of `STRATEGIES`; ``edge-boxes:`` takes a detector as `load_detector` does.
        config: settings for those that predict.
        block_size: grid of the region that travels, in pixels.
        keep_steps: show R_k itself in each proposal, where the strategy has one.

    Raises:
        ConfigurationError: unknown name or detector.
        ModelError: the detector can't be loaded.
    """
    kind, _, argument = name.partition(":")
    if kind == "edge-boxes" and argument:
        return BoxRegions(
            detector_boxes(load_detector(argument, BackendOptions(min_score=EDGE_MIN_SCORE))), block_size=block_size
        )
    if name == "cable":
        return RoiTracker(config, block_size, keep_steps=keep_steps)
    if name == "no-corridor":
        return RoiTracker(replace(config, corridor=False), block_size, keep_steps=keep_steps)
    if name == "open-loop":
        return OpenLoop(config, block_size, keep_steps=keep_steps)
    if name == "motion-only":
        return MotionOnly(config, block_size)
    if name == "full-frame":
        return FullFrame(block_size)
    if name == "oracle-boxes":
        return BoxRegions(truth_boxes, block_size=block_size)
    raise ConfigurationError(f"strategy '{name}' is unknown; use one of {', '.join(STRATEGIES)}")


def detector_boxes(detector: Detector) -> BoxFinder:
    """The boxes that a detector finds in a frame, scores set aside."""

    def find(frame: Frame) -> npt.NDArray[np.float32]:
        return detector.detect([frame.image])[0].boxes_xyxy

    return find
