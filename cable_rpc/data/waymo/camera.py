"""Waymo's cameras: names, calibration, mounting."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from cable_rpc.data.waymo.motion import FloatArray, pose_matrix
from cable_rpc.errors import SourceError
from cable_rpc.types import CameraIntrinsics, CameraMount

FORWARD_YAW_RAD = math.radians(20.0)
"""A camera that looks further aside is no forward-looking one (FRONT_LEFT and FRONT_RIGHT stand at 45 degrees)."""
INTRINSIC_NAMES = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
"""In the order of v1's list; the last five in OpenCV's sense and order."""


class CameraName(IntEnum):
    """CameraName of dataset.proto."""

    FRONT = 1
    FRONT_LEFT = 2
    FRONT_RIGHT = 3
    SIDE_LEFT = 4
    SIDE_RIGHT = 5


@dataclass(frozen=True, slots=True)
class Calibration:
    """One camera of a segment."""

    intrinsics: CameraIntrinsics
    """The pinhole part."""
    distortion: tuple[float, ...]
    """k1, k2, p1, p2, k3 in OpenCV's sense."""
    vehicle_from_camera: FloatArray
    """float64 [4, 4]; camera axes x forward, y left, z up; vehicle axes likewise, origin on the ground."""
    size_wh: tuple[int, int]


def read_calibration(
    intrinsic: Sequence[Any], extrinsic: Sequence[Any] | None, size_wh: tuple[Any, Any], place: str
) -> Calibration:
    """Check and gather a camera's calibration.

    Args:
        intrinsic: nine values in the order of `INTRINSIC_NAMES`.
        extrinsic: 16 values, row by row, camera to vehicle.
        size_wh: (width, height) in pixels.
        place: where it stands, for error texts.

    Raises:
        SourceError: a value is missing or can't be used.
    """
    names = ", ".join(INTRINSIC_NAMES)
    numbers = [value for value in intrinsic if isinstance(value, int | float) and math.isfinite(value)]
    if len(numbers) < len(INTRINSIC_NAMES) or len(intrinsic) != len(INTRINSIC_NAMES):
        raise SourceError(f"{place}: the intrinsics are {list(intrinsic)}; they must be nine finite numbers {names}")
    if min(numbers[:2]) <= 0:
        raise SourceError(f"{place}: the focal lengths are {numbers[:2]}; they must be above 0")
    if not all(isinstance(side, int) and side > 0 for side in size_wh):
        raise SourceError(f"{place}: the image's size is {size_wh[0]}x{size_wh[1]}")
    return Calibration(
        CameraIntrinsics(*map(float, numbers[:4])),
        tuple(map(float, numbers[4:])),
        pose_matrix(extrinsic, f"{place}: the extrinsic"),
        size_wh,
    )


def camera_mount(vehicle_from_camera: FloatArray) -> CameraMount | None:
    """Where a forward-looking camera sits; None for one that looks aside.

    Height is above the vehicle frame's origin, which Waymo puts on the ground below the middle of the rear axle.
    """
    forward, left, up = vehicle_from_camera[:3, 0].tolist()
    height_m = float(vehicle_from_camera[2, 3])
    if abs(math.atan2(left, forward)) > FORWARD_YAW_RAD or height_m <= 0:
        return None
    return CameraMount(height_m, math.atan2(-up, math.hypot(forward, left)), float(vehicle_from_camera[0, 3]))
