"""Poses of Waymo's vehicle, and its motion as stored with an image or as its poses tell."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from cable_rpc.data.poses import motion_from_poses
from cable_rpc.errors import SourceError
from cable_rpc.types import EgoMotion

FloatArray = npt.NDArray[np.float64]

POSE_VALUES = 16
LEAST_POSES = 2
ROTATION_TOLERANCE = 1e-3


def pose_matrix(values: Sequence[Any] | None, place: str) -> FloatArray:
    """A rigid transform, float64 [4, 4], from its 16 values row by row.

    Raises:
        SourceError: it isn't 16 finite numbers, or no rotation in the upper left.
    """
    table = np.array([] if values is None else values, dtype=np.float64)
    if table.shape != (POSE_VALUES,) or not np.isfinite(table).all():
        shown = "missing" if not table.size else ", ".join(f"{value:g}" for value in table)
        raise SourceError(f"{place} is {shown}; it must be 16 finite numbers, a 4x4 matrix row by row")
    matrix: FloatArray = table.reshape(4, 4)
    rotation = matrix[:3, :3]
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=ROTATION_TOLERANCE)
    if not orthonormal or np.linalg.det(rotation) < 0:
        raise SourceError(f"{place} is no rigid transform; its upper left 3x3 part {rotation.tolist()} is no rotation")
    return matrix


def motion_of_velocity(
    velocity_mps: Sequence[float], turn_radps: Sequence[float], pose: Sequence[Any], place: str
) -> EgoMotion:
    """Ego-motion from the velocities that are stored with an image.

    Args:
        velocity_mps: x, y, z in the GLOBAL frame (dataset.proto, CameraImage.velocity).
        turn_radps: about x, y, z of the global frame; z is up, so the last is the yaw rate, counter-clockwise.
        pose: world_from_vehicle, 16 values row by row; vehicle x forward, y left.
        place: for error texts.

    Raises:
        SourceError: a value isn't finite, or the pose can't be used.
    """
    rotation = pose_matrix(pose, f"{place}: the pose")[:3, :3]
    ahead, left, _ = (rotation.T @ np.array(velocity_mps, np.float64)).tolist()
    yaw_rate = float(turn_radps[2])
    if not all(map(math.isfinite, (ahead, left, yaw_rate))):
        raise SourceError(f"{place}: the velocity is {list(velocity_mps)} m/s, {list(turn_radps)} rad/s")
    return EgoMotion(ahead, -left, yaw_rate)


def motion_of_poses(world_from_vehicle: Mapping[int, FloatArray]) -> dict[int, EgoMotion | None]:
    """Ego-motion from the differences of poses, by their times in ns.

    Returns:
        None in place of the motion where there is but one pose.
    """
    times = sorted(world_from_vehicle)
    if len(times) < LEAST_POSES:
        return dict.fromkeys(times)
    motion = motion_from_poses(np.array(times, np.int64), np.stack([world_from_vehicle[time] for time in times]))
    return dict(zip(times, motion, strict=True))
