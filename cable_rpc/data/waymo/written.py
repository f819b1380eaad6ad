"""A rendered frame in Waymo's terms, whichever version it is written as."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.poses import rigid
from cable_rpc.data.rendered_drive import DriveFrame
from cable_rpc.types import GroundTruth

EPOCH_MICROS = 1_550_000_000_000_000
"""Added to the time stamps, which count from 0 in a rendered drive."""
JPEG_QUALITY = 95
TYPE_BY_CLASS: Mapping[int, int] = {0: 2, 1: 4, 2: 1, 3: 1, 5: 1, 7: 1}
"""COCO-80 index to Label.Type; all that has a motor, motorcycles too, is one to Waymo (its docs/
labeling_specifications.md)."""
LEVEL_1, LEVEL_2 = 1, 2
HALF_SEEN = 0.5
OPTICAL_FROM_WAYMO = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""From camera axes x forward, y left, z up to x right, y down, z forward."""


@dataclass(frozen=True, slots=True)
class WrittenCamera:
    """A row of calibration."""

    intrinsic: list[float]
    """f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3; no distortion."""
    extrinsic: list[float]
    """Camera to vehicle, 16 values row by row."""
    size_wh: tuple[int, int]


@dataclass(frozen=True, slots=True)
class WrittenBox:
    """A 2-D label."""

    object_id: str
    kind: int
    """Label.Type."""
    centre_xy: tuple[float, float]
    size_xy: tuple[float, float]
    difficulty: int
    """LEVEL_2 for what is less than half visible."""


@dataclass(frozen=True, slots=True)
class WrittenFrame:
    """An image with its motion and labels."""

    time_micros: int
    jpeg: bytes
    pose: list[float]
    """world_from_vehicle, 16 values row by row."""
    velocity: list[float]
    """m/s, global frame."""
    turn: list[float]
    """rad/s, global frame."""
    boxes: list[WrittenBox] | None
    """None where the frame has no truth."""


def written_camera(drive_frame: DriveFrame) -> WrittenCamera:
    """The calibration of a frame's camera.

    Raises:
        ValueError: the frame has no intrinsics.
    """
    pinhole = drive_frame.frame.intrinsics
    if pinhole is None:
        raise ValueError(f"frame {drive_frame.frame.index} has no intrinsics")
    extrinsic = drive_frame.vehicle_from_camera @ rigid(OPTICAL_FROM_WAYMO, (0.0, 0.0, 0.0))
    height, width = drive_frame.frame.size_hw
    lens = [0.0] * 5
    return WrittenCamera([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, *lens], flat(extrinsic), (width, height))


def written_frame(drive_frame: DriveFrame) -> WrittenFrame:
    """A frame's image, motion and labels.

    Raises:
        ValueError: the frame has no ego-motion.
    """
    frame = drive_frame.frame
    if frame.ego is None:
        raise ValueError(f"frame {frame.index} has no ego-motion")
    _, jpeg = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    pose = drive_frame.world_from_vehicle
    return WrittenFrame(
        EPOCH_MICROS + round(frame.capture_time_ns / 1000),
        jpeg.tobytes(),
        flat(pose),
        [float(value) for value in pose[:3, :3] @ (frame.ego.speed_mps, -frame.ego.lateral_mps, 0.0)],
        [float(value) for value in pose[:3, :3] @ (0.0, 0.0, frame.ego.yaw_rate_radps)],
        None if frame.truth is None else written_boxes(frame.truth),
    )


def written_boxes(truth: GroundTruth) -> list[WrittenBox]:
    """Labels of a frame's truth."""
    return [
        WrittenBox(
            object_id=f"object-{track_id}",
            kind=TYPE_BY_CLASS[class_id],
            centre_xy=((x_min + x_max) / 2, (y_min + y_max) / 2),
            size_xy=(x_max - x_min, y_max - y_min),
            difficulty=LEVEL_1 if visibility >= HALF_SEEN else LEVEL_2,
        )
        for (x_min, y_min, x_max, y_max), class_id, track_id, visibility in zip(
            truth.boxes_xyxy.tolist(),
            truth.class_ids.tolist(),
            truth.track_ids.tolist(),
            truth.visibility.tolist(),
            strict=True,
        )
    ]


def flat(matrix: npt.NDArray[np.float64]) -> list[float]:
    """A matrix row by row."""
    return [float(value) for value in matrix.ravel()]
