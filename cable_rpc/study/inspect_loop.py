"""The loop run up to one frame, with several settings of the method side by side."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from cable_codecs import diffuse_background

from cable_rpc.cloud.backends import Detector, FrameContext
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.inspect_panels import ModeView
from cable_rpc.study.loop_simulator import CloudModel
from cable_rpc.types import Frame, RoiMask, Segmentation


@dataclass(slots=True)
class Loop:
    """One tracker, its cloud, and the answers on their way."""

    title: str
    tracker: RoiTracker
    cloud: CloudModel
    delay: int
    under_way: list[tuple[int, Segmentation]] = field(default_factory=list)

    def advance(self, frame: Frame) -> ModeView:
        """Take the answer that is due, propose the frame, have it answered."""
        if len(self.under_way) >= self.delay:
            index, due = self.under_way.pop(0)
            self.tracker.update(index, due.mask, confidence=due.confidence, uncertainty=due.uncertainty)
        proposal = self.tracker.propose(frame)
        answer = self.cloud(frame, proposal.roi)
        self.under_way.append((frame.index, answer))
        return ModeView(self.title, frame, proposal, answer.mask)


class DetectorCloud:
    """Boxes of a detector that sees what was sent amid its own colours, as the server shows it by default."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self._segmenter = BoxSegmenter()

    def __call__(self, frame: Frame, region: RoiMask) -> Segmentation:
        """Segment one frame, cut to the region."""
        sent = region.pixels()
        image = diffuse_background(frame.image, sent)
        context = FrameContext(frame.index, self._detector.detect([image])[0])
        found = self._segmenter.segment(image, sent, "", context)
        known = None if found.uncertainty is None else np.where(sent, found.uncertainty, np.uint8(0))
        return Segmentation(found.mask & sent, found.confidence, uncertainty=known)


def inspect_last(
    frames: Iterable[Frame],
    configs: Mapping[str, RoiConfig],
    cloud: CloudModel,
    *,
    delay: int = 1,
    block_size: int = 8,
) -> list[ModeView]:
    """Run the loop over frames with each setting, and keep what the last frame came to.

    Args:
        frames: in the source's order; the first is sent whole.
        configs: title of a setting to the setting.
        cloud: answers what was sent of a frame.
        delay: the answer to a frame is there ``delay`` frames later; 1 is lock-step.
        block_size: grid of the region that travels, in pixels.

    Returns:
        One view for each setting, in their order, with the steps kept.

    Raises:
        ConfigurationError: there is no frame, or ``delay`` is below 1.
        CableError: what tracker, source or cloud raise.
    """
    if delay < 1:
        raise ConfigurationError(f"the feedback delay is {delay} frames; lock-step is 1, give no less")
    loops = [
        Loop(title, RoiTracker(config, block_size, keep_steps=True), cloud, delay) for title, config in configs.items()
    ]
    views: list[ModeView] = []
    for frame in frames:
        views = [loop.advance(frame) for loop in loops]
    if not views:
        raise ConfigurationError("there is no frame to inspect")
    return views
