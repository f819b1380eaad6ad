"""Annotation rows of a sequence to the truth of its frames."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.coco.categories import class_of_category, is_unannotated
from cable_rpc.data.coco.tables import CocoTables
from cable_rpc.data.json_fields import Identifier, JsonRow, identifier, number, numbers, shown
from cable_rpc.errors import SourceError
from cable_rpc.types import GroundTruth

TRACK_KEYS = ("track_id", "instance_id")
LARGEST_ID = 2**31 - 1

TrackKey = tuple[str, Identifier]
"""Kind of id (a track's, or where there is none an annotation's own) and id."""


@dataclass(frozen=True, slots=True)
class BoxRow:
    """One annotation that is of use."""

    xyxy: tuple[float, float, float, float]
    """As annotated; may hang over the image."""
    class_id: int | None
    """COCO-80 index; None for a region that nobody annotated."""
    track: TrackKey
    visibility: float
    """Visible share as annotated, 1 where it isn't."""


def read_boxes(
    tables: CocoTables, image_ids: Collection[Identifier], bad_frames: BadFrames
) -> dict[Identifier, list[BoxRow]]:
    """The useful annotations of some images by image id, damaged rows left out.

    Args:
        tables: of the file; it must have annotations.
        image_ids: of the images that are asked for.
        bad_frames: what becomes of damaged rows.

    Raises:
        SourceError: a row is damaged or belongs to no image, unless that is to be skipped.
    """
    known = {row["id"] for row in tables.images if isinstance(row.get("id"), str | int)}
    boxes: dict[Identifier, list[BoxRow]] = defaultdict(list)
    for index, row in enumerate(tables.annotations or []):
        place = tables.place("annotations", index)
        try:
            image_id = identifier(row, "image_id", place)
            if image_id not in known:
                raise SourceError(f"{place}: image_id {shown(image_id)} is that of no image in the file")
            box = box_row(tables, row, place) if image_id in image_ids else None
        except SourceError as error:
            bad_frames.found(error)
            continue
        if box is not None:
            boxes[image_id].append(box)
    return dict(boxes)


def box_row(tables: CocoTables, row: JsonRow, place: str) -> BoxRow | None:
    """Read one annotation; None where its category is no road user's.

    Raises:
        SourceError: a value can't be used.
    """
    category_id = identifier(row, "category_id", place)
    name = tables.category_names.get(category_id)
    if name is None:
        raise SourceError(f"{place}: category_id {shown(category_id)} is none of the file's categories")
    class_id = class_of_category(name)
    unannotated = is_unannotated(name)
    if class_id is None and not unannotated:
        return None
    left, top, width, height = numbers(row, "bbox", 4, place)
    if width <= 0 or height <= 0:
        raise SourceError(f"{place}: bbox is {shown(row['bbox'])}; its width and height must be above 0")
    # "ignore" is what COCO's evaluation makes of iscrowd, and some sets write it themselves.
    if row.get("iscrowd") or row.get("ignore"):
        class_id = None
    return BoxRow((left, top, left + width, top + height), class_id, track_key(row, place), visibility(row, place))


def track_key(row: JsonRow, place: str) -> TrackKey:
    """What tells an object from others over the sequence.

    Raises:
        SourceError: the row has neither a track's id nor its own.
    """
    for key in TRACK_KEYS:
        if row.get(key) is not None:
            return "track", identifier(row, key, place)
    return "annotation", identifier(row, "id", place)


def visibility(row: JsonRow, place: str) -> float:
    """The visible share of the object, where the row tells it.

    Raises:
        SourceError: it isn't within 0..1.
    """
    if row.get("visibility") is None:
        return 1.0
    share = number(row, "visibility", place)
    if not 0.0 <= share <= 1.0:
        raise SourceError(f"{place}: visibility is {share:g}; it is a share, 0..1")
    return share


def number_tracks(boxes: Mapping[Identifier, Sequence[BoxRow]]) -> dict[TrackKey, int]:
    """A whole number for each track of a sequence: its own id where all have such ids, else 1, 2, ... as they come."""
    keys = dict.fromkeys(box.track for rows in boxes.values() for box in rows)
    own = {key: key[1] for key in keys if isinstance(key[1], int) and 0 <= key[1] <= LARGEST_ID}
    if len(own) == len(keys) and len({kind for kind, _ in keys}) <= 1:
        return own
    return {key: place for place, key in enumerate(keys, 1)}


def ground_truth(
    rows: Sequence[BoxRow], track_numbers: Mapping[TrackKey, int], size_wh: tuple[int, int]
) -> GroundTruth:
    """The truth of one frame, boxes clipped to the image; what lies wholly outside is left out.

    Visibility is the smaller of the annotated share and the share of the box that lies in the image.
    """
    boxes = np.array([row.xyxy for row in rows], np.float64).reshape(-1, 4)
    clipped = np.clip(boxes, 0.0, np.array([*size_wh, *size_wh], np.float64))
    inside = area(clipped) / area(boxes)
    objects = [place for place, row in enumerate(rows) if row.class_id is not None and inside[place] > 0]
    unannotated = [place for place, row in enumerate(rows) if row.class_id is None and inside[place] > 0]
    return GroundTruth(
        boxes_xyxy=clipped[objects].astype(np.float32),
        class_ids=np.array([rows[place].class_id for place in objects], np.int32),
        track_ids=np.array([track_numbers[rows[place].track] for place in objects], np.int32),
        visibility=np.array([min(rows[place].visibility, inside[place]) for place in objects], np.float32),
        ignored_boxes_xyxy=clipped[unannotated].astype(np.float32) if unannotated else None,
    )


def area(boxes: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Areas [N] of boxes [N, 4]."""
    return (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
