"""Waymo's cameras: names, calibration, and the motion that is stored with their images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from cable_rpc.errors import SourceError
from cable_rpc.types import CameraIntrinsics, CameraMount, EgoMotion

FloatArray = npt.NDArray[np.float64]

FORWARD_YAW_RAD = math.radians(20.0)
"""A camera that looks further aside is no forward-looking one (FRONT_LEFT and FRONT_RIGHT stand at 45 degrees)."""
INTRINSIC_NAMES = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
"""In the order of v1's list; the last five in OpenCV's sense and order."""
POSE_VALUES = 16


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


def pose_matrix(values: Sequence[Any] | None, place: str) -> FloatArray:
    """A rigid transform, float64 [4, 4], from its 16 values row by row.

    Raises:
        SourceError: it isn't 16 finite numbers, or no rotation in the upper left.
    """
    table = np.array(values if values is not None else [], dtype=np.float64)
    if table.shape != (POSE_VALUES,) or not np.isfinite(table).all():
        raise SourceError(f"{place} has {table.size} values; it must be 16 finite numbers, a 4x4 matrix row by row")
    matrix: FloatArray = table.reshape(4, 4)
    rotation = matrix[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise SourceError(f"{place} is no rigid transform; its upper left 3x3 part must be a rotation")
    return matrix


def camera_mount(vehicle_from_camera: FloatArray) -> CameraMount | None:
    """Where a forward-looking camera sits; None for one that looks aside.

    Height is above the vehicle frame's origin, which Waymo puts on the ground below the middle of the rear axle.
    """
    forward, left, up = vehicle_from_camera[:3, 0].tolist()
    height_m = float(vehicle_from_camera[2, 3])
    if abs(math.atan2(left, forward)) > FORWARD_YAW_RAD or height_m <= 0:
        return None
    return CameraMount(height_m, math.atan2(-up, math.hypot(forward, left)), float(vehicle_from_camera[0, 3]))


def motion_of_velocity(
    velocity_mps: Sequence[float], turn_radps: Sequence[float], world_from_vehicle: FloatArray, place: str
) -> EgoMotion:
    """Ego-motion from the velocities that are stored with an image.

    Args:
        velocity_mps: x, y, z in the GLOBAL frame (dataset.proto, CameraImage.velocity).
        turn_radps: about x, y, z of the global frame; z is up, so the last is the yaw rate, counter-clockwise.
        world_from_vehicle: float64 [4, 4], vehicle x forward, y left.
        place: for error texts.

    Raises:
        SourceError: a value isn't finite.
    """
    ahead, left, _ = (world_from_vehicle[:3, :3].T @ np.array(velocity_mps, np.float64)).tolist()
    yaw_rate = float(turn_radps[2])
    if not all(map(math.isfinite, (ahead, left, yaw_rate))):
        raise SourceError(f"{place}: the velocity is {list(velocity_mps)} m/s, {list(turn_radps)} rad/s")
    return EgoMotion(ahead, -left, yaw_rate)
