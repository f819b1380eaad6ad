"""Content of CADC's text files, made from the rendered world."""

from __future__ import annotations

import math
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cable_rpc.data.cuboids import Cuboid
from cable_rpc.data.local_plane import geodetic_of
from cable_rpc.data.poses import inverse_rigid, rigid, yaw_of
from cable_rpc.types import CameraIntrinsics, EgoMotion

FloatArray = npt.NDArray[np.float64]

LABEL_BY_CLASS = {0: "Pedestrian", 1: "Bicycle", 2: "Car", 5: "Bus", 7: "Truck"}
"""COCO-80 index to CADC's label; a motorcycle, of which it has none, is a bicycle."""
LIDAR_TURN_RAD = 0.02
"""The rendered lidar looks this far to the left."""
LIDAR_BEHIND_CAMERA_M = 0.54
LIDAR_ABOVE_CAMERA_M = 0.62
GNSS_HEIGHT_M = 0.5
ORIGIN_DEG = (43.47, -80.54)
"""Latitude and longitude of the rendered world's origin: Waterloo, Ontario."""


@dataclass(frozen=True, slots=True)
class SensorPoses:
    """Where the sensors sit."""

    lidar_from_vehicle: FloatArray
    """float64 [4, 4]."""
    lidar_from_camera: FloatArray
    """float64 [4, 4]."""
    lidar_from_gnss: FloatArray
    """float64 [4, 4]; GNSS/INS unit x right, y forward, z up."""


def sensor_poses(vehicle_from_camera: FloatArray) -> SensorPoses:
    """Lidar above and behind the rendered camera, GNSS/INS unit where the rendered motion is told."""
    ahead, left, up = vehicle_from_camera[:3, 3].tolist()
    cosine, sine = math.cos(LIDAR_TURN_RAD), math.sin(LIDAR_TURN_RAD)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    vehicle_from_lidar = rigid(turn, (ahead - LIDAR_BEHIND_CAMERA_M, left, up + LIDAR_ABOVE_CAMERA_M))
    vehicle_from_gnss = rigid(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), (0.0, 0.0, GNSS_HEIGHT_M))
    lidar_from_vehicle = inverse_rigid(vehicle_from_lidar)
    return SensorPoses(
        lidar_from_vehicle, lidar_from_vehicle @ vehicle_from_camera, lidar_from_vehicle @ vehicle_from_gnss
    )


def camera_fields(
    name: str, intrinsics: CameraIntrinsics, size_hw: tuple[int, int], lens: Sequence[float]
) -> dict[str, Any]:
    """A camera's calibration file."""
    matrix = [intrinsics.fx, 0.0, intrinsics.cx, 0.0, intrinsics.fy, intrinsics.cy, 0.0, 0.0, 1.0]
    return {
        "camera_name": name,
        "image_width": size_hw[1],
        "image_height": size_hw[0],
        "camera_matrix": {"rows": 3, "cols": 3, "data": matrix},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": len(lens), "data": list(lens)},
    }


def extrinsics_fields(poses: SensorPoses, cameras: int) -> dict[str, Any]:
    """The file of sensor poses; ``T_A_B`` maps B into A."""
    camera = poses.lidar_from_camera.tolist()
    return {
        "T_LIDAR_GPSIMU": poses.lidar_from_gnss.tolist(),
        **{f"T_LIDAR_CAM{number:02d}": [list(row) for row in camera] for number in range(cameras)},
    }


def cuboid_rows(cuboids: Sequence[Cuboid], poses: SensorPoses) -> list[dict[str, Any]]:
    """The annotations of an instant, in lidar axes."""
    rows: list[dict[str, Any]] = []
    for cuboid in cuboids:
        x, y, z = (
            poses.lidar_from_vehicle[:3, :3] @ np.array(cuboid.centre_m) + poses.lidar_from_vehicle[:3, 3]
        ).tolist()
        length, width, height = cuboid.size_lwh_m
        rows.append(
            {
                "uuid": str(uuid.UUID(int=cuboid.track_id)),
                "label": LABEL_BY_CLASS.get(cuboid.class_id, "Bicycle"),
                "position": {"x": x, "y": y, "z": z},
                "dimensions": {"x": width, "y": length, "z": height},
                "yaw": math.remainder(cuboid.yaw_rad - LIDAR_TURN_RAD, 2 * math.pi),
                "stationary": False,
                "camera_used": 0,
                "attributes": {},
                "points_count": 0,
            }
        )
    return rows


def novatel_line(world_from_vehicle: FloatArray, ego: EgoMotion, *, velocities: bool) -> str:
    """One GNSS/INS message: 15 values, or 23 with velocities as the raw tree has them.

    Values: latitude, longitude (deg), height, undulation (m), their three standard deviations (m), roll, pitch,
    azimuth (deg), their three standard deviations, status, position type; then extended status, seconds since the last
    update, velocities north, east, up (m/s) and their standard deviations.
    """
    yaw = float(yaw_of(world_from_vehicle[:3, :3]))
    latitude, longitude = geodetic_of(world_from_vehicle[:2, 3], ORIGIN_DEG)
    values = [latitude, longitude, 330.0, -36.0, 0.02, 0.02, 0.03, 0.0, 0.0, (90.0 - math.degrees(yaw)) % 360.0]
    words = [f"{value:.12f}" for value in (*values, 0.01, 0.01, 0.05)] + ["3", "56"]
    if velocities:
        east, north, _ = (world_from_vehicle[:3, :3] @ (ego.speed_mps, -ego.lateral_mps, 0.0)).tolist()
        words += ["0", "0", *(f"{value:.6f}" for value in (north, east, 0.0, 0.01, 0.01, 0.01))]
    return " ".join(words)
