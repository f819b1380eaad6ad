"""The components of a version 2 segment besides its images: calibration, boxes, poses.

Layout and names: waymo_open_dataset/v2/component.py and v2/perception/*.py; a column is called
``[ComponentName].field.path``.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cable_rpc.data.poses import motion_from_poses
from cable_rpc.data.waymo.camera import INTRINSIC_NAMES, Calibration, CameraName, pose_matrix, read_calibration
from cable_rpc.data.waymo.labels import BoxLabel
from cable_rpc.data.waymo.segment import NS_PER_MICROSECOND, WEBSITE
from cable_rpc.data.waymo.tables import read_columns
from cable_rpc.errors import SourceError
from cable_rpc.types import EgoMotion

SEGMENT_KEY = "key.segment_context_name"
TIME_KEY = "key.frame_timestamp_micros"
CAMERA_KEY = "key.camera_name"
OBJECT_KEY = "key.camera_object_id"

IMAGE_COLUMN = "[CameraImageComponent].image"
IMAGE_POSE_COLUMN = "[CameraImageComponent].pose.transform"
VELOCITY_COLUMNS = tuple(f"[CameraImageComponent].velocity.linear_velocity.{axis}" for axis in "xyz")
TURN_COLUMNS = tuple(f"[CameraImageComponent].velocity.angular_velocity.{axis}" for axis in "xyz")

INTRINSIC_COLUMNS = tuple(f"[CameraCalibrationComponent].intrinsic.{name}" for name in INTRINSIC_NAMES)
EXTRINSIC_COLUMN = "[CameraCalibrationComponent].extrinsic.transform"
SIZE_COLUMNS = ("[CameraCalibrationComponent].width", "[CameraCalibrationComponent].height")

CENTRE_COLUMNS = tuple(f"[CameraBoxComponent].box.center.{axis}" for axis in "xy")
BOX_SIZE_COLUMNS = tuple(f"[CameraBoxComponent].box.size.{axis}" for axis in "xy")
TYPE_COLUMN = "[CameraBoxComponent].type"
DIFFICULTY_COLUMN = "[CameraBoxComponent].difficulty_level.detection"

VEHICLE_POSE_COLUMN = "[VehiclePoseComponent].world_from_vehicle.transform"

LEAST_POSES = 2


def component_path(folder: Path, component: str, segment: str) -> Path:
    """The file of a component that must be there.

    Raises:
        SourceError: it isn't.
    """
    path = folder / component / f"{segment}.parquet"
    if not path.is_file():
        raise SourceError(
            f"{path} is missing; version 2 of the Waymo Open Dataset has the component '{component}': {WEBSITE}"
        )
    return path


def is_camera(value: Any, camera: CameraName) -> bool:
    """Whether a camera key means a camera: its number, or its name as in the library's own test files."""
    return bool(value == camera.value or value == camera.name)


def read_camera_calibration(path: Path, camera: CameraName) -> Calibration:
    """One camera's row of a ``camera_calibration`` table.

    Raises:
        SourceError: the table can't be read, has no such row, or a value can't be used.
    """
    columns = read_columns(path, [CAMERA_KEY, *INTRINSIC_COLUMNS, EXTRINSIC_COLUMN, *SIZE_COLUMNS])
    for row, name in enumerate(columns[CAMERA_KEY]):
        if is_camera(name, camera):
            return read_calibration(
                [columns[column][row] for column in INTRINSIC_COLUMNS],
                columns[EXTRINSIC_COLUMN][row],
                (columns[SIZE_COLUMNS[0]][row], columns[SIZE_COLUMNS[1]][row]),
                f"{path} row {row + 1}",
            )
    raise SourceError(f"{path} has no row of camera {camera.name}; found {', '.join(map(str, columns[CAMERA_KEY]))}")


def read_boxes(path: Path, camera: CameraName) -> dict[int, list[BoxLabel]]:
    """One camera's rows of a ``camera_box`` table by the frame's time stamp in microseconds.

    Raises:
        SourceError: the table can't be read.
    """
    keys = [TIME_KEY, CAMERA_KEY, OBJECT_KEY]
    columns = read_columns(path, [*keys, *CENTRE_COLUMNS, *BOX_SIZE_COLUMNS, TYPE_COLUMN], [DIFFICULTY_COLUMN])
    (centre_x, centre_y), (size_x, size_y) = CENTRE_COLUMNS, BOX_SIZE_COLUMNS
    boxes: dict[int, list[BoxLabel]] = defaultdict(list)
    for row, name in enumerate(columns[CAMERA_KEY]):
        if is_camera(name, camera):
            boxes[columns[TIME_KEY][row]].append(
                BoxLabel(
                    f"{path} row {row + 1}",
                    columns[OBJECT_KEY][row],
                    columns[TYPE_COLUMN][row],
                    (columns[centre_x][row], columns[centre_y][row]),
                    (columns[size_x][row], columns[size_y][row]),
                    columns[DIFFICULTY_COLUMN][row],
                )
            )
    return dict(boxes)


def read_motion(path: Path) -> dict[int, EgoMotion | None]:
    """Ego-motion from the differences of a ``vehicle_pose`` table, by the time stamp in microseconds.

    Returns:
        None in place of the motion where there is but one pose.

    Raises:
        SourceError: the table can't be read, or a pose can't be used.
    """
    columns = read_columns(path, [TIME_KEY, VEHICLE_POSE_COLUMN])
    poses = {
        time: pose_matrix(columns[VEHICLE_POSE_COLUMN][row], f"{path} row {row + 1}: the pose")
        for row, time in enumerate(columns[TIME_KEY])
    }
    times = sorted(poses)
    if len(times) < LEAST_POSES:
        return dict.fromkeys(times)
    times_ns = np.array(times, np.int64) * NS_PER_MICROSECOND
    motion = motion_from_poses(times_ns, np.stack([poses[time] for time in times]))
    return dict(zip(times, motion, strict=True))


def velocity_of(values: Sequence[Any]) -> list[float] | None:
    """Three stored numbers; None where one is missing."""
    numbers = [float(value) for value in values if value is not None and not math.isnan(value)]
    return numbers if len(numbers) == len(values) else None
