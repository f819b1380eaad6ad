"""Trees and bushes: pictures of many lit leaves that turn towards the camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.camera import Camera
from cable_rpc.data.synthetic.occlusion import Occlusion, square
from cable_rpc.data.synthetic.raster import Target, Window, composite
from cable_rpc.data.synthetic.road import Pose
from cable_rpc.data.synthetic.scenario import Light, bgr
from cable_rpc.data.synthetic.shadows import ShadowLayer

FloatArray = npt.NDArray[np.float64]
UInt8Array = npt.NDArray[np.uint8]

SPRITE_HEIGHT = 448
NEAREST_M = 1.5
SHADOW_REACH_M = 12.0
LEAST_PIXELS = 2.5
CIRCLE = np.array([[math.cos(math.pi * turn / 6), math.sin(math.pi * turn / 6)] for turn in range(12)])

LEAVES = (bgr(70, 100, 40), bgr(58, 92, 44), bgr(88, 104, 44), bgr(62, 84, 34), bgr(112, 104, 44), bgr(52, 84, 52))
BARK = bgr(86, 70, 56)


@dataclass(slots=True)
class Sprite:
    """A premultiplied picture [h, w, 4] with reduced copies; its foot is the middle of the lower edge."""

    levels: list[UInt8Array] = field(default_factory=list)

    @classmethod
    def of(cls, picture: UInt8Array) -> Sprite:
        """With all reductions down to a few pixels."""
        levels = [picture]
        while min(levels[-1].shape[:2]) > 6:
            height, width = levels[-1].shape[:2]
            levels.append(
                np.asarray(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8)
            )
        return cls(levels)


def paint_leaves(
    rng: np.random.Generator,
    picture: UInt8Array,
    blob: tuple[float, float, float],
    tint: FloatArray,
    light: Light,
    count: int,
) -> None:
    """A ball of leaves (x, y, radius in pixels), darker inside and below."""
    x, y, radius = blob
    angle, reach = rng.uniform(0, 2 * math.pi, count), np.sqrt(rng.uniform(0, 1, count))
    px, py = x + radius * reach * np.cos(angle), y + 0.85 * radius * reach * np.sin(angle)
    height = -np.sin(angle) * reach
    base = light.sky * 0.55 + light.bounce * 0.15
    order = np.argsort(height + rng.normal(0, 0.3, count))
    lit = np.clip(0.46 + 0.5 * height + rng.normal(0, 0.16, count), 0.06, 1.15)[:, None]
    colours = np.clip(tint * (base * (0.4 + 0.8 * lit) + light.sun * 0.85 * lit), 0, 255)
    paints = np.column_stack([colours, np.full(count, 255.0)]).tolist()
    angles = rng.uniform(0, 180, count).tolist()
    sizes = rng.uniform(4.0, 11.0, (count, 2)).tolist()
    for index in order.tolist():
        centre = (int(px[index]), int(py[index]))
        cv2.ellipse(picture, (centre, sizes[index], angles[index]), paints[index], -1)


def paint_tree(rng: np.random.Generator, light: Light) -> Sprite:
    """A broad-leaved tree."""
    height, width = SPRITE_HEIGHT, int(SPRITE_HEIGHT * 0.86)
    picture = np.zeros((height, width, 4), np.uint8)
    tint = LEAVES[int(rng.integers(len(LEAVES)))] * float(rng.uniform(0.9, 1.25))
    middle, crown = width / 2, height * float(rng.uniform(0.36, 0.42))
    shade = light.sky * 0.5 + light.sun * 0.25 + light.bounce * 0.2
    foot = width * 0.034
    for share, offset in ((0.75, 0.0), (1.05, 0.35), (0.85, -0.3)):
        trunk = np.array(
            [
                [middle - foot, height],
                [middle + foot * (0.2 + offset), height],
                [middle + foot * (offset * 0.5), crown],
                [middle - foot * 0.7, crown],
            ]
        )
        cv2.fillConvexPoly(picture, trunk.astype(np.int32), [*(BARK * shade * share).tolist(), 255.0], cv2.LINE_8)
    right = np.array([[middle, height], [middle + foot, height], [middle + foot * 0.6, crown], [middle, crown]])
    cv2.fillConvexPoly(picture, right.astype(np.int32), [*(BARK * shade * 0.8).tolist(), 255.0], cv2.LINE_8)
    for _ in range(5):
        tip = (int(middle + rng.uniform(-0.25, 0.25) * width), int(height * rng.uniform(0.2, 0.45)))
        cv2.line(picture, (int(middle), int(height * 0.55)), tip, [*(BARK * shade * 0.7).tolist(), 255.0], 5)
    blobs = []
    for _ in range(26):
        angle, reach = rng.uniform(0, 2 * math.pi), math.sqrt(rng.uniform(0, 1))
        radius = float(rng.uniform(0.10, 0.17)) * width
        blobs.append(
            (
                middle + 0.33 * width * reach * math.cos(angle),
                crown * 0.92 + 0.26 * height * reach * math.sin(angle),
                radius,
            )
        )
    blobs.sort(key=lambda blob: -blob[1] + float(rng.normal(0, 20)))
    for blob in blobs:
        depth = float(rng.uniform(0.8, 1.12))
        paint_leaves(rng, picture, blob, tint * depth, light, 85)
    return Sprite.of(picture)


def paint_bush(rng: np.random.Generator, light: Light) -> Sprite:
    """A bush or a piece of hedge."""
    picture = np.zeros((160, 240, 4), np.uint8)
    tint = LEAVES[int(rng.integers(len(LEAVES)))]
    for _ in range(16):
        x, y = float(rng.uniform(45, 195)), float(rng.uniform(55, 125))
        paint_leaves(rng, picture, (x, y, float(rng.uniform(25, 42))), tint, light, 80)
    picture[152:] = 0
    return Sprite.of(picture)


@dataclass(slots=True)
class Plant:
    """A sprite that stands at a world position."""

    s: float
    x: float
    y: float
    height: float
    sprite: Sprite
    crown: float
    """Radius of the shadow in metres."""

    @property
    def anchor(self) -> tuple[float, float, float]:
        """World x and y, and the distance in metres within which it is seen."""
        return self.x, self.y, self.height

    @property
    def shadow_reach(self) -> float:
        """How far its shadow may fall, metres."""
        return SHADOW_REACH_M

    def local(self, ego: Pose) -> tuple[float, float]:
        """Forward and right metres from the ego vehicle."""
        cosine, sine = math.cos(ego.heading), math.sin(ego.heading)
        dx, dy = self.x - ego.x, self.y - ego.y
        return cosine * dx + sine * dy, sine * dx - cosine * dy

    def distance(self, ego: Pose, camera: Camera) -> float | None:
        """Distance of the foot."""
        forward, right = self.local(ego)
        half = camera.width / (2.0 * camera.intrinsics.fx)
        if forward < NEAREST_M or abs(right) > half * forward + self.height:
            return None
        return math.hypot(forward, right)

    def shadow(self, shadows: ShadowLayer) -> None:
        """The crown's shadow and a dark foot."""
        pose = Pose(self.x, self.y, 0.0)
        if shadows.outside(pose, SHADOW_REACH_M):
            return
        place = (self.x, self.y)
        shadows.throw(CIRCLE * self.crown + place, self.height * 0.4, self.height * 0.8)
        shadows.fill(shadows.contact, CIRCLE * (self.crown * 0.3) + place, 110)

    @property
    def space(self) -> tuple[FloatArray, float]:
        """Footprint [4, 2], world metres, and height that hold all of it."""
        full = self.sprite.levels[0]
        return square(self.x, self.y, self.height * full.shape[1] / (2.0 * full.shape[0])), self.height

    def prepare(self, target: Target, occlusion: Occlusion) -> Callable[[], None]:
        """What draws it; it hides nothing behind it."""
        return partial(self.draw, target)

    def draw(self, target: Target) -> None:
        """Draw it as an upright picture that faces the camera."""
        forward, right = self.local(target.ego)
        camera, k = target.camera, target.camera.intrinsics
        sine, cosine = math.sin(camera.pitch_down_rad), math.cos(camera.pitch_down_rad)
        foot, top = camera.mount_height_m, camera.mount_height_m - self.height
        near, far = cosine * forward + sine * top, cosine * forward + sine * foot
        if min(near, far) < NEAREST_M:
            return
        foot_x = k.fx * right / far + k.cx
        foot_y = k.fy * (cosine * foot - sine * forward) / far + k.cy
        top_y = k.fy * (cosine * top - sine * forward) / near + k.cy
        tall = foot_y - top_y
        if tall < LEAST_PIXELS:
            return
        full = self.sprite.levels[0]
        level = max(0, min(round(math.log2(max(full.shape[0] / tall, 1.0)) - 0.2), len(self.sprite.levels) - 1))
        picture = self.sprite.levels[level]
        height, width = picture.shape[:2]
        scale = tall / height
        half = width * scale / 2
        x0, y0 = max(0, math.floor(foot_x - half - 1.5)), max(0, math.floor(top_y - 1.5))
        x1 = min(camera.width, math.ceil(foot_x + half + 1.5) + 1)
        y1 = min(camera.height, math.ceil(foot_y + 1.5) + 1)
        if x0 >= x1 or y0 >= y1:
            return
        window = Window(x0, y0, x1, y1, 1)
        shift = (scale - 1) / 2
        matrix = np.array([[scale, 0.0, foot_x - half + shift - x0], [0.0, scale, top_y + shift - y0]])
        size = (window.x1 - window.x0, window.y1 - window.y0)
        layer = cv2.warpAffine(picture, matrix, size, flags=cv2.INTER_LINEAR)
        share = 1.0 - math.exp(-far / target.light.haze_m)
        if share > 0.02:
            veil = np.diag([1.0 - share, 1.0 - share, 1.0 - share, 1.0])
            veil[:3, 3] = target.light.horizon * (share / 255.0)
            layer = cv2.transform(layer, veil)
        composite(target, window, np.asarray(layer, np.uint8), 0)
