"""Lines of KITTI's text files, made from the rendered world."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cable_rpc.data.cuboids import Cuboid, cuboid_corners, project_corners
from cable_rpc.data.kitti.labels import VISIBILITY_BY_LEVEL
from cable_rpc.data.local_plane import geodetic_of
from cable_rpc.data.poses import inverse_rigid, rigid, yaw_of
from cable_rpc.types import CameraIntrinsics, EgoMotion

if TYPE_CHECKING:
    from cable_rpc.data.rendered_drive import DriveFrame

FloatArray = npt.NDArray[np.float64]

TYPE_BY_CLASS = {0: "Pedestrian", 1: "Cyclist", 2: "Car", 7: "Truck"}
"""COCO-80 index to KITTI's object type; KITTI calls other traffic Misc."""
IMU_HEIGHT_M = 0.93
"""Above the road (figure of the sensor setup on the data set's site)."""
LIDAR_ABOVE_CAMERA_M = 0.08
LIDAR_BEHIND_CAMERA_M = 0.27
BASELINE_M = 0.06
"""From camera 0, whose rectified frame labels are in, to the left colour camera."""
RECTIFYING_TURN_RAD = 0.01
ORIGIN_DEG = (49.0, 8.43)
"""Latitude and longitude of the rendered world's origin: Karlsruhe."""


@dataclass(frozen=True, slots=True)
class WrittenCalibration:
    """The matrices of a calibration file."""

    projection: FloatArray
    """P2, [3, 4]."""
    rectification: FloatArray
    """[4, 4]."""
    camera_from_lidar: FloatArray
    """Camera 0 before rectification, [4, 4]."""
    lidar_from_imu: FloatArray
    """[4, 4]."""
    rectified_from_vehicle: FloatArray
    """From the rendered vehicle's axes to the frame of the labels, [4, 4]."""


def drive_calibration(intrinsics: CameraIntrinsics, vehicle_from_camera: FloatArray) -> WrittenCalibration:
    """A chain of sensor poses, none of them trivial, that ends where the rendered camera is."""
    matrix = np.array([[intrinsics.fx, 0.0, intrinsics.cx], [0.0, intrinsics.fy, intrinsics.cy], [0.0, 0.0, 1.0]])
    rectified_from_camera = rigid(np.eye(3), (-BASELINE_M, 0.0, 0.0))
    rectified_from_vehicle: FloatArray = rectified_from_camera @ inverse_rigid(vehicle_from_camera)
    cosine, sine = math.cos(RECTIFYING_TURN_RAD), math.sin(RECTIFYING_TURN_RAD)
    rectification = rigid(np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]]), (0.0, 0.0, 0.0))
    ahead, left, up = vehicle_from_camera[:3, 3].tolist()
    lidar_place = (ahead - LIDAR_BEHIND_CAMERA_M, left, up + LIDAR_ABOVE_CAMERA_M)
    vehicle_from_lidar = rigid(np.eye(3), lidar_place)
    vehicle_from_imu = rigid(np.eye(3), (0.0, 0.0, IMU_HEIGHT_M))
    return WrittenCalibration(
        matrix @ np.array([[1.0, 0.0, 0.0, BASELINE_M], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]),
        rectification,
        inverse_rigid(rectification) @ rectified_from_vehicle @ vehicle_from_lidar,
        inverse_rigid(vehicle_from_lidar) @ vehicle_from_imu,
        rectified_from_vehicle,
    )


def calibration_lines(calibration: WrittenCalibration, spelling: str) -> list[str]:
    """A calibration file in the spelling of the ``object`` or the ``tracking`` benchmark."""
    names = {
        "object": ("R0_rect:", "Tr_velo_to_cam:", "Tr_imu_to_velo:"),
        "tracking": ("R_rect", "Tr_velo_cam", "Tr_imu_velo"),
    }[spelling]
    matrices = (
        calibration.rectification[:3, :3],
        calibration.camera_from_lidar[:3],
        calibration.lidar_from_imu[:3],
    )
    rows = [(f"P{camera}:", calibration.projection) for camera in range(4)]
    rows += zip(names, matrices, strict=True)
    return [f"{name} {' '.join(f'{value:.12e}' for value in matrix.ravel())}" for name, matrix in rows]


def label_lines(driven: DriveFrame, calibration: WrittenCalibration, least_height_px: float) -> list[str]:
    """The label rows of a frame.

    Truncation comes in levels by how much of the cuboid's box hangs over the image, occlusion by the truth.
    """
    frame = driven.frame
    truth = frame.truth
    if truth is None or frame.intrinsics is None:
        return []
    height, width = frame.size_hw
    camera_from_vehicle = inverse_rigid(driven.vehicle_from_camera)
    corners = cuboid_corners(driven.cuboids)
    inside = project_corners(corners, camera_from_vehicle, frame.intrinsics, (width, height)).inside_share.tolist()
    lines: list[str] = []
    for row, cuboid in enumerate(driven.cuboids):
        box = truth.boxes_xyxy[row].tolist()
        edges = " ".join(f"{edge:.6f}" for edge in box)
        if box[3] - box[1] < least_height_px:
            lines.append(f"{frame.index} -1 DontCare -1 -1 -10.000000 {edges} {'-1000.000000 ' * 3}{dummies()}")
            continue
        kind = TYPE_BY_CLASS.get(cuboid.class_id, "Misc")
        truncated, occluded = level_of(inside[row]), level_of(float(truth.visibility[row]))
        alpha, place = place_in_camera(cuboid, calibration.rectified_from_vehicle)
        lines.append(f"{frame.index} {cuboid.track_id} {kind} {truncated} {occluded} {alpha:.6f} {edges} {place}")
    return lines


def dummies() -> str:
    """What DontCare rows have in place of location and rotation."""
    return "-10.000000 -1.000000 -1.000000 -1.000000"


def level_of(share: float) -> str:
    """The level 0, 1 or 2 whose visible share is nearest."""
    return min(("0", "1", "2"), key=lambda level: abs(VISIBILITY_BY_LEVEL[level] - share))


def place_in_camera(cuboid: Cuboid, rectified_from_vehicle: FloatArray) -> tuple[float, str]:
    """Observation angle alpha, and the columns height, width, length, x, y, z, rotation_y of an object.

    Location is the middle of the bottom; rotation is about the camera's y axis, 0 along its x axis (devkit's readme).
    """
    length, width, height = cuboid.size_lwh_m
    x, y, z = cuboid.centre_m
    bottom = rectified_from_vehicle[:3, :3] @ (x, y, z - height / 2) + rectified_from_vehicle[:3, 3]
    ahead = rectified_from_vehicle[:3, :3] @ (math.cos(cuboid.yaw_rad), math.sin(cuboid.yaw_rad), 0.0)
    rotation_y = math.atan2(-float(ahead[2]), float(ahead[0]))
    alpha = math.remainder(rotation_y - math.atan2(float(bottom[0]), float(bottom[2])), 2 * math.pi)
    values = (height, width, length, *bottom.tolist(), rotation_y)
    return alpha, " ".join(f"{value:.6f}" for value in values)


def oxts_line(world_from_vehicle: FloatArray, ego: EgoMotion) -> str:
    """One line of the GPS/IMU record; what the rendered world doesn't tell is 0."""
    yaw = float(yaw_of(world_from_vehicle[:3, :3]))
    east, north, _ = (world_from_vehicle[:3, :3] @ (ego.speed_mps, -ego.lateral_mps, 0.0)).tolist()
    latitude, longitude = geodetic_of(world_from_vehicle[:2, 3], ORIGIN_DEG)
    values = [
        *(latitude, longitude, 112.0, 0.0, 0.0, yaw),
        *(north, east, ego.speed_mps, -ego.lateral_mps, 0.0),
        *(0.0, 0.0, 9.81, 0.0, 0.0, 9.81),
        *(0.0, 0.0, ego.yaw_rate_radps, 0.0, 0.0, ego.yaw_rate_radps),
        *(0.05, 0.02),
    ]
    return " ".join(f"{value:.10f}" for value in values) + " 4 10 4 4 0"
