"""Rigid poses of data sets and the ego-motion that follows from them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from cable_rpc.errors import SourceError
from cable_rpc.types import EgoMotion

FloatArray = npt.NDArray[np.float64]

NS_PER_S = 1_000_000_000
LEAST_POSES = 2


def rotation_from_quaternion(wxyz: Sequence[float] | FloatArray) -> FloatArray:
    """The rotation of a quaternion (w, x, y, z) of any length above 0.

    Returns:
        float64 [3, 3].

    Raises:
        SourceError: not four finite numbers, or all of them zero.
    """
    values = np.asarray(wxyz, np.float64)
    length = float(np.linalg.norm(values))
    if values.shape != (4,) or not np.isfinite(length) or length < 1e-9:
        raise SourceError(f"{wxyz} is no rotation; a quaternion has four finite numbers w, x, y, z, not all zero")
    w, x, y, z = (values / length).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """The unit quaternion (w, x, y, z), w >= 0, float64 [4], of a rotation [3, 3].

    It is the eigenvector of the largest eigenvalue of a symmetric matrix, which no angle makes ill-conditioned
    (Bar-Itzhack 2000, "New method for extracting the quaternion from a rotation matrix").
    """
    r = rotation
    lower = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], 0.0, 0.0, 0.0],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], 0.0, 0.0],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0.0],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    quaternion: FloatArray = np.linalg.eigh(lower, UPLO="L")[1][:, -1]
    return -quaternion if quaternion[0] < 0 else quaternion


def rigid(rotation: FloatArray, translation: Sequence[float] | FloatArray) -> FloatArray:
    """The homogeneous matrix, float64 [4, 4], of a rotation [3, 3] followed by a translation [3]."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def inverse_rigid(matrix: FloatArray) -> FloatArray:
    """The inverse of a rigid transform, float64 [4, 4]; exact up to rounding where the rotation is orthonormal."""
    rotation = matrix[:3, :3].T
    return rigid(rotation, -rotation @ matrix[:3, 3])


def yaw_of(rotation: FloatArray) -> FloatArray:
    """Heading about +z, radians counter-clockwise, of rotations [..., 3, 3] whose first axis points ahead."""
    yaw: FloatArray = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
    return yaw


def motion_from_poses(times_ns: npt.NDArray[np.int64], world_from_vehicle: FloatArray) -> list[EgoMotion]:
    """Ego-motion by central differences of the poses, one-sided at both ends.

    Between two poses the vehicle is taken to drive an arc of constant speed and yaw rate, whose chord points along
    the heading halfway; so a drive on a circle gives exact figures at any spacing, and no lateral speed. A pose's own
    motion is that of the intervals before and after, weighted to its instant.

    Args:
        times_ns: int64 [N], strictly rising.
        world_from_vehicle: float64 [N, 4, 4], z up, vehicle x forward and y left.

    Raises:
        SourceError: fewer than two poses, or times that don't rise.
    """
    if len(times_ns) < LEAST_POSES:
        raise SourceError(f"ego-motion needs at least two poses, got {len(times_ns)}")
    steps_s = np.diff(times_ns) / NS_PER_S
    if (steps_s <= 0).any():
        row = int(np.argmax(steps_s <= 0)) + 1
        raise SourceError(
            f"pose {row} is of {int(times_ns[row])} ns, not after the one before it ({int(times_ns[row - 1])} ns)"
        )
    yaws = np.unwrap(yaw_of(world_from_vehicle[:, :3, :3]))
    turns = np.diff(yaws)
    middle = yaws[:-1] + turns / 2
    # An arc is longer than its chord by (turn / 2) / sin(turn / 2); numpy's sinc has pi built in.
    velocity = np.diff(world_from_vehicle[:, :2, 3], axis=0) / (steps_s * np.sinc(turns / (2 * np.pi)))[:, None]
    cosine, sine = np.cos(middle), np.sin(middle)
    forward = cosine * velocity[:, 0] + sine * velocity[:, 1]
    right = sine * velocity[:, 0] - cosine * velocity[:, 1]
    table = np.stack([forward, right, turns / steps_s], axis=1)
    before, after = np.vstack([table[:1], table]), np.vstack([table, table[-1:]])
    # The nearer interval counts for more: its middle lies closer to the instant of the pose.
    share = np.concatenate([[0.5], steps_s[1:] / (steps_s[1:] + steps_s[:-1]), [0.5]])[:, None]
    return [EgoMotion(*row) for row in (share * before + (1 - share) * after).tolist()]
