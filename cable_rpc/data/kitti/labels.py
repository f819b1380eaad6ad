"""KITTI tracking's label files."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.kitti.layout import WEBSITE
from cable_rpc.data.text_fields import finite_number, whole_number
from cable_rpc.errors import SourceError
from cable_rpc.types import GroundTruth

CLASS_BY_TYPE: Mapping[str, int] = {
    "Car": 2,
    "Van": 2,
    "Truck": 7,
    "Pedestrian": 0,
    "Person": 0,
    "Person_sitting": 0,
    "Cyclist": 1,
}
"""Object type to COCO-80 index; a person sitting is Person in the tracking benchmark, Person_sitting in others."""
LEFT_OUT_TYPES = frozenset({"Tram", "Misc"})
UNANNOTATED_TYPE = "DontCare"
VISIBILITY_BY_LEVEL: Mapping[str, float] = {"0": 1.0, "1": 0.7, "2": 0.4, "3": 0.4}
"""Visible share that a level of occlusion or truncation stands for: none, partly, largely, unknown.

The levels were never given numbers; "largely" is below the half that quality figures ask for, "partly" above.
"""
FEWEST_COLUMNS = 17

BOX_COLUMNS = ("left", "top", "right", "bottom")


@dataclass(frozen=True, slots=True)
class LabelRow:
    """One row that is of use."""

    xyxy: tuple[float, float, float, float]
    class_id: int | None
    """COCO-80 index; None for a region that nobody annotated."""
    track_id: int
    visibility: float


def read_labels(path: Path, bad_frames: BadFrames) -> dict[int, list[LabelRow]]:
    """The rows of a sequence by frame number, damaged ones left out.

    Columns: frame, track_id, type, truncated, occluded, alpha, left, top, right, bottom, height, width, length, x, y,
    z, rotation_y (devkit of the tracking benchmark, readme.txt).

    Raises:
        SourceError: the file can't be read, or a row is damaged and that isn't to be skipped.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(
            f"can't read labels {path}: {error}; they are 'training labels of tracking data set' at {WEBSITE}"
        ) from error
    rows: dict[int, list[LabelRow]] = defaultdict(list)
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        try:
            frame, row = label_row(words, f"{path} line {number}")
        except SourceError as error:
            bad_frames.found(error)
            continue
        if row is not None:
            rows[frame].append(row)
    return dict(rows)


def label_row(words: Sequence[str], place: str) -> tuple[int, LabelRow | None]:
    """Frame number and content of a row; None for a type that is no road user of ours.

    Raises:
        SourceError: a value can't be used.
    """
    if len(words) < FEWEST_COLUMNS:
        raise SourceError(f"{place}: {len(words)} columns ('{' '.join(words)}'); a row has {FEWEST_COLUMNS}")
    frame = whole_number(words[0], "frame", place)
    kind = words[2]
    if kind in LEFT_OUT_TYPES:
        return frame, None
    if kind != UNANNOTATED_TYPE and kind not in CLASS_BY_TYPE:
        known = ", ".join((*CLASS_BY_TYPE, *sorted(LEFT_OUT_TYPES), UNANNOTATED_TYPE))
        raise SourceError(f"{place}: type is '{kind}'; known are {known}")
    left, top, right, bottom = (
        finite_number(word, name, place) for name, word in zip(BOX_COLUMNS, words[6:10], strict=True)
    )
    if right <= left or bottom <= top:
        raise SourceError(f"{place}: the box {left:g}, {top:g}, {right:g}, {bottom:g} has no area")
    if kind == UNANNOTATED_TYPE:
        return frame, LabelRow((left, top, right, bottom), None, -1, 0.0)
    visibility = min(visible_share(words[3], "truncated", place), visible_share(words[4], "occluded", place))
    track_id = whole_number(words[1], "track_id", place)
    return frame, LabelRow((left, top, right, bottom), CLASS_BY_TYPE[kind], track_id, visibility)


def visible_share(word: str, column: str, place: str) -> float:
    """Visible share by a level (0, 1, 2, 3) or, written with a decimal point, by the hidden share 0..1.

    The tracking benchmark truncates in levels, the object benchmark in shares.

    Raises:
        SourceError: it is neither.
    """
    if word in VISIBILITY_BY_LEVEL:
        return VISIBILITY_BY_LEVEL[word]
    hidden = finite_number(word, column, place)
    if "." not in word or not 0.0 <= hidden <= 1.0:
        raise SourceError(f"{place}: {column} is '{word}'; it must be a level 0, 1, 2, 3 or a share 0.0..1.0")
    return 1.0 - hidden


def ground_truth(rows: Sequence[LabelRow], size_wh: tuple[int, int]) -> GroundTruth:
    """The truth of one frame, boxes clipped to the image; what lies wholly outside is left out.

    KITTI's boxes end at the border already, so how much hangs over it is told by the visibility alone.
    """
    boxes = np.array([row.xyxy for row in rows], np.float64).reshape(-1, 4)
    clipped = np.clip(boxes, 0.0, np.array([*size_wh, *size_wh], np.float64)).astype(np.float32)
    there = ((clipped[:, 2] > clipped[:, 0]) & (clipped[:, 3] > clipped[:, 1])).tolist()
    objects = [place for place, row in enumerate(rows) if row.class_id is not None and there[place]]
    unannotated = [place for place, row in enumerate(rows) if row.class_id is None and there[place]]
    return GroundTruth(
        boxes_xyxy=clipped[objects],
        class_ids=np.array([rows[place].class_id for place in objects], np.int32),
        track_ids=np.array([rows[place].track_id for place in objects], np.int32),
        visibility=np.array([rows[place].visibility for place in objects], np.float32),
        ignored_boxes_xyxy=clipped[unannotated] if unannotated else None,
    )
