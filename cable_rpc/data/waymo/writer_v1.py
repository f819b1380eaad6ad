"""Rendered drives as TFRecords of version 1: the reader's counterpart, at the size of a fixture."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from cable_rpc.data.rendered_drive import DriveFrame
from cable_rpc.data.waymo.camera import CameraName
from cable_rpc.data.waymo.schema import frame_class
from cable_rpc.data.waymo.tfrecord import write_records
from cable_rpc.data.waymo.written import WrittenBox, WrittenCamera, WrittenFrame, written_camera, written_frame


def write_waymo_v1(
    root: Path, drives: Mapping[str, Iterable[DriveFrame]], *, camera: CameraName = CameraName.FRONT
) -> None:
    """Write segments as ``root/segment-<name>_with_camera_labels.tfrecord``.

    Args:
        root: made where it isn't there.
        drives: segment's context name to its frames.
        camera: what the frames' camera is called.

    Raises:
        ValueError: a drive has no frame, or one without ego-motion or intrinsics.
    """
    root.mkdir(parents=True, exist_ok=True)
    for name, frames in drives.items():
        records = [message.SerializeToString() for message in frame_messages(name, frames, camera)]
        if not records:
            raise ValueError(f"drive '{name}' has no frame")
        write_records(root / f"segment-{name}_with_camera_labels.tfrecord", records)


def frame_messages(name: str, frames: Iterable[DriveFrame], camera: CameraName) -> Iterator[Any]:
    """The ``Frame`` messages of a segment; each holds the calibration anew, as Waymo's do."""
    for drive_frame in frames:
        frame = written_frame(drive_frame)
        message = frame_class()(timestamp_micros=frame.time_micros)
        message.context.name = name
        message.pose.transform.extend(frame.pose)
        add_calibration(message, camera, written_camera(drive_frame))
        add_image(message, camera, frame)
        if frame.boxes is not None:
            add_labels(message, camera, frame.boxes)
        yield message


def add_calibration(message: Any, camera: CameraName, calibration: WrittenCamera) -> None:
    """One CameraCalibration."""
    width, height = calibration.size_wh
    row = message.context.camera_calibrations.add(name=camera, width=width, height=height)
    row.intrinsic.extend(calibration.intrinsic)
    row.extrinsic.transform.extend(calibration.extrinsic)


def add_image(message: Any, camera: CameraName, frame: WrittenFrame) -> None:
    """One CameraImage."""
    image = message.images.add(name=camera, image=frame.jpeg, pose_timestamp=frame.time_micros / 1e6)
    image.pose.transform.extend(frame.pose)
    velocity = image.velocity
    velocity.v_x, velocity.v_y, velocity.v_z = frame.velocity
    velocity.w_x, velocity.w_y, velocity.w_z = frame.turn


def add_labels(message: Any, camera: CameraName, boxes: Iterable[WrittenBox]) -> None:
    """One CameraLabels, which is there without a box too."""
    group = message.camera_labels.add(name=camera)
    for box in boxes:
        label = group.labels.add(id=box.object_id, type=box.kind, detection_difficulty_level=box.difficulty)
        label.box.center_x, label.box.center_y = box.centre_xy
        label.box.length, label.box.width = box.size_xy
