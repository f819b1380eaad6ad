"""The regions that a codec study codes: a fixed moving one, and those of the loop itself."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.loop_simulator import CloudModel
from cable_rpc.types import BoolMask, Frame

CORRIDOR_COVERAGE = 0.22
CORRIDOR_CENTRE, CORRIDOR_WAVES = 0.46, ((0.020, 1.0, 0.021), (0.012, 2.3, -0.034))
"""Height of the middle line as a share of the picture's; amplitude, waves across the picture and waves per frame."""
CORRIDOR_BOXES = (
    (0.16, 0.26, 0.055, 0.10, 0.0045, 0.0010),
    (0.40, 0.60, 0.100, 0.15, -0.0030, 0.0015),
    (0.66, 0.62, 0.140, 0.20, 0.0020, -0.0020),
    (0.88, 0.30, 0.040, 0.16, -0.0050, 0.0008),
)
"""Centre (x, y), width and height as shares of the picture, and the movement of the centre per frame."""


@dataclass(frozen=True, slots=True)
class StudyRegion:
    """What is to be kept of one frame, before any treatment."""

    pixels: BoolMask
    """bool [height, width]; quality is measured inside it."""
    whole: bool
    """The loop sends this frame whole (a keyframe of the loop); no treatment touches it."""


def corridor_regions(frames: Iterable[Frame]) -> Iterator[StudyRegion]:
    """The fixed region for each frame, by its position from 0."""
    for position, frame in enumerate(frames):
        yield StudyRegion(corridor_mask(*frame.size_hw, position), whole=False)


def corridor_mask(height: int, width: int, position: int, coverage: float = CORRIDOR_COVERAGE) -> BoolMask:
    """A wavy band around the horizon and four boxes that drift, smooth in time and the same for every clip.

    The band is as thick as the coverage demands, to within a row of pixels or so.

    Args:
        height: Rows of the picture.
        width: Columns of the picture.
        position: Frame number from 0.
        coverage: Share of the picture inside, band and boxes together, 0..1.

    Returns:
        bool [height, width].
    """
    boxes = np.zeros((height, width), np.uint8)
    for x, y, box_width, box_height, dx, dy in CORRIDOR_BOXES:
        centre_x, centre_y = bounced(x + dx * position), bounced(y + dy * position)
        left, top = round((centre_x - box_width / 2) * width), round((centre_y - box_height / 2) * height)
        right, bottom = round((centre_x + box_width / 2) * width), round((centre_y + box_height / 2) * height)
        cv2.rectangle(boxes, (left, top), (right - 1, bottom - 1), 1, cv2.FILLED)
    across = np.linspace(0.0, 1.0, width, dtype=np.float64)
    middle = np.full(width, CORRIDOR_CENTRE)
    for amplitude, waves, speed in CORRIDOR_WAVES:
        middle += amplitude * np.sin(2 * math.pi * (waves * across + speed * position))
    distance = np.abs((np.arange(height)[:, None] + 0.5) / height - middle[None, :])
    # Distances inside the boxes don't count; the band's half thickness is the quantile that is still missing.
    outside = distance[boxes == 0]
    missing = min(outside.size, max(0, round(coverage * height * width) - int(np.count_nonzero(boxes))))
    if missing == 0:
        return boxes.view(np.bool_)
    half = np.partition(outside, missing - 1)[missing - 1]
    return np.asarray((distance <= half) | boxes.view(np.bool_), np.bool_)


def bounced(position: float) -> float:
    """A coordinate that turns back at 0.1 and 0.9."""
    travelled = (position - 0.1) % 1.6
    return 0.1 + (travelled if travelled <= 0.8 else 1.6 - travelled)


def loop_regions(frames: Iterable[Frame], cloud: CloudModel) -> Iterator[StudyRegion]:
    """R_k of the loop in lock-step, with the default settings, at the analysis resolution.

    Args:
        frames: In order; the first is sent whole.
        cloud: What answers the region that was sent of a frame.

    Raises:
        FrameError: The cloud needs a truth that a frame doesn't have.
    """
    tracker = RoiTracker(block_size=1)
    for frame in frames:
        proposal = tracker.propose(frame)
        answer = cloud(frame, proposal.roi)
        tracker.update(frame.index, answer.mask, confidence=answer.confidence, uncertainty=answer.uncertainty)
        yield StudyRegion(proposal.roi.pixels(), proposal.keyframe)


def check_truth(frames: Iterable[Frame], clip: str) -> None:
    """Check that a perfect cloud can answer every frame.

    Raises:
        ConfigurationError: A frame has no true masks.
    """
    for frame in frames:
        if frame.truth is None or frame.truth.instance_mask is None:
            raise ConfigurationError(
                f"'{clip}' has no true masks that could stand in for the cloud; give --detector embedded or "
                "--detector onnx:FILE, or use --mask corridor"
            )
