"""What the vehicle did between two frames, and how that moves the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from cable_rpc.edge.roi_config import EgoModel, RoiConfig
from cable_rpc.edge.view_warp import Homography, ViewWarp, identity_homography
from cable_rpc.types import CameraIntrinsics, CameraMount, EgoMotion

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class EgoStep:
    """What the vehicle did between two frames."""

    warp: ViewWarp = field(default_factory=ViewWarp)
    """How the picture moved; nothing where ``model`` is ``flow``, which needs the pictures themselves."""
    displacement_m: float = 0.0
    """Length of the way driven, at least 0."""
    yaw_change_deg: float = 0.0
    """Absolute heading change, summed over the frames of the step."""
    model: EgoModel = "identity"
    """The model behind ``warp``, of the last frame if there are several."""
    clamped: bool = False
    """Whether the paper's shift was limited."""

    def then(self, following: EgoStep) -> EgoStep:
        """This step and the one after it, as one."""
        return EgoStep(
            self.warp.then(following.warp),
            self.displacement_m + following.displacement_m,
            self.yaw_change_deg + following.yaw_change_deg,
            following.model,
            self.clamped or following.clamped,
        )


@dataclass(frozen=True, slots=True)
class PlanarMotion:
    """A vehicle's motion over a time, in its axes at the start (x forward, y right, yaw positive left)."""

    forward_m: float
    right_m: float
    yaw_rad: float

    @property
    def is_finite(self) -> bool:
        """Whether nothing overflowed."""
        return math.isfinite(self.forward_m) and math.isfinite(self.right_m) and math.isfinite(self.yaw_rad)


def planar_motion(ego: EgoMotion, dt_s: float) -> PlanarMotion:
    """Where constant speeds and a constant yaw rate lead: an arc, the exponential map of SE(2).

    Args:
        ego: motion over the whole time.
        dt_s: the time, seconds.

    Returns:
        The motion; not finite where the product of speed and time overflows.
    """
    forward_m, right_m = ego.speed_mps * dt_s, ego.lateral_mps * dt_s
    yaw_rad = ego.yaw_rate_radps * dt_s
    if not math.isfinite(yaw_rad):
        return PlanarMotion(math.nan, math.nan, math.nan)
    half = yaw_rad / 2
    # sin(yaw) / yaw and (1 - cos(yaw)) / yaw; the second as sin(half)^2 / half, which doesn't cancel.
    along = math.sin(yaw_rad) / yaw_rad if yaw_rad else 1.0
    across = math.sin(half) ** 2 / half if half else 0.0
    return PlanarMotion(along * forward_m + across * right_m, along * right_m - across * forward_m, yaw_rad)


def ego_step(
    ego: EgoMotion | None,
    intrinsics: CameraIntrinsics | None,
    mount: CameraMount | None,
    dt_s: float,
    config: RoiConfig,
    width: int,
) -> EgoStep:
    """The step of ``dt_s`` seconds that ends at a frame with the given ego-motion.

    A model whose inputs are unknown gives way: ``ground_plane`` to ``rotation``, ``rotation`` and ``paper`` to
    ``config.ego_fallback``. Below ``config.standstill_mps`` the picture stands still under every model: a gyro's
    output is noise then, and the paper's quotient is one of two noises. What was measured is still told in
    ``displacement_m`` and ``yaw_change_deg``, so a vehicle that does creep widens its dilation.

    Args:
        ego: motion over the step; None where it isn't known.
        intrinsics: the camera, in pixels of the frame that the warp is for; None where it isn't known.
        mount: where the camera sits; None where it isn't known.
        dt_s: duration of the step in seconds.
        config: which model, and its limits.
        width: of the frame, pixels.

    Returns:
        The step; ``model`` tells what was really used. ``flow`` leaves the warp to be estimated from the pictures.
    """
    if ego is None:
        return EgoStep(model=usable_model(config, ego, intrinsics, mount))
    speed_mps = math.hypot(ego.speed_mps, ego.lateral_mps)
    displacement_m = speed_mps * dt_s
    yaw_change_deg = abs(math.degrees(ego.yaw_rate_radps * dt_s))
    if speed_mps < config.standstill_mps:
        return EgoStep(displacement_m=displacement_m, yaw_change_deg=yaw_change_deg)
    model = usable_model(config, ego, intrinsics, mount)
    warp, clamped = ViewWarp(), False
    if intrinsics is not None and model == "paper":
        homography = translation_homography(ego, dt_s, intrinsics.fx, config.epsilon_m)
        warp, clamped = clamped_shift(homography, config.max_shift_share * width)
    elif intrinsics is not None and model in ("rotation", "ground_plane"):
        warp = camera_warp(planar_motion(ego, dt_s), intrinsics, mount, model)
    return EgoStep(warp, displacement_m, yaw_change_deg, model, clamped)


def usable_model(
    config: RoiConfig, ego: EgoMotion | None, intrinsics: CameraIntrinsics | None, mount: CameraMount | None
) -> EgoModel:
    """The configured model, or what stands in for it where its inputs are unknown."""
    model = config.ego_model
    if model in ("identity", "flow"):
        return model
    if ego is None or intrinsics is None or min(abs(intrinsics.fx), abs(intrinsics.fy)) == 0:
        return config.ego_fallback
    if model == "ground_plane" and (mount is None or mount.height_m <= 0):
        return "rotation"
    return model


def translation_homography(ego: EgoMotion | None, dt_s: float, fx: float | None, epsilon_m: float) -> Homography:
    """H_k of the paper: a horizontal shift of ``-f_x v_y dt / max(|v_x dt|, eps)`` pixels.

    The result maps the previous frame's pixels to the current frame's (forward, source to destination).
    Vehicle axes are y right, for which the paper's minus sign is that of a forward map: driving to the
    left moves the scene to the right.

    Args:
        ego: motion over the step, or None where it isn't known.
        dt_s: duration of the step in seconds.
        fx: focal length in pixels, or None where it isn't known.
        epsilon_m: least forward displacement to divide by, in metres.

    Returns:
        float64 [3, 3]; the identity where ego-motion or focal length is unknown.
    """
    homography = identity_homography()
    if ego is not None and fx is not None:
        forward_m = max(abs(ego.speed_mps * dt_s), epsilon_m)
        homography[0, 2] = -fx * ego.lateral_mps * dt_s / forward_m
    return homography


def clamped_shift(homography: Homography, limit_px: float) -> tuple[ViewWarp, bool]:
    """A horizontal shift of at most ``limit_px`` pixels, and whether it had to be limited; 0 never limits."""
    shift = float(homography[0, 2])
    if limit_px <= 0 or abs(shift) <= limit_px:
        return ViewWarp(homography), False
    limited = homography.copy()
    limited[0, 2] = math.copysign(limit_px, shift)
    return ViewWarp(limited), True


def camera_warp(
    motion: PlanarMotion,
    intrinsics: CameraIntrinsics,
    mount: CameraMount | None,
    model: Literal["rotation", "ground_plane"],
) -> ViewWarp:
    """How a motion of the vehicle moves the picture under a model of the scene.

    Args:
        motion: of the vehicle, from the earlier frame to the later.
        intrinsics: the camera.
        mount: where it sits; ``rotation`` takes an unknown one for level.
        model: ``rotation`` ignores the translation, ``ground_plane`` takes all below the horizon for the road.
    """
    if not motion.is_finite:
        return ViewWarp(np.full((3, 3), np.nan))
    pitch_down_rad = 0.0 if mount is None else mount.pitch_down_rad
    if model == "rotation" or mount is None:
        return ViewWarp(rotation_homography(intrinsics, pitch_down_rad, motion.yaw_rad))
    ground, far = ground_plane_homographies(intrinsics, mount, motion.forward_m, motion.right_m, motion.yaw_rad)
    return ViewWarp(ground, far, horizon_row(intrinsics, pitch_down_rad))


def horizon_row(intrinsics: CameraIntrinsics, pitch_down_rad: float) -> float:
    """Image row, in pixels, of a level plane's horizon seen by a camera without roll."""
    return intrinsics.cy - intrinsics.fy * math.tan(pitch_down_rad)


def rotation_homography(intrinsics: CameraIntrinsics, pitch_down_rad: float, yaw_change_rad: float) -> Homography:
    """K R K^-1 (Hartley and Zisserman, Multiple View Geometry, 8.4): how a turn moves the picture at any depth.

    Args:
        intrinsics: the camera.
        pitch_down_rad: tilt of the optical axis below the horizontal; the turn is about the vertical.
        yaw_change_rad: heading change, positive to the left, which moves the picture to the right.

    Returns:
        float64 [3, 3], forward map; the exact identity where the heading doesn't change.
    """
    if yaw_change_rad == 0:
        return identity_homography()
    return calibrated(intrinsics, camera_rotation(pitch_down_rad, yaw_change_rad))


def ground_plane_homographies(
    intrinsics: CameraIntrinsics, mount: CameraMount, forward_m: float, right_m: float, yaw_change_rad: float
) -> tuple[Homography, Homography]:
    """K (R - t n^T / h) K^-1 of the road below the horizon, and K R K^-1 of what is far, above it.

    (Hartley and Zisserman, Multiple View Geometry, 13.1; both have determinant 1, so the homogeneous coordinate
    of a mapped pixel is the ratio of its new depth to its old.)

    Args:
        intrinsics: the camera.
        mount: height, tilt and lever arm of the camera.
        forward_m: displacement of the vehicle's reference point, along its heading at the start.
        right_m: the same to the right.
        yaw_change_rad: heading change, positive to the left.

    Returns:
        float64 [3, 3] twice, forward maps; exact identities where nothing moves.
    """
    far = rotation_homography(intrinsics, mount.pitch_down_rad, yaw_change_rad)
    if forward_m == right_m == yaw_change_rad == 0:
        return identity_homography(), far
    sine, cosine = math.sin(mount.pitch_down_rad), math.cos(mount.pitch_down_rad)
    # The camera swings about the reference point that it sits ahead of.
    ahead_m = forward_m + mount.forward_m * (math.cos(yaw_change_rad) - 1)
    aside_m = right_m - mount.forward_m * math.sin(yaw_change_rad)
    rotation = camera_rotation(mount.pitch_down_rad, yaw_change_rad)
    with np.errstate(over="ignore", invalid="ignore"):
        translation = rotation @ np.array([aside_m, -sine * ahead_m, cosine * ahead_m])
        normal_over_height = np.array([0.0, cosine, sine]) / mount.height_m
        return calibrated(intrinsics, rotation - np.outer(translation, normal_over_height)), far


def camera_rotation(pitch_down_rad: float, yaw_change_rad: float) -> Matrix:
    """Earlier to later camera axes (right, down, depth) for a turn to the left, float64 [3, 3]."""
    sine, cosine = math.sin(pitch_down_rad), math.cos(pitch_down_rad)
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])
    sine, cosine = math.sin(yaw_change_rad), math.cos(yaw_change_rad)
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return tilt @ turn @ tilt.T


def calibrated(intrinsics: CameraIntrinsics, motion: Matrix) -> Homography:
    """K M K^-1."""
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    camera = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    back = np.array([[1 / fx, 0.0, -cx / fx], [0.0, 1 / fy, -cy / fy], [0.0, 0.0, 1.0]])
    return camera @ motion @ back
