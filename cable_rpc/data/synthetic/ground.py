"""The ground: world-anchored texture tiles at several resolutions, warped into the image by homography."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.camera import Camera
from cable_rpc.data.synthetic.groundpaint import GroundPainter
from cable_rpc.data.synthetic.road import Pose

FINEST_TEXEL_M = 0.015
TILE_TEXELS = 128
VISIBLE_M = 340.0
CACHED_TILES = 2400
FADED_ROWS = 40

UInt8Array = npt.NDArray[np.uint8]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(slots=True)
class Mosaic:
    """Joined tiles of one level; only `filled` ones are painted."""

    window: tuple[int, int, int, int]
    picture: UInt8Array
    filled: set[tuple[int, int]]


def meets(outline: FloatArray, x: float, y: float, side: float) -> bool:
    """Whether a convex outline [N, 2] may touch a square, by the outline's own edges as separating lines."""
    square = np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]])
    middle = outline.mean(axis=0)
    for start, stop in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        normal = np.array([stop[1] - start[1], start[0] - stop[0]])
        if float(normal @ (middle - start)) > 0:
            normal = -normal
        if float(((square - start) @ normal).min()) > 0:
            return False
    return True


class Ground:
    """Renders the ground below the horizon.

    Each band of image rows reads the level whose texel is about as wide as a pixel there, so distant
    texture is area-filtered; distant bands are drawn with more rows than needed and averaged, because a
    pixel covers far more ground along the view than across it.
    """

    def __init__(self, camera: Camera, painter: GroundPainter) -> None:
        self.camera = camera
        self.painter = painter
        self.tiles: OrderedDict[tuple[int, int, int], UInt8Array] = OrderedDict()
        self.mosaics: dict[int, Mosaic] = {}

    def render(self, image: UInt8Array, pose: Pose) -> None:
        """Paint all rows below the horizon of `image` [H, W, 3] for the ego pose."""
        height = self.camera.height
        top = max(0, math.ceil(self.camera.horizon_row))
        if top >= height:
            return
        lower = height
        focal = self.camera.intrinsics.fx
        level, near = 0, self.distance_at_row(height - 0.5)
        while lower > top:
            far = FINEST_TEXEL_M * 2.0**level * focal * 1.25
            upper = top if far >= VISIBLE_M else max(top, math.ceil(self.camera.row_at_distance(far)))
            if upper < lower:
                reach = min(far, VISIBLE_M)
                self.render_band(image, pose, level, (upper, lower), (min(near, reach), reach))
                lower, near = upper, reach
            level += 1
        self.fade(image, top)

    def fade(self, image: UInt8Array, top: int) -> None:
        """Blend the farthest rows into the haze."""
        light = self.painter.light
        rows = np.arange(top, min(top + FADED_ROWS, self.camera.height))
        distance = np.array([self.distance_at_row(float(row)) for row in rows])
        share = (1.0 - np.exp(-np.minimum(distance, 4000.0) / light.haze_m))[:, None, None]
        area = image[rows[0] : rows[-1] + 1]
        area[:] = area + share * (light.horizon * 0.92 - area)

    def distance_at_row(self, row: float) -> float:
        """Distance straight ahead at an image row below the horizon, metres."""
        slope = (row - self.camera.intrinsics.cy) / self.camera.intrinsics.fy
        angle = math.atan(slope) + self.camera.pitch_down_rad
        return self.camera.mount_height_m / math.tan(max(angle, 1e-3))

    def render_band(
        self, image: UInt8Array, pose: Pose, level: int, rows: tuple[int, int], distances: tuple[float, float]
    ) -> None:
        """Paint image rows [rows[0], rows[1]) from one level."""
        texel = FINEST_TEXEL_M * 2.0**level
        near, far = max(distances[0] * 0.97 - 0.5, 0.5), distances[1] * 1.03 + texel * 4
        half = self.camera.width / (2.0 * self.camera.intrinsics.fx) + 0.02
        wedge = np.array([[near, -near * half], [near, near * half], [far, far * half], [far, -far * half]])
        corners = pose.to_world(wedge)
        origin, mosaic = self.mosaic(level, corners, texel)
        # Texel indices -> world -> vehicle axes -> image, all homographies of the ground plane.
        cosine, sine = math.cos(pose.heading), math.sin(pose.heading)
        to_vehicle = np.array(
            [
                [cosine, sine, -cosine * pose.x - sine * pose.y],
                [sine, -cosine, -sine * pose.x + cosine * pose.y],
                [0, 0, 1],
            ]
        )
        texel_to_world = np.array([[texel, 0, origin[0] + texel / 2], [0, texel, origin[1] + texel / 2], [0, 0, 1.0]])
        homography = self.camera.ground_to_image @ to_vehicle @ texel_to_world
        oversample = int(np.clip(round(math.sqrt(distances[1] / 9.0)), 1, 6))
        to_band = np.array(
            [[1, 0, 0], [0, oversample, (0.5 - rows[0]) * oversample - 0.5], [0, 0, 1.0]], dtype=np.float64
        )
        band = cv2.warpPerspective(
            mosaic,
            to_band @ homography,
            (self.camera.width, (rows[1] - rows[0]) * oversample),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        if oversample > 1:
            band = cv2.resize(band, (self.camera.width, rows[1] - rows[0]), interpolation=cv2.INTER_AREA)
        image[rows[0] : rows[1]] = band

    def mosaic(self, level: int, corners: FloatArray, texel: float) -> tuple[FloatArray, UInt8Array]:
        """World position of the first texel's corner and the joined tiles that meet the convex outline."""
        side = TILE_TEXELS * texel
        low = np.floor(corners.min(axis=0) / side).astype(int)
        high = np.floor(corners.max(axis=0) / side).astype(int)
        window = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        held = self.mosaics.get(level)
        if held is None or held.window != window:
            shape = (int(high[1] - low[1] + 1) * TILE_TEXELS, int(high[0] - low[0] + 1) * TILE_TEXELS, 3)
            held = Mosaic(window, np.full(shape, self.painter.far_colour, np.uint8), set())
            self.mosaics[level] = held
        for iy in range(window[1], window[3] + 1):
            for ix in range(window[0], window[2] + 1):
                if (ix, iy) not in held.filled and meets(corners, ix * side, iy * side, side):
                    x, y = (ix - window[0]) * TILE_TEXELS, (iy - window[1]) * TILE_TEXELS
                    held.picture[y : y + TILE_TEXELS, x : x + TILE_TEXELS] = self.tile(level, ix, iy)
                    held.filled.add((ix, iy))
        return low * side, held.picture

    def tile(self, level: int, ix: int, iy: int) -> UInt8Array:
        """One square tile, painted on first use."""
        key = (level, ix, iy)
        found = self.tiles.get(key)
        if found is None:
            texel = FINEST_TEXEL_M * 2.0**level
            side = TILE_TEXELS * texel
            found = self.painter.paint(ix * side, iy * side, texel, TILE_TEXELS)
            self.tiles[key] = found
            if len(self.tiles) > CACHED_TILES:
                self.tiles.popitem(last=False)
        else:
            self.tiles.move_to_end(key)
        return found
