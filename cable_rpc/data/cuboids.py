"""Upright 3-D boxes and their projection into a camera image."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.types import BoolMask, CameraIntrinsics, Float32Array

FloatArray = npt.NDArray[np.float64]
Distortion = Callable[[FloatArray], FloatArray]
"""Normalised image points (x / z, y / z) [M, 2] to where the lens puts them, [M, 2]."""

NEAR_PLANE_M = 0.1
SIGNS = np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)], np.float64)
EDGES = np.array([(a, b) for a in range(8) for b in range(a) if np.count_nonzero(SIGNS[a] != SIGNS[b]) == 1])
"""The 12 pairs of corners that differ along one axis only."""
EDGE_PARTS = 8
"""Pieces of an edge under distortion, where straight edges become curves."""
BORDER_POINTS = 9
"""Points of each side of the image whose rays tell how far a lens sees."""
LENS_STEPS = 25
BEYOND_BORDER = 0.03
"""Outlines are distorted up to this share of the view's size beyond it: lens models fold back far outside."""
WIDEST_RAY = 8.0
"""Tangent of the widest angle to the optical axis of any lens that a pinhole camera with distortion describes."""


@dataclass(frozen=True, slots=True)
class Cuboid:
    """An upright box in a right-handed frame whose z axis points up."""

    centre_m: tuple[float, float, float]
    """The middle of the box."""
    size_lwh_m: tuple[float, float, float]
    """Length, width, height."""
    yaw_rad: float
    """About +z, counter-clockwise; 0 where the length lies along +x."""
    class_id: int
    track_id: int


@dataclass(frozen=True, slots=True)
class ProjectedBoxes:
    """Boxes around projected cuboids."""

    boxes_xyxy: Float32Array
    """float32 [N, 4], around the part that lies in the image, pixels; zeros where none does."""
    inside_share: Float32Array
    """float32 [N], share of the unclipped box's area that lies in the image; 0 where nothing is before the camera."""


def cuboid_corners(cuboids: Sequence[Cuboid]) -> FloatArray:
    """Corners of upright boxes in their own frame.

    Returns:
        float64 [N, 8, 3]: front left top, front left bottom, front right top, front right bottom, then the same four
        of the rear, where x is ahead and y left of a box of yaw 0.
    """
    count = len(cuboids)
    centres = np.array([cuboid.centre_m for cuboid in cuboids], np.float64).reshape(count, 1, 3)
    sizes = np.array([cuboid.size_lwh_m for cuboid in cuboids], np.float64).reshape(count, 1, 3)
    yaws = np.array([cuboid.yaw_rad for cuboid in cuboids], np.float64)
    turn = np.zeros((count, 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(yaws)
    turn[:, 1, 0] = np.sin(yaws)
    turn[:, 0, 1] = -turn[:, 1, 0]
    turn[:, 2, 2] = 1.0
    corners: FloatArray = (SIGNS * sizes / 2) @ turn.transpose(0, 2, 1) + centres
    return corners


def project_corners(
    corners: FloatArray,
    camera_from_frame: FloatArray,
    intrinsics: CameraIntrinsics,
    size_wh: tuple[int, int],
    distort: Distortion | None = None,
) -> ProjectedBoxes:
    """Boxes around the part of each cuboid that the camera can see, occlusion aside.

    Edges are cut at a near plane of 0.1 m, so what is behind the camera never shows up mirrored, and the outline is
    cut at the image's border before it is bounded, as the nuScenes devkit does it (export_2d_annotations_as_json).

    Args:
        corners: float64 [N, 8, 3], metres, in the order of `cuboid_corners`.
        camera_from_frame: float64 [4, 4], from the corners' frame to optical axes (x right, y down, z forward).
        intrinsics: the pinhole part of the camera.
        size_wh: (width, height) of the image in pixels.
        distort: the lens; None for a rectified image. The share inside is then that of the undistorted outline inside
            the rectangle around all that the lens sees.
    """
    points = corners @ camera_from_frame[:3, :3].T + camera_from_frame[:3, 3]
    boxes = np.zeros((len(corners), 4), np.float32)
    shares = np.zeros(len(corners), np.float32)
    image = np.array([(0.0, 0.0), size_wh])
    view = image if distort is None else lens_view(distort, intrinsics, size_wh)
    for row in np.flatnonzero(~out_of_sight(points, intrinsics, view)).tolist():
        edges = cut_near(points[row][EDGES]).reshape(-1, 3)
        pixels = to_pixels(edges[:, :2] / edges[:, 2:], intrinsics)
        shares[row] = share_inside(pixels, view)
        hull = cv2.convexHull(pixels.astype(np.float32))[:, 0].astype(np.float64)
        seen = clip_polygon(hull, view)
        if distort is not None and len(seen):
            curved = distort(to_rays(subdivided(seen), intrinsics))
            seen = clip_polygon(to_pixels(curved, intrinsics), image)
        if len(seen):
            boxes[row] = (*seen.min(axis=0), *seen.max(axis=0))
    return ProjectedBoxes(boxes, shares)


def out_of_sight(points: FloatArray, intrinsics: CameraIntrinsics, view: FloatArray) -> BoolMask:
    """Which of the corner sets [N, 8, 3], optical axes, lie behind the camera or beyond one side of a view [2, 2]."""
    depth = points[..., 2]
    hidden: BoolMask = depth.max(axis=1) < NEAR_PLANE_M
    for axis, (focal, middle) in enumerate(((intrinsics.fx, intrinsics.cx), (intrinsics.fy, intrinsics.cy))):
        # Pixels times depth, which holds on both sides of the camera.
        scaled = points[..., axis] * focal + middle * depth
        low, high = view[:, axis]
        hidden |= ((scaled - low * depth).max(axis=1) < 0) | ((scaled - high * depth).min(axis=1) > 0)
    return hidden


def lens_view(distort: Distortion, intrinsics: CameraIntrinsics, size_wh: tuple[int, int]) -> FloatArray:
    """What a lens sees, as pixels of a pinhole camera: corners [2, 2] of the rectangle around it, slightly enlarged.

    The rays of the image's border are found by fixed-point iteration, as OpenCV's undistortPoints does it.
    """
    along = np.linspace(0.0, 1.0, BORDER_POINTS)
    sides = [np.stack([along, np.full_like(along, end)], axis=1) for end in (0.0, 1.0)]
    border = to_rays(np.vstack([*sides, *(side[:, ::-1] for side in sides)]) * size_wh, intrinsics)
    rays = border
    for _ in range(LENS_STEPS):
        rays = np.clip(rays + border - distort(rays), -WIDEST_RAY, WIDEST_RAY)
    pixels = to_pixels(rays, intrinsics)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margin = BEYOND_BORDER * (high - low)
    return np.stack([low - margin, high + margin])


def cut_near(edges: FloatArray) -> FloatArray:
    """Edges [E, 2, 3] in optical axes, without what lies behind the near plane; [F, 2, 3] with F <= E."""
    ahead = edges[..., 2] >= NEAR_PLANE_M
    kept = edges[ahead.any(axis=1)]
    # Where both ends are ahead nothing moves; elsewhere the far side of the cut takes the place of the hidden end.
    first, second = kept[:, 0], kept[:, 1]
    crossing = (NEAR_PLANE_M - first[:, 2]) / np.where(first[:, 2] == second[:, 2], 1.0, second[:, 2] - first[:, 2])
    cut = first + crossing[:, None] * (second - first)
    behind = kept[..., 2:] < NEAR_PLANE_M
    result: FloatArray = np.where(behind, cut[:, None], kept)
    result[..., 2] = np.maximum(result[..., 2], NEAR_PLANE_M)
    return result


def to_pixels(rays: FloatArray, intrinsics: CameraIntrinsics) -> FloatArray:
    """Normalised image points [M, 2] to pixels [M, 2]."""
    pixels: FloatArray = rays * (intrinsics.fx, intrinsics.fy) + (intrinsics.cx, intrinsics.cy)
    return pixels


def to_rays(pixels: FloatArray, intrinsics: CameraIntrinsics) -> FloatArray:
    """Pixels [M, 2] to normalised image points [M, 2]."""
    rays: FloatArray = (pixels - (intrinsics.cx, intrinsics.cy)) / (intrinsics.fx, intrinsics.fy)
    return rays


def subdivided(polygon: FloatArray) -> FloatArray:
    """A polygon [N, 2] with further points along its sides, [M, 2]."""
    along = np.arange(EDGE_PARTS)[:, None] / EDGE_PARTS
    following = np.roll(polygon, -1, axis=0)
    points: FloatArray = (polygon[:, None] + along * (following - polygon)[:, None]).reshape(-1, 2)
    return points


def share_inside(pixels: FloatArray, view: FloatArray) -> float:
    """Share of the area of the box around points [M, 2] that lies in a rectangle [2, 2], 0..1."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    area = float(np.prod(high - low))
    common = np.minimum(high, view[1]) - np.maximum(low, view[0])
    return float(np.prod(np.maximum(common, 0.0))) / area if area > 0 and math.isfinite(area) else 0.0


def clip_polygon(polygon: FloatArray, bounds: FloatArray) -> FloatArray:
    """The part of a polygon [N, 2] inside a rectangle [2, 2] (Sutherland and Hodgman), [M, 2], M = 0 where none is."""
    for axis, end in ((0, 0), (0, 1), (1, 0), (1, 1)):
        bound, inward = float(bounds[end, axis]), 1.0 - 2.0 * end
        distance = inward * (polygon[:, axis] - bound)
        kept: list[FloatArray] = []
        for index in range(len(polygon)):
            before, here = float(distance[index - 1]), float(distance[index])
            if (before < 0) != (here < 0):
                cut = polygon[index - 1] + before / (before - here) * (polygon[index] - polygon[index - 1])
                cut[axis] = bound
                kept.append(cut)
            if here >= 0:
                kept.append(polygon[index])
        polygon = np.array(kept).reshape(-1, 2)
        if not len(polygon):
            break
    return polygon
