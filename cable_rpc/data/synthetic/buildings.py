"""Buildings: textured upright walls, and pitched roofs for houses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.camera import Camera
from cable_rpc.data.synthetic.facades import TEXELS_PER_M, Texture
from cable_rpc.data.synthetic.mesh import Mesh, MeshBuilder
from cable_rpc.data.synthetic.occlusion import Occlusion
from cable_rpc.data.synthetic.raster import Target, Window, blend, draw_mesh, mark, window_around
from cable_rpc.data.synthetic.road import Pose
from cable_rpc.data.synthetic.shadows import ShadowLayer

FloatArray = npt.NDArray[np.float64]

NEAREST_WALL_M = 1.0
SHADOW_REACH_M = 40.0
PARTY_GAP_M = 0.1
PARTY_STEP_M = 0.1


@dataclass(frozen=True, slots=True)
class Wall:
    """An upright rectangle from `start` to `stop` (world x, y), seen from outside with start on the left."""

    start: FloatArray
    stop: FloatArray
    texture: Texture
    normal: FloatArray = field(init=False)
    """Outward unit normal in the ground plane."""
    plane: tuple[float, float, float] = field(init=False)
    """The normal and the distance of its line from the origin, metres."""

    def __post_init__(self) -> None:
        along = self.stop - self.start
        normal = np.array([along[1], -along[0]]) / float(np.linalg.norm(along))
        object.__setattr__(self, "normal", normal)
        object.__setattr__(self, "plane", (float(normal[0]), float(normal[1]), float(normal @ self.start)))

    def faces(self, ego: Pose) -> bool:
        """Whether its outside is turned to the ego vehicle."""
        nx, ny, offset = self.plane
        return nx * ego.x + ny * ego.y - offset > 0.05


def visible_span(x0: float, z0: float, x1: float, z1: float, half_tangent: float) -> tuple[float, float]:
    """The part u0..u1 of a base line, right and depth in metres, inside the horizontal field of view."""
    low, high = 0.0, 1.0
    for value0, value1 in (
        (z0 - NEAREST_WALL_M, z1 - NEAREST_WALL_M),
        (half_tangent * z0 - x0, half_tangent * z1 - x1),
        (half_tangent * z0 + x0, half_tangent * z1 + x1),
    ):
        if value0 < 0 and value1 < 0:
            return 1.0, 0.0
        if value0 < 0:
            low = max(low, value0 / (value0 - value1))
        elif value1 < 0:
            high = min(high, value0 / (value0 - value1))
    return low, high


@dataclass(frozen=True, slots=True)
class WallView:
    """The part of a wall inside the field of view."""

    wall: Wall
    low: float
    high: float
    pixels: FloatArray
    """Corners [4, 2] in the image, from the top left clockwise."""
    depth: float


def view_wall(target: Target, wall: Wall) -> WallView | None:
    """How a wall is seen, None where it is not."""
    camera, ego = target.camera, target.ego
    if not wall.faces(ego):
        return None
    cosine, sine = math.cos(ego.heading), math.sin(ego.heading)
    down, level = math.sin(camera.pitch_down_rad), math.cos(camera.pitch_down_rad)
    mount, k = camera.mount_height_m, camera.intrinsics
    (ax, ay), (bx, by) = wall.start.tolist(), wall.stop.tolist()
    ahead0, ahead1 = cosine * (ax - ego.x) + sine * (ay - ego.y), cosine * (bx - ego.x) + sine * (by - ego.y)
    right0, right1 = sine * (ax - ego.x) - cosine * (ay - ego.y), sine * (bx - ego.x) - cosine * (by - ego.y)
    half = camera.width / (2.0 * k.fx) * 1.15 + 0.03
    low, high = visible_span(right0, level * ahead0 + down * mount, right1, level * ahead1 + down * mount, half)
    if high - low < 1e-4:
        return None
    corners, depths = [], 0.0
    for share, up in ((low, wall.texture.height_m), (high, wall.texture.height_m), (high, 0.0), (low, 0.0)):
        ahead, right = ahead0 + share * (ahead1 - ahead0), right0 + share * (right1 - right0)
        depth = level * ahead + down * (mount - up)
        below = level * (mount - up) - down * ahead
        inverse = 1.0 / max(depth, 1e-6)
        corners.append((k.fx * right * inverse + k.cx, k.fy * below * inverse + k.cy))
        depths += depth
    return WallView(wall, low, high, np.array(corners), depths / 4.0)


def draw_wall(target: Target, view: WallView) -> None:
    """Draw one wall, lit and hazed."""
    pixels, low, high, texture = view.pixels, view.low, view.high, view.wall.texture
    window = window_around(target, pixels, 1)
    if window is None:
        return
    span_m = (high - low) * texture.width_m
    across = span_m * TEXELS_PER_M / max(float(np.ptp(pixels[:, 0])), 0.5)
    tallest = max(abs(float(pixels[3, 1] - pixels[0, 1])), abs(float(pixels[2, 1] - pixels[1, 1])), 0.5)
    down = texture.height_m * TEXELS_PER_M / tallest
    picture = texture.level(round(math.log2(max(across, 1.0))), round(math.log2(max(down, 1.0))))
    height, width = picture.shape[:2]
    source = np.array([[low * width, 0], [high * width, 0], [high * width, height], [low * width, height]])
    # Texel and pixel centres lie at integers, areas begin half a unit before.
    destination = pixels - np.array([window.x0, window.y0])
    matrix = cv2.getPerspectiveTransform((source - 0.5).astype(np.float32), destination.astype(np.float32))
    size = (window.x1 - window.x0, window.y1 - window.y0)
    warped = cv2.warpPerspective(picture, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    finish(target, window, np.asarray(warped, np.uint8), pixels, view.wall.normal, view.depth)


def finish(
    target: Target, window: Window, warped: npt.NDArray[np.uint8], pixels: FloatArray, normal: FloatArray, depth: float
) -> None:
    """Light the warped picture, fade it into the haze, cut it to the wall's outline and lay it down."""
    light = target.light
    lit = max(0.0, float(normal @ light.sun_direction[:2]))
    received = light.sky * 0.62 + light.bounce * 0.38 + light.sun * lit
    share = 1.0 - math.exp(-depth / light.haze_m)
    lit_picture = cv2.transform(warped, np.column_stack([np.diag(received * (1.0 - share)), light.horizon * share]))
    mask = np.zeros((window.y1 - window.y0, window.x1 - window.x0), np.uint8)
    cv2.fillConvexPoly(mask, window.pixels(pixels), 255, cv2.LINE_AA, 4)
    weight = cv2.cvtColor(mask, cv2.COLOR_GRAY2BGR)
    colour = cv2.multiply(lit_picture, weight, dst=weight, scale=1.0 / 255.0)
    blend(target.image[window.y0 : window.y1, window.x0 : window.x1], np.asarray(colour, np.uint8), mask)
    mark(target, window, mask, 0)


def hide_party_wall(one: Building, other: Building, gap_m: float) -> None:
    """Drop an end wall that a neighbour of at least its height and depth covers.

    Args:
        one: The building whose wall may go.
        other: The neighbour.
        gap_m: Gap between the two, metres.
    """
    if gap_m > PARTY_GAP_M or other.height < one.height:
        return
    middle, local = other.outline.mean(axis=0), other.pose.to_local(one.outline)
    # Standing farther out than the neighbour leaves a strip of the wall in sight.
    if local[:, 0].max() > PARTY_STEP_M:
        return
    ends = one.walls[1], one.walls[2]
    hidden = max(ends, key=lambda wall: float(wall.normal @ (middle - wall.start)))
    one.walls = tuple(wall for wall in one.walls if wall is not hidden)


@dataclass(slots=True)
class Building:
    """Walls around a footprint; for a house also a roof mesh."""

    s: float
    walls: tuple[Wall, ...]
    outline: FloatArray
    """Footprint [4, 2], world."""
    height: float
    roof: Mesh | None
    pose: Pose

    @property
    def anchor(self) -> tuple[float, float, float]:
        """World x and y, and the distance in metres within which it is seen."""
        x, y = self.outline.mean(axis=0).tolist()
        return x, y, float(np.hypot(*(self.outline - self.outline.mean(axis=0)).T).max())

    @property
    def shadow_reach(self) -> float:
        """How far its shadow may fall, metres."""
        return SHADOW_REACH_M

    def distance(self, ego: Pose, camera: Camera) -> float | None:
        """Distance of the farthest corner, since whatever stands before the walls is nearer than that."""
        local = ego.to_local(self.outline)
        half = camera.width / (2.0 * camera.intrinsics.fx) * 1.05
        aside = (np.abs(local[:, 1]) > half * local[:, 0]).all() and len(set(np.sign(local[:, 1]))) == 1
        if aside or local[:, 0].max() < NEAREST_WALL_M:
            return None
        return float(np.hypot(local[:, 0], local[:, 1]).max())

    def shadow(self, shadows: ShadowLayer) -> None:
        """The building's cast shadow."""
        if not shadows.outside(self.pose, SHADOW_REACH_M):
            shadows.throw(self.outline, 0.0, self.height)

    @property
    def space(self) -> tuple[FloatArray, float]:
        """Footprint [4, 2], world metres, and height that hold all of it."""
        middle = self.outline.mean(axis=0)
        if self.roof is None:
            return self.outline, self.height
        return middle + (self.outline - middle) * 1.25, float(self.roof.corners[2].max())

    def prepare(self, target: Target, occlusion: Occlusion) -> Callable[[], None]:
        """Find the walls in sight, add them to what is covered; returns what draws them."""
        views: list[WallView] = []
        for wall in reversed(self.walls):
            view = view_wall(target, wall)
            if view is None:
                continue
            (x0, y0), (x1, y1) = view.pixels.min(axis=0).tolist(), view.pixels.max(axis=0).tolist()
            if not occlusion.hides((x0 - 3.0, y0 - 3.0, x1 + 3.0, y1 + 3.0)):
                occlusion.cover(view.pixels)
                views.append(view)
        return partial(self.draw, target, views[::-1])

    def draw(self, target: Target, views: list[WallView]) -> None:
        """Walls, then the roof."""
        for view in views:
            draw_wall(target, view)
        if self.roof is not None:
            draw_mesh(target, self.roof, self.pose)


def build_building(
    s: float,
    pose: Pose,
    width: float,
    depth: float,
    front: Texture,
    end: Texture,
    back: Texture,
    roof: FloatArray | None,
) -> Building:
    """A building whose front is centred on `pose`, which looks out to the street.

    The pose's forward axis is the front's outward normal; its right axis runs along the front.
    """
    half = width / 2
    local = np.array([[0.0, half], [0.0, -half], [-depth, -half], [-depth, half]])
    outline = pose.to_world(local)
    walls = tuple(
        Wall(outline[a], outline[b], texture)
        for a, b, texture in ((2, 3, back), (1, 2, end), (3, 0, end), (0, 1, front))
    )
    mesh = build_roof(half, depth, front.height_m, roof) if roof is not None else None
    return Building(s, walls, outline, front.height_m, mesh, pose)


def build_roof(half: float, depth: float, eaves: float, colour: FloatArray) -> Mesh:
    """A hipped roof with courses of tiles."""
    builder = MeshBuilder(centre=np.array([-depth / 2, 0.0, eaves]))
    rise, over = depth * 0.36, 0.35
    low = np.array(
        [
            [over, -half - over, eaves],
            [over, half + over, eaves],
            [-depth - over, half + over, eaves],
            [-depth - over, -half - over, eaves],
        ]
    )
    inner = max(half - depth * 0.4, 0.3)
    ridge = np.array([[-depth / 2, -inner, eaves + rise], [-depth / 2, inner, eaves + rise]])
    courses = 14
    for a, b, c, d in (
        (low[0], low[1], ridge[1], ridge[0]),
        (low[2], low[3], ridge[0], ridge[1]),
        (low[1], low[2], ridge[1], ridge[1]),
        (low[3], low[0], ridge[0], ridge[0]),
    ):
        for course in range(courses):
            v0, v1 = course / courses, (course + 1) / courses
            quad = np.array([a + (d - a) * v0, b + (c - b) * v0, b + (c - b) * v1, a + (d - a) * v1])
            builder.add(quad, colour * (0.88 + 0.2 * ((course * 7) % 3) / 2))
    builder.box(
        (-depth * 0.4, half * 0.3, eaves + rise * 0.5),
        (-depth * 0.4 + 0.7, half * 0.3 + 0.7, eaves + rise + 0.9),
        colour * 0.7,
        layer=3,
    )
    return builder.build()
