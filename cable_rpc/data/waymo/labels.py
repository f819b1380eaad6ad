"""Waymo's 2-D camera boxes to the truth of a frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.errors import SourceError
from cable_rpc.types import GroundTruth

CLASS_BY_TYPE: Mapping[int, int | None] = {0: None, 1: 2, 2: 0, 3: None, 4: 1}
"""Label.Type (unknown, vehicle, pedestrian, sign, cyclist) to COCO-80 index; None is left out. Buses, trucks and
motorcycles are vehicles too, so they count as cars."""
VISIBILITY_BY_DIFFICULTY: Mapping[int, float] = {0: 1.0, 1: 1.0, 2: 0.5}
"""Label.DifficultyLevel to visible share. Waymo tells no share: LEVEL_2 marks what its labellers found hard to see, and
the convention here is to count it as half seen; no level (the usual case of camera boxes) and LEVEL_1 as whole."""


@dataclass(frozen=True, slots=True)
class BoxLabel:
    """One box as stored; nothing is checked yet."""

    place: str
    """Where it stands, for error texts."""
    object_id: Any
    kind: Any
    """Label.Type."""
    centre_xy: tuple[Any, Any]
    """Pixels."""
    size_xy: tuple[Any, Any]
    """Pixels along x and y."""
    difficulty: Any = 0
    """Label.DifficultyLevel for detection; None counts as unknown."""


class TrackNumbers:
    """A whole number for each object id, 1, 2, ... as they are first asked for."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}

    def of(self, object_id: str) -> int:
        """The number of an id, the same one each time."""
        return self._numbers.setdefault(object_id, len(self._numbers) + 1)


def ground_truth(
    labels: Sequence[BoxLabel], tracks: TrackNumbers, size_wh: tuple[int, int], bad_frames: BadFrames
) -> GroundTruth:
    """The truth of one frame, boxes clipped to the image; what lies wholly outside is left out.

    Visibility is the smaller of the difficulty's share and the share of the box that lies in the image.

    Raises:
        SourceError: a label is damaged, unless that is to be skipped.
    """
    boxes: list[tuple[float, float, float, float]] = []
    class_ids: list[int] = []
    track_ids: list[int] = []
    visibility: list[float] = []
    for label in labels:
        try:
            check_label(label)
        except SourceError as error:
            bad_frames.found(error)
            continue
        class_id = CLASS_BY_TYPE[label.kind]
        box, inside = clipped_box(label, size_wh)
        if class_id is None or inside == 0:
            continue
        boxes.append(box)
        class_ids.append(class_id)
        track_ids.append(tracks.of(label.object_id))
        visibility.append(min(VISIBILITY_BY_DIFFICULTY[label.difficulty or 0], inside))
    return GroundTruth(
        np.array(boxes, np.float32).reshape(-1, 4),
        np.array(class_ids, np.int32),
        np.array(track_ids, np.int32),
        np.array(visibility, np.float32),
    )


def check_label(label: BoxLabel) -> None:
    """Refuse a label that can't be used.

    Raises:
        SourceError: the type, the difficulty, the id or a number of the box is no usable one.
    """
    if label.kind not in CLASS_BY_TYPE:
        raise SourceError(f"{label.place}: type is {label.kind!r}; known are {', '.join(map(str, CLASS_BY_TYPE))}")
    if (label.difficulty or 0) not in VISIBILITY_BY_DIFFICULTY:
        raise SourceError(f"{label.place}: difficulty level is {label.difficulty!r}; known are 0, 1, 2")
    if not isinstance(label.object_id, str) or not label.object_id:
        raise SourceError(f"{label.place}: the object's id is {label.object_id!r}; it must be a text")
    values = (*label.centre_xy, *label.size_xy)
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in values):
        raise SourceError(f"{label.place}: centre {label.centre_xy} and size {label.size_xy} must be finite numbers")
    if min(label.size_xy) <= 0:
        raise SourceError(f"{label.place}: size is {label.size_xy[0]} x {label.size_xy[1]}; it must be above 0")


def clipped_box(label: BoxLabel, size_wh: tuple[int, int]) -> tuple[tuple[float, float, float, float], float]:
    """A sound label's box (x_min, y_min, x_max, y_max) within the image, and the share of it that is."""
    low = [centre - side / 2 for centre, side in zip(label.centre_xy, label.size_xy, strict=True)]
    high = [centre + side / 2 for centre, side in zip(label.centre_xy, label.size_xy, strict=True)]
    x_min, y_min = (max(value, 0.0) for value in low)
    x_max, y_max = (min(value, float(limit)) for value, limit in zip(high, size_wh, strict=True))
    area = max(x_max - x_min, 0.0) * max(y_max - y_min, 0.0)
    return (x_min, y_min, x_max, y_max), min(area / (label.size_xy[0] * label.size_xy[1]), 1.0)
