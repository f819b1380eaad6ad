"""Drawing of shaded meshes, textured quadrilaterals and sprites, with exact instance ids."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.camera import NEAR_PLANE_M, Camera
from cable_rpc.data.synthetic.mesh import Mesh
from cable_rpc.data.synthetic.road import Pose
from cable_rpc.data.synthetic.scenario import Light

FloatArray = npt.NDArray[np.float64]
UInt8Array = npt.NDArray[np.uint8]
Int32Array = npt.NDArray[np.int32]

SUBPIXEL_BITS = 4
SUBPIXEL = 1 << SUBPIXEL_BITS
SILHOUETTE_SIDE = 160


@dataclass(slots=True)
class Target:
    """The picture being painted, far objects first."""

    image: UInt8Array
    """uint8 [H, W, 3], BGR."""
    ids: Int32Array
    """int32 [H, W], 0 where no road user is seen."""
    camera: Camera
    light: Light
    ego: Pose


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of the image, drawn at `scale` times its resolution."""

    x0: int
    y0: int
    x1: int
    y1: int
    scale: int

    def pixels(self, points: FloatArray) -> Int32Array:
        """Image points [..., 2] to fixed-point positions in the enlarged window."""
        shifted = (points - np.array([self.x0 - 0.5, self.y0 - 0.5])) * self.scale - 0.5
        return np.clip(np.round(shifted * SUBPIXEL), -(2**20), 2**20).astype(np.int32)

    def blank(self) -> UInt8Array:
        """An empty buffer of the enlarged size, uint8 [h, w, 4]: colour and coverage."""
        height, width = (self.y1 - self.y0) * self.scale, (self.x1 - self.x0) * self.scale
        return np.zeros((height, width, 4), np.uint8)


def window_around(target: Target, points: FloatArray, scale: int, margin: float = 1.5) -> Window | None:
    """The part of the image that holds all points [N, 2], or None where it is empty."""
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    x0, y0 = max(0, math.floor(low[0])), max(0, math.floor(low[1]))
    x1 = min(target.camera.width, math.ceil(high[0]) + 1)
    y1 = min(target.camera.height, math.ceil(high[1]) + 1)
    if x0 >= x1 or y0 >= y1:
        return None
    return Window(x0, y0, x1, y1, scale)


def composite(target: Target, window: Window, layer: UInt8Array, ident: int) -> int:
    """Shrink an enlarged window [h, w, 4] and lay it over the image; returns the pixels it covers."""
    size = (window.x1 - window.x0, window.y1 - window.y0)
    if window.scale > 1:
        layer = np.asarray(cv2.resize(layer, size, interpolation=cv2.INTER_AREA), np.uint8)
    colour = np.asarray(cv2.cvtColor(layer, cv2.COLOR_BGRA2BGR), np.uint8)
    coverage = np.asarray(cv2.extractChannel(layer, 3), np.uint8)
    blend(target.image[window.y0 : window.y1, window.x0 : window.x1], colour, coverage)
    covered = coverage >= 128
    target.ids[window.y0 : window.y1, window.x0 : window.x1][covered] = ident
    return int(np.count_nonzero(covered))


def blend(area: UInt8Array, premultiplied: UInt8Array, alpha: UInt8Array) -> None:
    """Lay premultiplied colour over an image area in place."""
    rest = cv2.bitwise_not(alpha)
    kept = cv2.multiply(area, cv2.merge([rest, rest, rest]), scale=1.0 / 255.0)
    area[:] = cv2.add(kept, premultiplied)


def shade(mesh: Mesh, light: Light, heading: float, view: FloatArray) -> FloatArray:
    """Colours [F, 3] of a mesh's faces; `view` [F, 3] points from the face to the eye in mesh axes."""
    cosine, sine = math.cos(heading), math.sin(heading)
    sun = light.sun_direction
    local = np.array([cosine * sun[0] + sine * sun[1], sine * sun[0] - cosine * sun[1], sun[2]])
    normals = mesh.normals
    upward = 0.5 + 0.5 * normals[:, 2:3]
    lit = np.maximum(normals @ local, 0.0)[:, None]
    received = upward * light.sky + (1.0 - upward) * light.bounce + lit * light.sun
    facing = np.clip((normals * view).sum(axis=1), 0.0, 1.0)
    mirrored = 2.0 * facing[:, None] * normals - view
    # Schlick's approximation of the reflected share; the sky mirrors above, the street below.
    fresnel = mesh.gloss * (0.09 + 0.91 * (1.0 - facing) ** 5 * 0.7)
    rise = np.clip(mirrored[:, 2:3], -0.2, 1.0)
    sky = light.horizon + np.sqrt(np.clip(rise, 0, 1)) * (light.zenith - light.horizon)
    above = np.clip(rise * 5.0 - 0.6, 0.0, 1.0)
    street = 62.0 * light.ground
    mirror = above * sky + (1.0 - above) * street
    glint = np.maximum(mirrored @ local, 0.0)[:, None] ** 24 * light.sun * 150.0
    body = mesh.colours * np.where(mesh.glow[:, None] > 0, 1.0, received)
    result: FloatArray = body * (1.0 - fresnel[:, None]) + fresnel[:, None] * mirror
    return result + mesh.gloss[:, None] * glint * (mesh.glow[:, None] == 0)


def haze(colours: FloatArray, light: Light, depth: float) -> FloatArray:
    """Aerial perspective."""
    share = 1.0 - math.exp(-max(depth, 0.0) / light.haze_m)
    return colours + share * (light.horizon - colours)


def clip_near(polygon: FloatArray) -> FloatArray:
    """The part of a camera-frame polygon [N, 3] in front of the near plane (Sutherland-Hodgman)."""
    kept: list[FloatArray] = []
    for index in range(len(polygon)):
        a, b = polygon[index - 1], polygon[index]
        inside_a, inside_b = a[2] >= NEAR_PLANE_M, b[2] >= NEAR_PLANE_M
        if inside_a != inside_b:
            kept.append(a + (NEAR_PLANE_M - a[2]) / (b[2] - a[2]) * (b - a))
        if inside_b:
            kept.append(b)
    return np.array(kept).reshape(-1, 3)


def draw_mesh(target: Target, mesh: Mesh, pose: Pose, ident: int = 0) -> float:
    """Draw a mesh that stands on the ground at a world pose.

    Returns:
        The area in pixels of its whole projection, including what is outside the image.
    """
    world = pose.to_world(mesh.vertices)
    local = target.ego.to_local(world)
    points = target.camera.to_camera(local)
    if points[:, 2].max() <= NEAR_PLANE_M:
        return 0.0
    eye = pose.to_local(np.array([[target.ego.x, target.ego.y, target.camera.mount_height_m]]))[0]
    to_eye = eye - mesh.centres
    distance = np.linalg.norm(to_eye, axis=1)
    view = to_eye / np.maximum(distance, 1e-6)[:, None]
    visible = (mesh.normals * view).sum(axis=1) > 0.0
    # A face below about half a pixel only costs time.
    visible &= (mesh.layers == 0) | (mesh.sizes * target.camera.intrinsics.fx > 0.6 * distance)
    nearest = float(np.median(points[:, 2]))
    colours = np.clip(haze(shade(mesh, target.light, pose.heading, view), target.light, nearest), 0, 255)
    rank = order(mesh, eye, distance)
    chosen = rank[visible[rank]]
    straddles = bool(points[:, 2].min() < NEAR_PLANE_M)
    polygons = []
    if straddles:
        chosen_list = []
        for face in chosen:
            clipped = clip_near(points[mesh.face(int(face))])
            if len(clipped) >= 3:
                polygons.append(target.camera.image_points(clipped))
                chosen_list.append(face)
        chosen = np.array(chosen_list, dtype=np.int64)
    else:
        pixels = target.camera.image_points(points)
        polygons = [pixels[mesh.face(int(face))] for face in chosen]
    if not polygons:
        return 0.0
    corners = np.vstack(polygons)
    corners = np.clip(corners, -4000.0, 8000.0)
    extent = float((corners.max(axis=0) - corners.min(axis=0)).max())
    scale = 4 if extent < 60 else 3 if extent < 140 else 2
    window = window_around(target, corners, scale)
    if window is None:
        return silhouette_area(polygons, corners)
    layer = window.blank()
    fixed = window.pixels(corners)
    bounds = np.cumsum([0, *map(len, polygons)])
    paint = np.column_stack([colours, np.full(len(colours), 255.0)])[chosen].tolist()
    for index, colour in enumerate(paint):
        polygon = fixed[bounds[index] : bounds[index + 1]]
        cv2.fillConvexPoly(layer, polygon, colour, cv2.LINE_8, SUBPIXEL_BITS)
    covered = composite(target, window, layer, ident)
    if not ident:
        return 0.0
    if inside_image(target.camera, corners):
        return float(covered)
    return silhouette_area(polygons, corners)


def inside_image(camera: Camera, points: FloatArray) -> bool:
    """Whether all points lie inside the image."""
    low, high = points.min(axis=0), points.max(axis=0)
    return bool(low.min() >= 0 and high[0] <= camera.width - 1 and high[1] <= camera.height - 1)


def silhouette_area(polygons: list[FloatArray], corners: FloatArray) -> float:
    """Area of the union of polygons, counted on a small grid."""
    low = corners.min(axis=0)
    extent = np.maximum(corners.max(axis=0) - low, 1e-3)
    factor = SILHOUETTE_SIDE / float(extent.max())
    size = np.ceil(extent * factor).astype(int) + 1
    grid = np.zeros((size[1], size[0]), np.uint8)
    for polygon in polygons:
        fixed = np.round((np.clip(polygon, -4000, 8000) - low) * factor * SUBPIXEL).astype(np.int32)
        cv2.fillConvexPoly(grid, fixed, 255, cv2.LINE_8, SUBPIXEL_BITS)
    return float(np.count_nonzero(grid)) / factor**2


def order(mesh: Mesh, eye: FloatArray, distance: FloatArray) -> npt.NDArray[np.int64]:
    """Painter's order of the faces: parts from far to near, then layers, then faces from far to near."""
    part_distance = np.linalg.norm(mesh.part_centres - eye, axis=1)
    place = np.empty(len(part_distance), np.int64)
    place[np.argsort(-part_distance)] = np.arange(len(part_distance))
    return np.lexsort((-distance, mesh.layers, place[mesh.parts]))
