"""One camera of a version 2 segment: Parquet components joined by time stamp and camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.waymo.camera import CameraName
from cable_rpc.data.waymo.components import (
    CAMERA_KEY,
    IMAGE_COLUMN,
    IMAGE_POSE_COLUMN,
    TIME_KEY,
    TURN_COLUMNS,
    VELOCITY_COLUMNS,
    component_path,
    is_camera,
    read_boxes,
    read_camera_calibration,
    read_motion,
    stored_motion,
    time_ns_of,
)
from cable_rpc.data.waymo.motion import motion_of_velocity
from cable_rpc.data.waymo.segment import NS_PER_MICROSECOND, CameraRecord
from cable_rpc.data.waymo.tables import TableBatch, read_batches, read_columns, row_group_sizes
from cable_rpc.errors import SourceError
from cable_rpc.types import EgoMotion

MOTION_COLUMNS = (IMAGE_POSE_COLUMN, *VELOCITY_COLUMNS, *TURN_COLUMNS)


@dataclass(frozen=True, slots=True)
class ImageRow:
    """Where the image of a frame lies."""

    time_ns: int
    row: int
    """1, 2, ... in the table."""
    row_group: int
    offset: int
    """Within its group."""


class ComponentSegment:
    """A segment of version 2.

    Opening reads the keys of the images and the tables that are small; images are read a few rows at a time, as far
    as the pages of the file allow, from those row groups only that hold the camera. Rows may stand in any order;
    those that come before their turn are held until then.

    Args:
        folder: what holds the components' folders.
        name: of the segment.
        camera: which one.
        bad_frames: what becomes of damaged rows.

    Raises:
        SourceError: a component is missing or can't be read, or the camera has no image.
    """

    def __init__(self, folder: Path, name: str, camera: CameraName, bad_frames: BadFrames) -> None:
        self.name = name
        self.camera = camera
        self._folder = folder
        self._bad_frames = bad_frames
        self._images = component_path(folder, "camera_image", name)
        self.calibration = read_camera_calibration(component_path(folder, "camera_calibration", name), camera)
        self._rows = image_rows(self._images, camera, bad_frames)
        self.times_ns = [row.time_ns for row in self._rows]
        boxes = folder / "camera_box" / f"{name}.parquet"
        self._boxes = read_boxes(boxes, camera, bad_frames) if boxes.is_file() else None
        self._motion: Mapping[int, EgoMotion | None] | None = None

    def records(self, places: Sequence[int]) -> Iterator[CameraRecord]:
        """The frames at some places of `times_ns`, damaged ones left out.

        Raises:
            SourceError: a row or the table is damaged, unless a row is and that is to be skipped.
        """
        turns = {(self._rows[place].row_group, self._rows[place].offset): turn for turn, place in enumerate(places)}
        groups = sorted({group for group, _ in turns})
        waiting: dict[int, CameraRecord | None] = {}
        due = 0
        for batch in read_batches(self._images, [IMAGE_COLUMN], MOTION_COLUMNS, groups):
            for number in range(len(batch.columns[IMAGE_COLUMN])):
                turn = turns.get((batch.row_group, batch.offset + number))
                if turn is None:
                    continue
                waiting[turn] = self._record(self._rows[places[turn]], batch, number)
                while due in waiting:
                    record = waiting.pop(due)
                    due += 1
                    if record is not None:
                        yield record
            if due == len(places):
                return

    def _record(self, row: ImageRow, batch: TableBatch, number: int) -> CameraRecord | None:
        """A row; None where it is damaged and that is to be skipped."""
        where = f"{self._images} row {row.row} (frame {row.time_ns // NS_PER_MICROSECOND}, camera {self.camera.name})"
        values = {name: column[number].as_py() for name, column in batch.columns.items()}
        stored = stored_motion(values)
        if stored is None and self._motion is None:
            # A missing component is no damage of this row.
            pose_table = component_path(self._folder, "vehicle_pose", self.name)
            self._motion = read_motion(pose_table, self._bad_frames)
        try:
            if not values[IMAGE_COLUMN]:
                raise SourceError(f"{where} has no image")
            ego = self._motion_at(row.time_ns, where) if stored is None else motion_of_velocity(*stored, where)
        except SourceError as error:
            self._bad_frames.found(error)
            return None
        labels = None if self._boxes is None else self._boxes.get(row.time_ns, [])
        return CameraRecord(where, row.time_ns, values[IMAGE_COLUMN], ego, labels)

    def _motion_at(self, time_ns: int, where: str) -> EgoMotion | None:
        if self._motion is None or time_ns not in self._motion:
            raise SourceError(f"{where} has no velocity, and no sound row in the component 'vehicle_pose'")
        return self._motion[time_ns]


def image_rows(path: Path, camera: CameraName, bad_frames: BadFrames) -> list[ImageRow]:
    """One camera's rows of a ``camera_image`` table, sorted by time.

    Raises:
        SourceError: the table can't be read or has no such row; or a row has no time stamp or that of another row,
            unless that is to be skipped.
    """
    columns = read_columns(path, [TIME_KEY, CAMERA_KEY])
    groups = [(group, offset) for group, rows in enumerate(row_group_sizes(path)) for offset in range(rows)]
    found: dict[int, ImageRow] = {}
    for row, (micros, name) in enumerate(zip(columns[TIME_KEY], columns[CAMERA_KEY], strict=True)):
        if not is_camera(name, camera):
            continue
        place = f"{path} row {row + 1}"
        try:
            time_ns = time_ns_of(micros, place)
            if time_ns in found:
                raise SourceError(f"{place}: {TIME_KEY} is {micros}; that is the one of row {found[time_ns].row} too")
        except SourceError as error:
            bad_frames.found(error)
            continue
        found[time_ns] = ImageRow(time_ns, row + 1, *groups[row])
    if not found:
        there = ", ".join(sorted({str(name) for name in columns[CAMERA_KEY]})) or "no row"
        raise SourceError(f"{path} has no image of camera {camera.name} ({camera.value}); found {there}")
    return [found[time_ns] for time_ns in sorted(found)]
