"""Drawing of shaded meshes, textured quadrilaterals and sprites, with exact instance ids."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

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
IntArray = npt.NDArray[np.int64]

SUBPIXEL_BITS = 4
SUBPIXEL = 1 << SUBPIXEL_BITS
SILHOUETTE_SIDE = 160
LEAST_FACE_PIXELS = 1.3
FAR_M = 40.0
FAINT_GLOSS = 0.25
FARTHEST = 2.0**20
CLOSE_M = 3.0


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
    windows: dict[int, Window] = field(default_factory=dict)
    """Where each identity was drawn."""


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
        factor = self.scale * SUBPIXEL
        shift = 0.5 * factor - 0.5 * SUBPIXEL
        fixed = points * factor
        fixed += (shift - self.x0 * factor, shift - self.y0 * factor)
        np.rint(fixed, out=fixed)
        np.maximum(fixed, -FARTHEST, out=fixed)
        np.minimum(fixed, FARTHEST, out=fixed)
        return fixed.astype(np.int32)

    def blank(self) -> UInt8Array:
        """An empty buffer of the enlarged size, uint8 [h, w, 4]: colour and coverage."""
        height, width = (self.y1 - self.y0) * self.scale, (self.x1 - self.x0) * self.scale
        return np.zeros((height, width, 4), np.uint8)


def window_around(target: Target, points: FloatArray, scale: int, margin: float = 1.5) -> Window | None:
    """The part of the image that holds all points [N, 2], or None where it is empty."""
    (left, top), (right, bottom) = points.min(axis=0), points.max(axis=0)
    return window_between(target, (float(left), float(top)), (float(right), float(bottom)), scale, margin)


def window_between(
    target: Target, low: tuple[float, float], high: tuple[float, float], scale: int, margin: float = 1.5
) -> Window | None:
    """The part of the image between two corners (x, y), or None where it is empty."""
    x0, y0 = max(0, math.floor(low[0] - margin)), max(0, math.floor(low[1] - margin))
    x1 = min(target.camera.width, math.ceil(high[0] + margin) + 1)
    y1 = min(target.camera.height, math.ceil(high[1] + margin) + 1)
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
    return mark(target, window, coverage, ident)


def mark(target: Target, window: Window, coverage: UInt8Array, ident: int) -> int:
    """Set the identity where at least half of a pixel is covered; returns the number of such pixels."""
    if not ident and not target.windows:
        return 0
    covered = coverage >= 128
    if ident:
        target.windows[ident] = window
    np.copyto(target.ids[window.y0 : window.y1, window.x0 : window.x1], ident, where=covered)
    return int(np.count_nonzero(covered)) if ident else 0


def blend(area: UInt8Array, premultiplied: UInt8Array, alpha: UInt8Array) -> None:
    """Lay premultiplied colour over an image area in place."""
    rest = cv2.cvtColor(cv2.bitwise_not(alpha), cv2.COLOR_GRAY2BGR)
    cv2.add(cv2.multiply(area, rest, dst=rest, scale=1.0 / 255.0), premultiplied, dst=area)


def shade(
    mesh: Mesh, faces: IntArray, light: Light, heading: float, view: FloatArray, least_gloss: float = 0.0
) -> FloatArray:
    """Colours [N, 3] of the given faces [N]; `view` [N, 3] points from the face to the eye in mesh axes.

    Where no face has more than `least_gloss`, reflections are left out.
    """
    cosine, sine = math.cos(heading), math.sin(heading)
    sun = light.sun_direction
    local = np.array([cosine * sun[0] + sine * sun[1], sine * sun[0] - cosine * sun[1], sun[2]])
    normals, gloss, dull = mesh.normals[faces], mesh.gloss[faces], mesh.glow[faces, None] == 0
    upward = 0.5 + 0.5 * normals[:, 2:3]
    lit = np.maximum(normals @ local, 0.0)[:, None]
    received = light.bounce + upward * (light.sky - light.bounce) + lit * light.sun
    body = mesh.colours[faces] * np.where(dull, received, 1.0)
    if gloss.max() <= least_gloss:
        return np.asarray(body)
    facing = np.clip(np.einsum("ij,ij->i", normals, view), 0.0, 1.0)
    mirrored = (2.0 * facing)[:, None] * normals - view
    # Schlick's approximation of the reflected share; the sky mirrors above, the street below.
    fresnel = (gloss * (0.09 + 0.91 * 0.7 * (1.0 - facing) ** 5))[:, None]
    rise = np.clip(mirrored[:, 2:3], -0.2, 1.0)
    sky = light.horizon + np.sqrt(np.maximum(rise, 0)) * (light.zenith - light.horizon)
    above = np.clip(rise * 5.0 - 0.6, 0.0, 1.0)
    street = 62.0 * light.ground
    mirror = street + above * (sky - street)
    # Squaring thrice and then twice more beats a general power: x**24 = (x**8)**3.
    glint = np.square(np.square(np.square(np.maximum(mirrored @ local, 0.0))))
    glint = (glint * glint * glint * gloss * 150.0)[:, None] * dull
    result: FloatArray = body + fresnel * (mirror - body) + glint * light.sun
    return result


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


def object_axes(target: Target, pose: Pose) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotation [3, 3] and origin [3] from object to camera axes, and the eye [3] in object axes."""
    ego, camera = target.ego, target.camera
    turned = pose.heading - ego.heading
    cosine, sine = math.cos(turned), math.sin(turned)
    ego_cos, ego_sin = math.cos(ego.heading), math.sin(ego.heading)
    dx, dy = pose.x - ego.x, pose.y - ego.y
    forward, right = ego_cos * dx + ego_sin * dy, ego_sin * dx - ego_cos * dy
    turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    origin = camera.vehicle_to_camera @ np.array([forward, right, -camera.mount_height_m])
    eye = np.array([-cosine * forward + sine * right, -sine * forward - cosine * right, camera.mount_height_m])
    return camera.vehicle_to_camera @ turn, origin, eye


def draw_mesh(target: Target, mesh: Mesh, pose: Pose, ident: int = 0) -> float:
    """Draw a mesh that stands on the ground at a world pose.

    Returns:
        The area in pixels of its whole projection, including what is outside the image; 0 where all is outside.
    """
    rotation, origin, eye = object_axes(target, pose)
    camera = target.camera
    # Coordinates by rows: extremes along contiguous memory are many times faster.
    across, down, depths = rotation @ mesh.corners + origin[:, None]
    nearest = float(depths.min())
    k = camera.intrinsics
    if nearest < CLOSE_M:
        # The part before the near plane is a cone: outside when all of it lies beyond one of its sides.
        half = camera.width / (2.0 * k.fx) + 0.01
        if depths.max() <= NEAR_PLANE_M or (across > half * depths).all() or (across < -half * depths).all():
            return 0.0
    # A detail of about a pixel only costs time.
    least = LEAST_FACE_PIXELS * max(nearest, NEAR_PLANE_M) / camera.intrinsics.fx
    faces = np.flatnonzero((mesh.normals @ eye > mesh.offsets) & (mesh.sizes > least))
    if not len(faces):
        return 0.0
    to_eye = eye - mesh.centres[faces]
    distance = np.sqrt(np.einsum("ij,ij->i", to_eye, to_eye))
    rank = order(mesh, faces, eye, distance)
    faces = faces[rank]
    spans = [mesh.spans[face] for face in faces.tolist()]
    if nearest < NEAR_PLANE_M:
        points, behind = np.stack([across, down, depths], axis=1), depths < NEAR_PLANE_M
        clipped = [
            clip_near(points[start:stop]) if behind[start:stop].any() else points[start:stop] for start, stop in spans
        ]
        kept = [index for index, polygon in enumerate(clipped) if len(polygon) >= 3]
        if not kept:
            return 0.0
        across, down, depths = np.vstack([clipped[index] for index in kept]).T
        faces, rank = faces[kept], rank[kept]
        ends = np.cumsum([0, *(len(clipped[index]) for index in kept)]).tolist()
        spans = list(pairwise(ends))
    inverse = 1.0 / depths
    columns, rows = across * inverse * k.fx + k.cx, down * inverse * k.fy + k.cy
    if nearest < CLOSE_M:
        columns, rows = np.clip(columns, -4000.0, 8000.0), np.clip(rows, -4000.0, 8000.0)
    low, high = (float(columns.min()), float(rows.min())), (float(columns.max()), float(rows.max()))
    extent = max(high[0] - low[0], high[1] - low[1])
    window = window_between(target, low, high, 4 if extent < 40 else 3 if extent < 90 else 2)
    if window is None:
        return 0.0
    corners = np.stack([columns, rows], axis=1)
    view = to_eye[rank] / np.maximum(distance[rank], 1e-6)[:, None]
    least_gloss = FAINT_GLOSS if nearest > FAR_M else 0.0
    colours = haze(
        shade(mesh, faces, target.light, pose.heading, view, least_gloss), target.light, float(depths.mean())
    )
    paint = np.empty((len(faces), 4))
    np.clip(colours, 0, 255, out=paint[:, :3])
    paint[:, 3] = 255.0
    layer, fixed = window.blank(), window.pixels(corners)
    for (start, stop), colour in zip(spans, paint.tolist(), strict=True):
        cv2.fillConvexPoly(layer, fixed[start:stop], colour, cv2.LINE_8, SUBPIXEL_BITS)
    covered = composite(target, window, layer, ident)
    if not ident:
        return 0.0
    inside = min(low) >= 0 and high[0] <= camera.width - 1 and high[1] <= camera.height - 1
    return float(covered) if inside else silhouette_area(corners, spans)


def inside_image(camera: Camera, points: FloatArray) -> bool:
    """Whether all points lie inside the image."""
    low, high = points.min(axis=0), points.max(axis=0)
    return bool(low.min() >= 0 and high[0] <= camera.width - 1 and high[1] <= camera.height - 1)


def silhouette_area(corners: FloatArray, spans: list[tuple[int, int]]) -> float:
    """Area of the union of polygons, given as ranges of the corners [N, 2], counted on a small grid."""
    low = corners.min(axis=0)
    extent = np.maximum(corners.max(axis=0) - low, 1e-3)
    factor = SILHOUETTE_SIDE / float(extent.max())
    size = np.ceil(extent * factor).astype(int) + 1
    grid = np.zeros((size[1], size[0]), np.uint8)
    fixed = np.round((corners - low) * (factor * SUBPIXEL)).astype(np.int32)
    for start, stop in spans:
        cv2.fillConvexPoly(grid, fixed[start:stop], 255, cv2.LINE_8, SUBPIXEL_BITS)
    return float(np.count_nonzero(grid)) / factor**2


def order(mesh: Mesh, faces: IntArray, eye: FloatArray, distance: FloatArray) -> IntArray:
    """Painter's order of the faces [N]: parts from far to near, then layers, then faces from far to near."""
    to_part = mesh.part_centres - eye
    place = np.argsort(np.argsort(-np.einsum("ij,ij->i", to_part, to_part), kind="stable"), kind="stable")
    # One sort by a number whose parts don't overlap: distances stay below a kilometre, layers below sixteen.
    return np.argsort(place[mesh.parts[faces]] * 16e3 + mesh.layers[faces] * 1e3 - np.minimum(distance, 999.0))
