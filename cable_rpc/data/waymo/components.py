"""The components of a version 2 segment besides its images: calibration, boxes, poses.

Layout and names: waymo_open_dataset/v2/component.py and v2/perception/*.py; a column is called
``[ComponentName].field.path``.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.waymo.camera import INTRINSIC_NAMES, Calibration, CameraName, read_calibration
from cable_rpc.data.waymo.labels import BoxLabel
from cable_rpc.data.waymo.motion import FloatArray, motion_of_poses, pose_matrix
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


def read_boxes(path: Path, camera: CameraName, bad_frames: BadFrames) -> dict[int, list[BoxLabel]]:
    """One camera's rows of a ``camera_box`` table by the frame's time in ns.

    Raises:
        SourceError: the table can't be read; or a row has no time stamp, unless that is to be skipped.
    """
    keys = [TIME_KEY, CAMERA_KEY, OBJECT_KEY]
    columns = read_columns(path, [*keys, *CENTRE_COLUMNS, *BOX_SIZE_COLUMNS, TYPE_COLUMN], [DIFFICULTY_COLUMN])
    (centre_x, centre_y), (size_x, size_y) = CENTRE_COLUMNS, BOX_SIZE_COLUMNS
    boxes: dict[int, list[BoxLabel]] = defaultdict(list)
    for row, name in enumerate(columns[CAMERA_KEY]):
        if not is_camera(name, camera):
            continue
        place = f"{path} row {row + 1}"
        try:
            time_ns = time_ns_of(columns[TIME_KEY][row], place)
        except SourceError as error:
            bad_frames.found(error)
            continue
        boxes[time_ns].append(
            BoxLabel(
                place,
                columns[OBJECT_KEY][row],
                columns[TYPE_COLUMN][row],
                (columns[centre_x][row], columns[centre_y][row]),
                (columns[size_x][row], columns[size_y][row]),
                columns[DIFFICULTY_COLUMN][row],
            )
        )
    return dict(boxes)


def read_motion(path: Path, bad_frames: BadFrames) -> dict[int, EgoMotion | None]:
    """Ego-motion from the differences of a ``vehicle_pose`` table, by the time in ns.

    Returns:
        None in place of the motion where there is but one pose.

    Raises:
        SourceError: the table can't be read; or a row is damaged, unless that is to be skipped.
    """
    columns = read_columns(path, [TIME_KEY, VEHICLE_POSE_COLUMN])
    poses: dict[int, FloatArray] = {}
    for row, (micros, values) in enumerate(zip(columns[TIME_KEY], columns[VEHICLE_POSE_COLUMN], strict=True)):
        place = f"{path} row {row + 1}"
        try:
            poses[time_ns_of(micros, place)] = pose_matrix(values, f"{place}: the pose")
        except SourceError as error:
            bad_frames.found(error)
    return motion_of_poses(poses)


def time_ns_of(micros: Any, place: str) -> int:
    """The time in ns of a row's key.

    Raises:
        SourceError: it is missing.
    """
    if not isinstance(micros, int):
        raise SourceError(f"{place}: {TIME_KEY} is {micros}; it must be a whole number of microseconds")
    return micros * NS_PER_MICROSECOND


def stored_motion(values: Mapping[str, Any]) -> tuple[list[float], list[float], list[Any]] | None:
    """Velocity (m/s), turn (rad/s) and pose of a ``camera_image`` row; None where one is missing."""
    velocity = [values.get(name, math.nan) for name in VELOCITY_COLUMNS]
    turn = [values.get(name, math.nan) for name in TURN_COLUMNS]
    pose: list[Any] | None = values.get(IMAGE_POSE_COLUMN)
    if pose is None or any(value is None or math.isnan(value) for value in [*velocity, *turn]):
        return None
    return velocity, turn, pose
