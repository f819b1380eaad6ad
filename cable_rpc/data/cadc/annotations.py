"""CADC's cuboids."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.cadc.calibration import CadcCalibration
from cable_rpc.data.cadc.layout import WEBSITE
from cable_rpc.data.cuboids import Cuboid, cuboid_corners, project_corners
from cable_rpc.data.json_fields import JsonRow, number, shown, text
from cable_rpc.data.json_file import read_json
from cable_rpc.errors import SourceError
from cable_rpc.types import GroundTruth

CLASS_BY_LABEL: Mapping[str, int] = {
    "Car": 2,
    "Truck": 7,
    "Bus": 5,
    "Bicycle": 1,
    "Pedestrian": 0,
    "Pedestrian_With_Object": 0,
}
"""Label to COCO-80 index; animals, horse and buggy, bins and traffic guidance objects have none."""
VEHICLES = frozenset({2, 5, 7})
NEAR_M = 25.0
FEWEST_ON_ROAD = 3


def read_annotations(path: Path, bad_frames: BadFrames) -> list[list[Cuboid]]:
    """The cuboids of each annotated instant in lidar axes (x forward, y left, z up), damaged rows left out.

    Track ids are numbers given in the order in which the ``uuid`` first appear.

    Raises:
        SourceError: the file can't be read, or a row is damaged and that isn't to be skipped.
    """
    tracks: dict[str, int] = {}
    frames: list[list[Cuboid]] = []
    for index, row in enumerate(read_frames(path)):
        rows = row.get("cuboids") if isinstance(row, dict) else None
        if not isinstance(rows, list):
            bad_frames.found(SourceError(f"{path} [{index}] has no list 'cuboids': {shown(row)}"))
            rows = []
        cuboids: list[Cuboid] = []
        for place, cuboid in enumerate(rows):
            try:
                found = cuboid_of(cuboid, f"{path} [{index}].cuboids[{place}]", tracks)
            except SourceError as error:
                bad_frames.found(error)
                continue
            if found is not None:
                cuboids.append(found)
        frames.append(cuboids)
    return frames


def read_frames(path: Path) -> list[Any]:
    """The list that an annotation file holds.

    Raises:
        SourceError: the file is missing or holds something else.
    """
    if not path.exists():
        raise SourceError(f"{path} is missing; it is part of the annotations at {WEBSITE}")
    frames = read_json(path, "annotations")
    if not isinstance(frames, list):
        raise SourceError(f"{path} holds {shown(frames)}; it must be a list with one entry per annotated frame")
    return frames


def cuboid_of(row: Any, place: str, tracks: dict[str, int]) -> Cuboid | None:
    """One cuboid; None where its label has no class of ours.

    Dimensions are x = width, y = length, z = height (run_demo_tracklets.py of the devkit).

    Raises:
        SourceError: a value can't be used.
    """
    if not isinstance(row, dict):
        raise SourceError(f"{place} is {shown(row)}; a cuboid is an object")
    class_id = CLASS_BY_LABEL.get(text(row, "label", place))
    if class_id is None:
        return None
    track_id = tracks.setdefault(text(row, "uuid", place), len(tracks) + 1)
    x, y, z = triple(row, "position", place)
    width, length, height = triple(row, "dimensions", place)
    if min(width, length, height) <= 0:
        raise SourceError(f"{place}: dimensions are {shown(row['dimensions'])}; they must be above 0")
    return Cuboid((x, y, z), (length, width, height), number(row, "yaw", place), class_id, track_id)


def triple(row: JsonRow, key: str, place: str) -> tuple[float, float, float]:
    """The numbers x, y, z under a key.

    Raises:
        SourceError: one is missing or no finite number.
    """
    values = row.get(key)
    if not isinstance(values, dict):
        raise SourceError(f"{place}: {key} is {shown(values)}; it must have x, y and z")
    x, y, z = (number(values, axis, f"{place}.{key}") for axis in ("x", "y", "z"))
    return x, y, z


def ground_truth(
    cuboids: Sequence[Cuboid], calibration: CadcCalibration, size_wh: tuple[int, int], distorted: bool
) -> GroundTruth:
    """Boxes around the projected cuboids, those not in the image left out.

    Nothing tells what is hidden behind something else: visibility is the share inside the image alone.
    """
    lens = calibration.distort if distorted else None
    found = project_corners(
        cuboid_corners(cuboids), calibration.camera_from_lidar, calibration.intrinsics, size_wh, lens
    )
    boxes = found.boxes_xyxy
    there = (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1]) & (found.inside_share > 0)
    return GroundTruth(
        boxes_xyxy=boxes[there],
        class_ids=np.array([cuboid.class_id for cuboid in cuboids], np.int32)[there],
        track_ids=np.array([cuboid.track_id for cuboid in cuboids], np.int32)[there],
        visibility=found.inside_share[there],
    )


def camera_height_m(frames: Sequence[Sequence[Cuboid]], calibration: CadcCalibration) -> float | None:
    """Height of the camera above the road by what stands on it: the median bottom of vehicles nearby, in lidar axes.

    The calibration doesn't tell where the road is. None where fewer than three vehicles are near, or the figure would
    put the camera under the road.
    """
    bottoms = [
        cuboid.centre_m[2] - cuboid.size_lwh_m[2] / 2
        for cuboids in frames
        for cuboid in cuboids
        if cuboid.class_id in VEHICLES and max(abs(cuboid.centre_m[0]), abs(cuboid.centre_m[1])) < NEAR_M
    ]
    if len(bottoms) < FEWEST_ON_ROAD:
        return None
    height = float(calibration.lidar_from_camera[2, 3]) - median(bottoms)
    return height if height > 0 else None
