"""Rendered drives in the layout of version 2: the reader's counterpart, at the size of a fixture."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cable_rpc.data.rendered_drive import DriveFrame
from cable_rpc.data.waymo.camera import CameraName
from cable_rpc.data.waymo.components import (
    BOX_SIZE_COLUMNS,
    CAMERA_KEY,
    CENTRE_COLUMNS,
    DIFFICULTY_COLUMN,
    EXTRINSIC_COLUMN,
    IMAGE_COLUMN,
    IMAGE_POSE_COLUMN,
    INTRINSIC_COLUMNS,
    OBJECT_KEY,
    SEGMENT_KEY,
    SIZE_COLUMNS,
    TIME_KEY,
    TURN_COLUMNS,
    TYPE_COLUMN,
    VEHICLE_POSE_COLUMN,
    VELOCITY_COLUMNS,
)
from cable_rpc.data.waymo.tables import arrow_modules
from cable_rpc.data.waymo.written import WrittenCamera, WrittenFrame, written_camera, written_frame

ROWS_PER_GROUP = 8
IMAGE, CALIBRATION, BOX, POSE = "camera_image", "camera_calibration", "camera_box", "vehicle_pose"

KEY_TYPES: Mapping[str, str] = {SEGMENT_KEY: "string", TIME_KEY: "int64", CAMERA_KEY: "int8", OBJECT_KEY: "string"}
COLUMN_TYPES: Mapping[str, str] = {
    **KEY_TYPES,
    IMAGE_COLUMN: "binary",
    IMAGE_POSE_COLUMN: "transform",
    **dict.fromkeys(VELOCITY_COLUMNS, "float32"),
    **dict.fromkeys(TURN_COLUMNS, "float64"),
    **dict.fromkeys((*CENTRE_COLUMNS, *BOX_SIZE_COLUMNS), "float64"),
    TYPE_COLUMN: "int8",
    DIFFICULTY_COLUMN: "int8",
    **dict.fromkeys(INTRINSIC_COLUMNS, "float64"),
    EXTRINSIC_COLUMN: "transform",
    **dict.fromkeys(SIZE_COLUMNS, "int32"),
    VEHICLE_POSE_COLUMN: "transform",
}
"""As waymo_open_dataset/v2/perception declares them; a transform is 16 float64."""

COMPONENT_COLUMNS: Mapping[str, Sequence[str]] = {
    IMAGE: (SEGMENT_KEY, TIME_KEY, CAMERA_KEY, IMAGE_COLUMN, IMAGE_POSE_COLUMN, *VELOCITY_COLUMNS, *TURN_COLUMNS),
    CALIBRATION: (SEGMENT_KEY, CAMERA_KEY, *INTRINSIC_COLUMNS, EXTRINSIC_COLUMN, *SIZE_COLUMNS),
    BOX: (
        SEGMENT_KEY,
        TIME_KEY,
        CAMERA_KEY,
        OBJECT_KEY,
        *CENTRE_COLUMNS,
        *BOX_SIZE_COLUMNS,
        TYPE_COLUMN,
        DIFFICULTY_COLUMN,
    ),
    POSE: (SEGMENT_KEY, TIME_KEY, VEHICLE_POSE_COLUMN),
}

Row = dict[str, Any]


def write_waymo(
    root: Path, drives: Mapping[str, Iterable[DriveFrame]], *, camera: CameraName = CameraName.FRONT
) -> None:
    """Write segments as ``root/<component>/<segment>.parquet``.

    Boxes are the frames' truth, stored once per visible object; ``camera_box`` is left out for a segment of which no
    frame has truth, as in the test split. Times are moved to a usual epoch.

    Args:
        root: made where it isn't there.
        drives: segment's context name to its frames.
        camera: what the frames' camera is called.

    Raises:
        ConfigurationError: pyarrow isn't installed.
        ValueError: a drive has no frame, or one without ego-motion or intrinsics.
    """
    for name, frames in drives.items():
        tables: dict[str, list[Row]] = {component: [] for component in COMPONENT_COLUMNS}
        annotated = False
        for drive_frame in frames:
            if not tables[CALIBRATION]:
                tables[CALIBRATION].append(calibration_row(name, camera, written_camera(drive_frame)))
            frame = written_frame(drive_frame)
            tables[IMAGE].append(image_row(name, camera, frame))
            tables[POSE].append({SEGMENT_KEY: name, TIME_KEY: frame.time_micros, VEHICLE_POSE_COLUMN: frame.pose})
            tables[BOX] += box_rows(name, camera, frame)
            annotated |= frame.boxes is not None
        if not tables[IMAGE]:
            raise ValueError(f"drive '{name}' has no frame")
        for component, rows in tables.items():
            if component != BOX or annotated:
                write_table(root / component / f"{name}.parquet", COMPONENT_COLUMNS[component], rows)


def calibration_row(segment: str, camera: CameraName, calibration: WrittenCamera) -> Row:
    """One row of ``camera_calibration``."""
    return {
        SEGMENT_KEY: segment,
        CAMERA_KEY: camera.value,
        **dict(zip(INTRINSIC_COLUMNS, calibration.intrinsic, strict=True)),
        EXTRINSIC_COLUMN: calibration.extrinsic,
        **dict(zip(SIZE_COLUMNS, calibration.size_wh, strict=True)),
    }


def image_row(segment: str, camera: CameraName, frame: WrittenFrame) -> Row:
    """One row of ``camera_image``."""
    return {
        SEGMENT_KEY: segment,
        TIME_KEY: frame.time_micros,
        CAMERA_KEY: camera.value,
        IMAGE_COLUMN: frame.jpeg,
        IMAGE_POSE_COLUMN: frame.pose,
        **dict(zip(VELOCITY_COLUMNS, frame.velocity, strict=True)),
        **dict(zip(TURN_COLUMNS, frame.turn, strict=True)),
    }


def box_rows(segment: str, camera: CameraName, frame: WrittenFrame) -> list[Row]:
    """The frame's rows of ``camera_box``."""
    return [
        {
            SEGMENT_KEY: segment,
            TIME_KEY: frame.time_micros,
            CAMERA_KEY: camera.value,
            OBJECT_KEY: box.object_id,
            **dict(zip(CENTRE_COLUMNS, box.centre_xy, strict=True)),
            **dict(zip(BOX_SIZE_COLUMNS, box.size_xy, strict=True)),
            TYPE_COLUMN: box.kind,
            DIFFICULTY_COLUMN: box.difficulty,
        }
        for box in frame.boxes or ()
    ]


def write_table(path: Path, columns: Sequence[str], rows: Sequence[Row]) -> None:
    """Write one component."""
    arrow, parquet = arrow_modules(path)
    types = {name: getattr(arrow, name)() for name in set(COLUMN_TYPES.values()) - {"transform"}}
    types["transform"] = arrow.list_(arrow.float64(), 16)
    schema = arrow.schema([(column, types[COLUMN_TYPES[column]]) for column in columns])
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(arrow.Table.from_pylist(list(rows), schema=schema), path, row_group_size=ROWS_PER_GROUP)
