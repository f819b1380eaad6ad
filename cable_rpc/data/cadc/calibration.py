"""CADC's calibration of the front camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.cadc.layout import WEBSITE
from cable_rpc.data.json_fields import JsonRow, is_finite, shown
from cable_rpc.data.poses import inverse_rigid
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.types import CameraIntrinsics

FloatArray = npt.NDArray[np.float64]

CAMERA_FILE = "00.yaml"
EXTRINSICS_FILE = "extrinsics.yaml"
LENS_TERMS = (4, 5, 8, 12, 14)
"""How many coefficients OpenCV's lens model takes."""


@dataclass(frozen=True, slots=True)
class CadcCalibration:
    """The front camera among the sensors."""

    intrinsics: CameraIntrinsics
    distortion: FloatArray
    """float64 [4] or [5], OpenCV's k1, k2, p1, p2 (, k3); of the raw images only."""
    size_wh: tuple[int, int] | None
    """Of the images it holds for, where the file tells."""
    lidar_from_camera: FloatArray
    """T_LIDAR_CAM00, float64 [4, 4], from optical axes (x right, y down, z forward)."""
    lidar_from_gnss: FloatArray | None
    """T_LIDAR_GPSIMU, float64 [4, 4], from the GNSS/INS unit's axes (x right, y forward, z up)."""

    @property
    def camera_from_lidar(self) -> FloatArray:
        """float64 [4, 4]."""
        return inverse_rigid(self.lidar_from_camera)

    @property
    def pitch_down_rad(self) -> float:
        """Tilt of the optical axis below the GNSS/INS unit's horizontal, below the lidar's without one."""
        levelled = self.lidar_from_camera
        if self.lidar_from_gnss is not None:
            levelled = inverse_rigid(self.lidar_from_gnss) @ self.lidar_from_camera
        return math.asin(max(-1.0, min(1.0, -float(levelled[2, 2]))))

    @property
    def forward_m(self) -> float:
        """Optical centre ahead of the GNSS/INS unit, whose motion is told; 0 where its place isn't known."""
        if self.lidar_from_gnss is None:
            return 0.0
        gnss_from_camera = inverse_rigid(self.lidar_from_gnss) @ self.lidar_from_camera
        return float(gnss_from_camera[1, 3])

    def distort(self, points: FloatArray) -> FloatArray:
        """Normalised image points [M, 2] to where the lens puts them, [M, 2]."""
        if not len(points):
            return points
        rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
        moved, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), self.distortion)
        return moved.reshape(-1, 2).astype(np.float64)


def read_calibration(folder: Path) -> CadcCalibration:
    """Read ``00.yaml`` and ``extrinsics.yaml``.

    Raises:
        ConfigurationError: PyYAML isn't installed.
        SourceError: a file is missing or no YAML, or a value can't be used.
    """
    camera_file, extrinsics_file = folder / CAMERA_FILE, folder / EXTRINSICS_FILE
    camera, extrinsics = read_yaml(camera_file), read_yaml(extrinsics_file)
    matrix = matrix_data(camera, "camera_matrix", (9,), camera_file)
    if not (matrix[0] > 0 and matrix[4] > 0):
        raise SourceError(f"{camera_file}: camera_matrix has no focal length: {matrix.tolist()}")
    fx, _, cx, _, fy, cy = matrix[:6].tolist()
    width, height = camera.get("image_width"), camera.get("image_height")
    sized = isinstance(width, int) and isinstance(height, int)
    gnss = pose(extrinsics, "T_LIDAR_GPSIMU", extrinsics_file) if "T_LIDAR_GPSIMU" in extrinsics else None
    return CadcCalibration(
        CameraIntrinsics(fx, fy, cx, cy),
        matrix_data(camera, "distortion_coefficients", LENS_TERMS, camera_file),
        (int(camera["image_width"]), int(camera["image_height"])) if sized else None,
        pose(extrinsics, "T_LIDAR_CAM00", extrinsics_file),
        gnss,
    )


def yaml_module() -> Any:
    """``yaml``, which no other part of the system needs.

    Raises:
        ConfigurationError: it isn't installed.
    """
    try:
        return import_module("yaml")
    except ModuleNotFoundError:
        raise ConfigurationError(
            "CADC's calibration is YAML, which needs PyYAML; install it with: pip install 'cable-rpc[study]'"
        ) from None


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file that holds a mapping.

    Raises:
        ConfigurationError: PyYAML isn't installed.
        SourceError: it is missing or holds something else.
    """
    yaml = yaml_module()
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"can't read calibration {path}: {error}; it is in calib.zip at {WEBSITE}") from error
    except yaml.YAMLError as error:
        raise SourceError(f"{path} is no YAML: {' '.join(str(error).split())}") from error
    if not isinstance(document, dict):
        raise SourceError(f"{path} holds {shown(document)}; a calibration is a mapping")
    return document


def matrix_data(document: JsonRow, key: str, lengths: tuple[int, ...], path: Path) -> FloatArray:
    """The list ``KEY.data``, float64 [N].

    Raises:
        SourceError: it is missing, of another length, or holds something else than finite numbers.
    """
    holder = document.get(key)
    data = holder.get("data") if isinstance(holder, dict) else None
    if not isinstance(data, list) or len(data) not in lengths or not all(is_finite(value) for value in data):
        wanted = " or ".join(str(length) for length in lengths)
        raise SourceError(f"{path}: {key}.data is {shown(data)}; it must be {wanted} finite numbers")
    return np.array(data, np.float64)


def pose(document: JsonRow, key: str, path: Path) -> FloatArray:
    """A rigid transform, float64 [4, 4].

    Raises:
        SourceError: it is missing, or no rotation and translation.
    """
    try:
        matrix = np.array(document.get(key), np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.size == 16:
        matrix = matrix.reshape(4, 4)
    rotation = matrix[:3, :3] if matrix.shape == (4, 4) else np.zeros((3, 3))
    if not np.isfinite(matrix).all() or not np.allclose(rotation @ rotation.T, np.eye(3), atol=0.01):
        raise SourceError(f"{path}: {key} is {shown(document.get(key))}; it must be a 4x4 rotation and translation")
    return matrix
