"""The pinhole camera of the rendered world and its exact relation to the ground plane."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cable_rpc.types import CameraIntrinsics

FloatArray = npt.NDArray[np.float64]

NEAR_PLANE_M = 0.3


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera above the ego vehicle's reference point, looking forward.

    Pixel (0, 0) has its centre at image coordinates (0, 0). Vehicle axes are x forward, y right, z up.
    """

    width: int
    height: int
    intrinsics: CameraIntrinsics
    mount_height_m: float
    pitch_down_rad: float
    vehicle_to_camera: FloatArray = field(init=False, repr=False, compare=False)
    """Rotation from vehicle axes (forward, right, up) to camera axes (right, down, depth), [3, 3]."""
    vehicle_origin: FloatArray = field(init=False, repr=False, compare=False)
    """The vehicle's reference point on the ground in camera axes, [3], metres."""

    def __post_init__(self) -> None:
        sine, cosine = math.sin(self.pitch_down_rad), math.cos(self.pitch_down_rad)
        rotation = np.array([[0.0, 1.0, 0.0], [-sine, 0.0, -cosine], [cosine, 0.0, -sine]])
        object.__setattr__(self, "vehicle_to_camera", rotation)
        object.__setattr__(self, "vehicle_origin", rotation @ np.array([0.0, 0.0, -self.mount_height_m]))

    @classmethod
    def with_field_of_view(
        cls, width: int, height: int, horizontal_fov_deg: float, mount_height_m: float, pitch_down_rad: float
    ) -> Camera:
        """A camera of square pixels whose image spans the given horizontal angle."""
        focal = width / (2.0 * math.tan(math.radians(horizontal_fov_deg) / 2.0))
        intrinsics = CameraIntrinsics(focal, focal, (width - 1) / 2.0, (height - 1) / 2.0)
        return cls(width, height, intrinsics, mount_height_m, pitch_down_rad)

    @property
    def matrix(self) -> FloatArray:
        """The intrinsic matrix K, float64 [3, 3]."""
        k = self.intrinsics
        return np.array([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]])

    @property
    def horizon_row(self) -> float:
        """Image row of the horizon, pixels."""
        return self.intrinsics.cy - self.intrinsics.fy * math.tan(self.pitch_down_rad)

    def to_camera(self, points: FloatArray) -> FloatArray:
        """Vehicle-frame points [N, 3] in metres to camera-frame points [N, 3] (right, down, depth)."""
        moved: FloatArray = points @ self.vehicle_to_camera.T + self.vehicle_origin
        return moved

    def image_points(self, camera_points: FloatArray) -> FloatArray:
        """Camera-frame points [..., 3] in front of the camera to pixels [..., 2]."""
        k = self.intrinsics
        pixels = camera_points[..., :2] / np.maximum(camera_points[..., 2:], 1e-6)
        pixels *= (k.fx, k.fy)
        pixels += (k.cx, k.cy)
        return pixels

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Vehicle-frame points [N, 3] to pixels [N, 2] and depths [N] (metres, negative behind)."""
        camera_points = self.to_camera(points)
        return self.image_points(camera_points), camera_points[:, 2]

    @property
    def ground_to_image(self) -> FloatArray:
        """Homography [3, 3] from (forward, right, 1) on the ground to homogeneous pixels."""
        rotation = self.vehicle_to_camera
        return self.matrix @ np.column_stack([rotation[:, 0], rotation[:, 1], self.vehicle_origin])

    def row_at_distance(self, forward_m: float) -> float:
        """Image row of the ground straight ahead at a distance."""
        point = self.ground_to_image @ np.array([forward_m, 0.0, 1.0])
        return float(point[1] / point[2])
