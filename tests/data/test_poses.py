"""Poses: rotations against SciPy, ego-motion on drives whose motion is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cable_rpc.data.poses import (
    inverse_rigid,
    motion_from_poses,
    quaternion_from_rotation,
    rigid,
    rotation_from_quaternion,
    yaw_of,
)
from cable_rpc.errors import SourceError


def flat(x: float, y: float, heading: float) -> np.ndarray:
    return rigid(Rotation.from_euler("z", heading).as_matrix(), (x, y, 0.0))


def test_rotation_agrees_with_scipy() -> None:
    for rotation in Rotation.random(50, random_state=3):
        x, y, z, w = rotation.as_quat()
        assert rotation_from_quaternion([w, x, y, z]) == pytest.approx(rotation.as_matrix())
        assert rotation_from_quaternion([-3 * w, -3 * x, -3 * y, -3 * z]) == pytest.approx(rotation.as_matrix())
        back = quaternion_from_rotation(rotation.as_matrix())
        assert back[0] >= 0
        assert np.copysign(1.0, w) * back == pytest.approx([w, x, y, z])


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_half_a_turn_has_a_quaternion(axis: str) -> None:
    rotation = Rotation.from_euler(axis, math.pi).as_matrix()
    assert rotation_from_quaternion(quaternion_from_rotation(rotation)) == pytest.approx(rotation, abs=1e-9)


@pytest.mark.parametrize("bad", [[0, 0, 0, 0], [1, 0, 0], [math.nan, 0, 0, 1], [math.inf, 0, 0, 0]])
def test_bad_quaternion(bad: list[float]) -> None:
    with pytest.raises(SourceError, match="no rotation"):
        rotation_from_quaternion(bad)


def test_inverse() -> None:
    matrix = rigid(Rotation.from_euler("xyz", [0.3, -0.5, 2.0]).as_matrix(), (3.0, -7.0, 1.0))
    assert inverse_rigid(matrix) @ matrix == pytest.approx(np.eye(4), abs=1e-12)
    assert inverse_rigid(matrix) == pytest.approx(np.linalg.inv(matrix))


@pytest.mark.parametrize("rate", [0.5, -0.5])
def test_circle_at_uneven_times(rate: float) -> None:
    """A left turn has a positive yaw rate, a right turn a negative one; speed is that along the arc."""
    times_s = np.array([0.0, 0.08, 0.17, 0.5, 0.58, 1.2, 9.0, 9.1])
    radius = 10.0 / rate
    poses = np.array([flat(radius * math.sin(rate * t), radius * (1 - math.cos(rate * t)), rate * t) for t in times_s])
    times_ns = np.round(times_s * 1e9).astype(np.int64)
    keep = [0, 1, 2, 3, 4, 5]
    for motion in motion_from_poses(times_ns[keep], poses[keep]):
        assert motion.speed_mps == pytest.approx(10.0)
        assert motion.lateral_mps == pytest.approx(0.0, abs=1e-9)
        assert motion.yaw_rate_radps == pytest.approx(rate)


def test_signs() -> None:
    times_ns = np.arange(5, dtype=np.int64) * 100_000_000
    # Heading north (+y); right of it is east (+x).
    drifting = np.array([flat(0.05 * i, 1.2 * i, math.pi / 2) for i in range(5)])
    for motion in motion_from_poses(times_ns, drifting):
        assert (motion.speed_mps, motion.lateral_mps, motion.yaw_rate_radps) == pytest.approx((12.0, 0.5, 0.0))
    backwards = np.array([flat(-0.3 * i, 0.0, 0.0) for i in range(5)])
    assert motion_from_poses(times_ns, backwards)[2].speed_mps == pytest.approx(-3.0)


def test_heading_past_half_a_turn() -> None:
    poses = np.array([flat(0.0, 0.0, math.pi - 0.25 + 0.1 * i) for i in range(6)])
    for motion in motion_from_poses(np.arange(6, dtype=np.int64) * 100_000_000, poses):
        assert motion.yaw_rate_radps == pytest.approx(1.0)


def test_braking_is_a_central_difference() -> None:
    """x = 12 t - t^2: at any spacing the speed at an inner pose is exactly 12 - 2 t, at the ends half a step off."""
    times_s = np.array([0.0, 0.1, 0.15, 0.25, 0.4, 0.5])
    poses = np.array([flat(12 * t - t * t, 0.0, 0.0) for t in times_s])
    speeds = [motion.speed_mps for motion in motion_from_poses((times_s * 1e9).round().astype(np.int64), poses)]
    assert speeds[1:-1] == pytest.approx(12 - 2 * times_s[1:-1])
    assert (speeds[0], speeds[-1]) == pytest.approx((11.9, 11.1))


def test_two_poses_and_fewer() -> None:
    poses = np.array([flat(0.0, 0.0, 0.0), flat(1.0, 0.0, 0.0)])
    one, two = motion_from_poses(np.array([0, 500_000_000], np.int64), poses)
    assert one == two
    assert one.speed_mps == pytest.approx(2.0)
    with pytest.raises(SourceError, match="at least two poses, got 1"):
        motion_from_poses(np.array([0], np.int64), poses[:1])
    with pytest.raises(SourceError, match="pose 1 is of 5 ns, not after"):
        motion_from_poses(np.array([5, 5], np.int64), poses)


def test_yaw_of_a_pitched_vehicle() -> None:
    rotation = Rotation.from_euler("ZYX", [0.7, 0.05, -0.03]).as_matrix()
    assert float(yaw_of(rotation)) == pytest.approx(0.7)
