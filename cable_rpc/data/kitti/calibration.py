"""KITTI's calibration files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cable_rpc.data.kitti.layout import WEBSITE
from cable_rpc.data.poses import inverse_rigid
from cable_rpc.errors import SourceError
from cable_rpc.types import CameraIntrinsics, CameraMount

FloatArray = npt.NDArray[np.float64]

CAMERA_HEIGHT_M = 1.65
"""Above the road, all cameras (figure of the sensor setup on the data set's site)."""
SPELLINGS = {
    "P2": ("P2",),
    "R0_rect": ("R0_rect", "R_rect"),
    "Tr_velo_to_cam": ("Tr_velo_to_cam", "Tr_velo_cam"),
    "Tr_imu_to_velo": ("Tr_imu_to_velo", "Tr_imu_velo"),
}
"""Name in the object benchmark, and what files call it; the tracking benchmark has the second ones, some without a
colon."""
SHAPES = {"P2": (3, 4), "R0_rect": (3, 3), "Tr_velo_to_cam": (3, 4), "Tr_imu_to_velo": (3, 4)}


@dataclass(frozen=True, slots=True)
class KittiCalibration:
    """Where the left colour camera looks."""

    projection: FloatArray
    """P2, float64 [3, 4], from rectified coordinates of camera 0 to pixels."""
    rectified_from_imu: FloatArray
    """float64 [4, 4], from the IMU (x forward, y left, z up) to rectified camera 0 (x right, y down, z forward)."""

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """Of the rectified image."""
        matrix = self.projection.tolist()
        return CameraIntrinsics(matrix[0][0], matrix[1][1], matrix[0][2], matrix[1][2])

    @property
    def camera_from_imu(self) -> FloatArray:
        """float64 [4, 4], from the IMU to the left colour camera, which P2 moves from camera 0."""
        moved = np.eye(4)
        moved[:3, 3] = np.linalg.solve(self.projection[:, :3], self.projection[:, 3])
        matrix: FloatArray = moved @ self.rectified_from_imu
        return matrix

    @property
    def mount(self) -> CameraMount:
        """Height as published; tilt and distance ahead of the IMU, whose motion the oxts record tells."""
        imu_from_camera = inverse_rigid(self.camera_from_imu)
        pitch = math.asin(max(-1.0, min(1.0, -float(imu_from_camera[2, 2]))))
        return CameraMount(CAMERA_HEIGHT_M, pitch, float(imu_from_camera[0, 3]))


def read_calibration(path: Path) -> KittiCalibration:
    """Read a calibration file, of either spelling.

    Raises:
        SourceError: it is missing, a matrix is missing, or a value can't be used.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(
            f"can't read calibration {path}: {error}; it is part of 'camera calibration matrices' at {WEBSITE}"
        ) from error
    rows: dict[str, tuple[int, list[str]]] = {}
    for number, line in enumerate(lines, 1):
        words = line.replace(":", " ", 1).split()
        if words:
            rows[words[0]] = (number, words[1:])
    matrices = {name: find_matrix(path, rows, name) for name in SHAPES}
    rectification = np.eye(4)
    rectification[:3, :3] = matrices["R0_rect"]
    rectified_from_imu = rectification @ square(matrices["Tr_velo_to_cam"]) @ square(matrices["Tr_imu_to_velo"])
    return KittiCalibration(matrices["P2"], rectified_from_imu)


def find_matrix(path: Path, rows: dict[str, tuple[int, list[str]]], name: str) -> FloatArray:
    """One matrix by its name in the object benchmark.

    Raises:
        SourceError: it is missing, or not made of as many finite numbers as it needs.
    """
    spelling = next((spelling for spelling in SPELLINGS[name] if spelling in rows), None)
    if spelling is None:
        raise SourceError(
            f"{path} has no {' or '.join(SPELLINGS[name])}; found {', '.join(rows) or 'nothing'}; "
            f"get it anew at {WEBSITE}"
        )
    number, words = rows[spelling]
    height, width = SHAPES[name]
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.full(1, np.nan)
    if len(values) != height * width or not np.isfinite(values).all():
        raise SourceError(f"{path} line {number}: {spelling} is '{' '.join(words)}'; it needs {height * width} numbers")
    if name == "P2" and not (values[0] > 0 and values[5] > 0):
        raise SourceError(f"{path} line {number}: {spelling} has no focal length: '{' '.join(words)}'")
    return values.reshape(height, width)


def square(matrix: FloatArray) -> FloatArray:
    """[3, 4] with the last row of a homogeneous matrix added, [4, 4]."""
    return np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
