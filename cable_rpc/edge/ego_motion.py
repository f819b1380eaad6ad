"""Ego-motion between two frames, and the warp of mask and frame that it predicts (paper, section II)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.types import BoolMask, CameraIntrinsics, EgoMotion

Homography = npt.NDArray[np.float64]
GreyImage = npt.NDArray[np.uint8]


def identity_homography() -> Homography:
    """float64 [3, 3] that moves nothing."""
    return np.eye(3, dtype=np.float64)


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


@dataclass(frozen=True, slots=True)
class EgoStep:
    """What the vehicle did between two frames."""

    homography: Homography = field(default_factory=identity_homography)
    """float64 [3, 3], earlier frame's pixels to later frame's."""
    displacement_m: float = 0.0
    """Length of the way driven, at least 0."""
    yaw_change_deg: float = 0.0
    """Absolute heading change, summed over the frames of the step."""

    def then(self, following: EgoStep) -> EgoStep:
        """This step and the one after it, as one."""
        # A shift can overflow at standstill (epsilon); the warp takes any such matrix for "out of the frame".
        with np.errstate(over="ignore", invalid="ignore"):
            homography = following.homography @ self.homography
        return EgoStep(
            homography,
            self.displacement_m + following.displacement_m,
            self.yaw_change_deg + following.yaw_change_deg,
        )


def ego_step(ego: EgoMotion | None, intrinsics: CameraIntrinsics | None, dt_s: float, config: RoiConfig) -> EgoStep:
    """The step of ``dt_s`` seconds that ends at a frame with the given ego-motion."""
    fx = None if intrinsics is None else intrinsics.fx
    homography = translation_homography(ego, dt_s, fx, config.epsilon_m)
    if ego is None:
        return EgoStep(homography)
    displacement_m = math.hypot(ego.speed_mps, ego.lateral_mps) * dt_s
    return EgoStep(homography, displacement_m, abs(math.degrees(ego.yaw_rate_radps * dt_s)))


def horizontal_shift(homography: Homography) -> float | None:
    """Pixels to the right if the homography is a pure horizontal translation, else None."""
    moved = homography.copy()
    moved[0, 2] = 0.0
    return float(homography[0, 2]) if np.array_equal(moved, np.eye(3)) else None


def warp_mask(mask: BoolMask, homography: Homography) -> BoolMask:
    """W(M, H) with nearest neighbour and an empty border.

    Args:
        mask: bool [height, width].
        homography: float64 [3, 3], source to destination.

    Returns:
        bool [height, width]; the argument itself where nothing moves, so don't write into it. Empty where
        the homography has a non-finite entry.
    """
    shift = horizontal_shift(homography)
    if shift == 0:
        return mask
    warped = np.zeros_like(mask)
    height, width = mask.shape
    if shift is None:
        if np.isfinite(homography).all():
            cv2.warpPerspective(
                mask.view(np.uint8),
                homography,
                (width, height),
                dst=warped.view(np.uint8),
                flags=cv2.INTER_NEAREST,
            )
        return warped
    if not abs(shift) < width + 1:
        return warped
    columns = math.ceil(shift - 0.5)
    if columns >= 0:
        warped[:, columns:] = mask[:, : max(width - columns, 0)]
    else:
        warped[:, :columns] = mask[:, -columns:]
    return warped


def warp_frame(grey: GreyImage, homography: Homography) -> tuple[GreyImage, BoolMask | None]:
    """W(I, H) with bilinear interpolation, and where it is defined.

    Args:
        grey: uint8 [height, width].
        homography: float64 [3, 3], source to destination.

    Returns:
        The warped image (the argument itself where nothing moves) and a bool [height, width] that is True
        where the source position lies inside the source image; None in its place says "everywhere".
    """
    shift = horizontal_shift(homography)
    if shift == 0:
        return grey, None
    if shift is not None:
        return shift_frame(grey, shift)
    height, width = grey.shape
    if not np.isfinite(homography).all():
        return np.zeros_like(grey), np.zeros(grey.shape, np.bool_)
    size = (width, height)
    warped = cv2.warpPerspective(grey, homography, size, flags=cv2.INTER_LINEAR)
    # Interpolated from inside only, an all-white image stays white; the border's zeros dim it.
    white = cv2.warpPerspective(np.full_like(grey, 255), homography, size, flags=cv2.INTER_LINEAR)
    return warped.astype(np.uint8, copy=False), white == 255


def shift_frame(grey: GreyImage, shift_px: float) -> tuple[GreyImage, BoolMask]:
    """Move an image to the right by a real number of pixels; returns the image and where it is defined."""
    width = grey.shape[1]
    warped = np.zeros_like(grey)
    valid = np.zeros(grey.shape, np.bool_)
    if not abs(shift_px) < width:
        return warped, valid
    whole = math.floor(shift_px)
    fraction = shift_px - whole
    # Column x takes (1 - fraction) of source column x - whole and fraction of the one to its left.
    first = max(whole + (fraction > 0), 0)
    last = min(width, width + whole)
    if first >= last:
        return warped, valid
    right = grey[:, first - whole : last - whole]
    if fraction > 0:
        left = grey[:, first - whole - 1 : last - whole - 1]
        cv2.addWeighted(right, 1.0 - fraction, left, fraction, 0.0, dst=warped[:, first:last])
    else:
        warped[:, first:last] = right
    valid[:, first:last] = True
    return warped, valid
