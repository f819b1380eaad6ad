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

FINEST_TEXEL_M = 0.018
TILE_TEXELS = 128
VISIBLE_M = 340.0
CACHED_TILES = 2400
MOSAIC_MARGIN = 3
FADED_ROWS = 40
SHARPNESS = 1.05
"""Texels per pixel across the view at the far end of a band."""

UInt8Array = npt.NDArray[np.uint8]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(slots=True)
class Mosaic:
    """Joined tiles of one level; only `filled` ones are painted."""

    window: tuple[int, int, int, int]
    picture: UInt8Array
    filled: set[tuple[int, int]]

    def holds(self, low: IntArray, high: IntArray) -> bool:
        """Whether the tiles low .. high lie inside."""
        x0, y0, x1, y1 = self.window
        return bool(x0 <= low[0] and y0 <= low[1] and high[0] <= x1 and high[1] <= y1)


def meeting_tiles(outline: FloatArray, window: tuple[int, int, int, int], side: float) -> list[tuple[int, int]]:
    """Tiles (ix, iy) of a window that may touch a convex outline [N, 2], with its edges as separating lines.

    Args:
        outline: Corners in world metres.
        window: First and last tile, ix0, iy0, ix1, iy1.
        side: Tile side in metres.
    """
    ix, iy = np.meshgrid(np.arange(window[0], window[2] + 1), np.arange(window[1], window[3] + 1))
    edges = np.roll(outline, -1, axis=0) - outline
    normals = np.column_stack([edges[:, 1], -edges[:, 0]])
    middle = outline.mean(axis=0)
    normals *= np.where(((middle - outline) * normals).sum(axis=1) > 0, -1.0, 1.0)[:, None]
    # The corner of a tile that lies farthest inwards of an edge decides.
    corner = np.minimum(normals, 0.0).sum(axis=1) * side
    offset = corner - (normals * outline).sum(axis=1)
    first = np.stack([ix.ravel(), iy.ravel()]) * side
    kept = (normals @ first + offset[:, None] <= 0.0).all(axis=0)
    return list(zip(ix.ravel()[kept].tolist(), iy.ravel()[kept].tolist(), strict=True))


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
        # What lies farther has the mean colour: tiles outside the view must never be read, or the picture
        # would depend on the frames rendered before.
        limit = min(height, max(top, math.ceil(self.camera.row_at_distance(VISIBLE_M))))
        image[top:limit] = self.painter.far_colour
        lower, level, focal = height, 0, self.camera.intrinsics.fx
        while lower > limit:
            far = FINEST_TEXEL_M * 2.0**level * focal * SHARPNESS
            upper = limit if far >= VISIBLE_M else max(limit, math.ceil(self.camera.row_at_distance(far)))
            if upper < lower:
                self.render_band(image, pose, level, (upper, lower))
                lower = upper
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

    def render_band(self, image: UInt8Array, pose: Pose, level: int, rows: tuple[int, int]) -> None:
        """Paint image rows [rows[0], rows[1]) from one level."""
        texel = FINEST_TEXEL_M * 2.0**level
        reach = self.distance_at_row(rows[0] - 0.5)
        near = max(self.distance_at_row(rows[1] - 0.5) * 0.97 - 0.5, 0.5)
        far = reach * 1.03 + texel * 4
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
        oversample = int(np.clip(round(math.sqrt(reach / 9.0)), 1, 6))
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
        held = self.mosaics.get(level)
        if held is None or not held.holds(low, high):
            held = self.moved(held, low, high)
            self.mosaics[level] = held
        x0, y0 = held.window[:2]
        for ix, iy in meeting_tiles(corners, (int(low[0]), int(low[1]), int(high[0]), int(high[1])), side):
            if (ix, iy) not in held.filled:
                x, y = (ix - x0) * TILE_TEXELS, (iy - y0) * TILE_TEXELS
                held.picture[y : y + TILE_TEXELS, x : x + TILE_TEXELS] = self.tile(level, ix, iy)
                held.filled.add((ix, iy))
        # Cut to what the view alone decides: the warp's rounding depends on where the picture begins.
        t = TILE_TEXELS
        rows, columns = (
            (int(a - b) * t, int(c - b + 1) * t) for a, b, c in ((low[1], y0, high[1]), (low[0], x0, high[0]))
        )
        return low * side, held.picture[rows[0] : rows[1], columns[0] : columns[1]]

    def moved(self, held: Mosaic | None, low: IntArray, high: IntArray) -> Mosaic:
        """A mosaic around the tiles low .. high that keeps what an earlier one already holds of them."""
        x0, y0, x1, y1 = (int(value) for value in (*(low - MOSAIC_MARGIN), *(high + MOSAIC_MARGIN)))
        t = TILE_TEXELS
        picture = np.empty(((y1 - y0 + 1) * t, (x1 - x0 + 1) * t, 3), np.uint8)
        picture[:] = self.painter.far_colour
        if held is None:
            return Mosaic((x0, y0, x1, y1), picture, set())
        a0, b0, a1, b1 = held.window
        left, top, right, bottom = max(x0, a0), max(y0, b0), min(x1, a1) + 1, min(y1, b1) + 1
        if left >= right or top >= bottom:
            return Mosaic((x0, y0, x1, y1), picture, set())
        picture[(top - y0) * t : (bottom - y0) * t, (left - x0) * t : (right - x0) * t] = held.picture[
            (top - b0) * t : (bottom - b0) * t, (left - a0) * t : (right - a0) * t
        ]
        kept = {(ix, iy) for ix, iy in held.filled if left <= ix < right and top <= iy < bottom}
        return Mosaic((x0, y0, x1, y1), picture, kept)

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
