"""Painted facades: walls, windows with reflections, shop fronts."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.scenario import bgr
from cable_rpc.data.synthetic.textures import tileable_noise

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
UInt8Array = npt.NDArray[np.uint8]

TEXELS_PER_M = 30
STOREY_M = 3.2
GROUND_STOREY_M = 4.0

WALLS = (
    ("brick", bgr(146, 84, 66)),
    ("brick", bgr(120, 76, 62)),
    ("brick", bgr(168, 122, 92)),
    ("plaster", bgr(214, 204, 184)),
    ("plaster", bgr(222, 218, 210)),
    ("plaster", bgr(196, 172, 138)),
    ("plaster", bgr(176, 184, 186)),
    ("plaster", bgr(204, 178, 164)),
    ("panel", bgr(156, 158, 158)),
    ("panel", bgr(128, 134, 140)),
    ("stone", bgr(178, 170, 154)),
    ("stone", bgr(160, 150, 136)),
)
SIGNS = (
    bgr(150, 40, 110),
    bgr(30, 120, 110),
    bgr(40, 60, 130),
    bgr(170, 50, 40),
    bgr(40, 44, 46),
    bgr(210, 150, 40),
    bgr(60, 110, 60),
)


@dataclass(slots=True)
class Texture:
    """A picture of a flat surface with area-filtered copies for every horizontal and vertical reduction."""

    image: UInt8Array
    width_m: float
    height_m: float
    reduced: dict[tuple[int, int], UInt8Array] = field(default_factory=dict)

    def level(self, across: int, down: int) -> UInt8Array:
        """The picture reduced by 2**across horizontally and 2**down vertically."""
        height, width = self.image.shape[:2]
        across, down = min(across, width.bit_length() - 2), min(down, height.bit_length() - 2)
        if across <= 0 and down <= 0:
            return self.image
        key = (max(across, 0), max(down, 0))
        if key not in self.reduced:
            size = (max(1, width >> key[0]), max(1, height >> key[1]))
            self.reduced[key] = np.asarray(cv2.resize(self.image, size, interpolation=cv2.INTER_AREA), np.uint8)
        return self.reduced[key]


def fill(canvas: Float32Array, x0: float, y0: float, x1: float, y1: float, colour: FloatArray) -> None:
    """Fill a rectangle given in metres from the top left."""
    t = TEXELS_PER_M
    canvas[max(0, round(y0 * t)) : max(0, round(y1 * t)), max(0, round(x0 * t)) : max(0, round(x1 * t))] = colour


def wall_texture(rng: np.random.Generator, kind: str, tint: FloatArray, height: int, width: int) -> Float32Array:
    """A bare wall [height, width, 3]."""
    fine = np.tile(tileable_noise(rng, 256, 0.4), (height // 256 + 1, width // 256 + 1))[:height, :width]
    coarse = np.tile(tileable_noise(rng, 256, 1.5), (height // 256 + 1, width // 256 + 1))[:height, :width]
    shade = 1.0 + 0.05 * fine + 0.06 * coarse
    y, x = np.arange(height)[:, None] / TEXELS_PER_M, np.arange(width)[None, :] / TEXELS_PER_M
    if kind in ("brick", "stone"):
        course, long = (0.1, 0.3) if kind == "brick" else (0.42, 0.85)
        row = np.floor(y / course)
        column = np.floor((x + (row % 2) * long / 2) / long)
        tone = np.modf(np.abs(np.sin(row * 12.9898 + column * 78.233)) * 43758.5)[0]
        mortar = (np.mod(y, course) < 0.034) | (np.mod(x + (row % 2) * long / 2, long) < 0.034)
        shade = shade * (0.86 + 0.26 * tone) * np.where(mortar, 0.86, 1.0)
    elif kind == "panel":
        joint = (np.mod(y, STOREY_M) < 0.05) | (np.mod(x, 2.4) < 0.05)
        shade = shade * np.where(joint, 0.72, 1.0)
    drip = np.clip(coarse[:1] * 0.5, 0, 1) * np.exp(-y / 2.5)
    return np.asarray(tint * (shade * (1.0 - 0.25 * drip))[..., None], dtype=np.float32)


def paint_window(
    rng: np.random.Generator,
    canvas: Float32Array,
    box: tuple[float, float, float, float],
    frame: FloatArray,
    panes: int,
) -> None:
    """A window in the rectangle (x0, y0, x1, y1), metres."""
    x0, y0, x1, y1 = box
    fill(canvas, x0 - 0.1, y0 - 0.12, x1 + 0.1, y0, frame * 0.9)
    fill(canvas, x0 - 0.08, y1, x1 + 0.08, y1 + 0.1, frame)
    fill(canvas, x0 - 0.08, y1 + 0.1, x1 + 0.08, y1 + 0.2, np.array([70.0, 72.0, 76.0]))
    fill(canvas, x0, y0, x1, y1, frame * 0.85)
    t = TEXELS_PER_M
    rows = slice(round((y0 + 0.07) * t), round((y1 - 0.07) * t))
    columns = slice(round((x0 + 0.07) * t), round((x1 - 0.07) * t))
    area = canvas[rows, columns]
    if area.size == 0:
        return
    height, width = area.shape[:2]
    fall = np.linspace(0.0, 1.0, height)[:, None, None]
    slant = np.linspace(0.0, 1.0, width)[None, :, None]
    # The upper part mirrors the sky, the lower part the opposite side of the street.
    mirror = np.clip(
        1.4 - 2.0 * (fall + 0.25 * slant * float(rng.uniform(-1, 1)) + float(rng.uniform(-0.15, 0.25))), 0, 1
    )
    dark = np.array([52.0, 48.0, 44.0]) * float(rng.uniform(0.6, 1.1))
    area[:] = dark + mirror * (np.array([168.0, 152.0, 136.0]) * float(rng.uniform(0.5, 0.95)) - dark)
    if rng.random() < 0.5:
        drape = np.array([190.0, 200.0, 206.0]) * float(rng.uniform(0.55, 0.95))
        share = int(width * float(rng.uniform(0.12, 0.3)))
        area[:, :share] = 0.6 * drape + 0.4 * area[:, :share]
        area[:, width - share :] = 0.6 * drape + 0.4 * area[:, width - share :]
    if rng.random() < 0.25:
        blind = int(height * float(rng.uniform(0.2, 0.7)))
        area[:blind] = frame * 0.8
        area[:blind:3] = frame * 0.66
    area[: max(1, height // 12)] *= 0.6
    for pane in range(1, panes):
        centre = x0 + (x1 - x0) * pane / panes
        fill(canvas, centre - 0.035, y0, centre + 0.035, y1, frame * 0.85)
    fill(canvas, x0, y0 + (y1 - y0) * 0.3, x1, y0 + (y1 - y0) * 0.3 + 0.05, frame * 0.85)


def paint_shop(rng: np.random.Generator, canvas: Float32Array, width: float, top: float, bottom: float) -> None:
    """A shop front between two heights (metres from the top)."""
    sign = SIGNS[int(rng.integers(len(SIGNS)))]
    fill(canvas, 0.15, top, width - 0.15, bottom, bgr(58, 56, 54))
    fill(canvas, 0.1, top, width - 0.1, top + 0.7, sign)
    fill(canvas, 0.1, top + 0.66, width - 0.1, top + 0.72, sign * 0.5)
    x = float(rng.uniform(0.6, 2.0))
    letter = bgr(236, 232, 220) if sign.mean() < 130 else bgr(40, 36, 40)
    while x < width - 1.5:
        size = float(rng.uniform(0.16, 0.3))
        if rng.random() < 0.85:
            fill(canvas, x, top + 0.2, x + size, top + 0.5, letter)
            fill(canvas, x + 0.07, top + float(rng.choice([0.27, 0.2, 0.36])), x + size - 0.07, top + 0.42, sign)
        x += size + 0.08
    x = 0.4
    while x < width - 1.2:
        pane = min(float(rng.uniform(1.2, 2.4)), width - 0.3 - x)
        door = rng.random() < 0.25
        low = bottom - (0.08 if door else 0.5)
        t = TEXELS_PER_M
        area = canvas[round((top + 0.85) * t) : round(low * t), round(x * t) : round((x + pane) * t)]
        if area.size:
            height, across = area.shape[:2]
            fall = np.linspace(0.0, 1.0, height)[:, None, None]
            glow = bgr(150, 132, 104) * float(rng.uniform(0.2, 0.85))
            area[:] = glow * (1.0 - 0.6 * fall) + bgr(60, 70, 80) * 0.5
            for _ in range(int(rng.integers(2, 6))):
                left = int(rng.integers(0, max(1, across - 6)))
                goods = int(rng.integers(4, max(5, across // 4)))
                tall = int(height * float(rng.uniform(0.15, 0.5)))
                area[height - tall :, left : left + goods] *= rng.uniform(0.5, 1.3, 3)
            streak = np.clip(
                1.0
                - np.abs(np.arange(across)[None, :] - np.arange(height)[:, None] * 0.5 - across * 0.2)
                / (across * 0.18),
                0,
                1,
            )
            area += (streak * 26.0)[..., None]
        x += pane + 0.1


def facade(rng: np.random.Generator, width: float, storeys: int, shop: bool, house: bool) -> Texture:
    """A whole front."""
    kind, tint = WALLS[int(rng.integers(len(WALLS)))]
    tint = tint * float(rng.uniform(0.85, 1.08))
    ground = 3.0 if house else GROUND_STOREY_M
    height = ground + STOREY_M * (storeys - 1) + (0.1 if house else 0.8)
    t = TEXELS_PER_M
    canvas = wall_texture(rng, kind, tint, round(height * t), round(width * t))
    frame = bgr(226, 224, 218) if rng.random() < 0.6 else bgr(84, 84, 86)
    bay = float(rng.uniform(2.3, 3.4))
    bays = max(1, int(width / bay))
    bay = width / bays
    wide, tall = bay * float(rng.uniform(0.42, 0.62)), float(rng.uniform(1.5, 2.0))
    panes = int(rng.integers(1, 4))
    if not house:
        fill(canvas, 0, 0, width, 0.35, tint * 0.8)
        fill(canvas, 0, 0.35, width, 0.45, tint * 0.45)
    for floor in range(storeys - 1):
        top = height - ground - STOREY_M * (floor + 1) + 0.75
        for index in range(bays):
            centre = (index + 0.5) * bay
            paint_window(rng, canvas, (centre - wide / 2, top, centre + wide / 2, top + tall), frame, panes)
        if kind != "brick" and not house:
            fill(canvas, 0, top + tall + 0.45, width, top + tall + 0.55, tint * 0.82)
    if shop:
        paint_shop(rng, canvas, width, height - ground + 0.15, height)
    else:
        door = int(rng.integers(bays))
        for index in range(bays):
            centre, top = (index + 0.5) * bay, height - ground + 0.8
            if index == door:
                fill(canvas, centre - 0.65, height - 2.5, centre + 0.65, height, frame * 0.8)
                fill(
                    canvas,
                    centre - 0.5,
                    height - 2.35,
                    centre + 0.5,
                    height,
                    SIGNS[int(rng.integers(len(SIGNS)))] * 0.7,
                )
            else:
                paint_window(rng, canvas, (centre - wide / 2, top, centre + wide / 2, height - 0.95), frame, panes)
        fill(canvas, 0, height - 0.4, width, height - 0.36, tint * 0.5)
    base = np.linspace(1.0, 0.72, round(1.2 * t))[:, None, None]
    canvas[-len(base) :] *= base
    return Texture(np.clip(canvas, 0, 255).astype(np.uint8), width, height)


def plain_wall(rng: np.random.Generator, width: float, height: float) -> Texture:
    """A windowless end wall with a few small windows."""
    kind, tint = WALLS[int(rng.integers(len(WALLS)))]
    canvas = wall_texture(rng, kind, tint * 0.95, round(height * TEXELS_PER_M), round(width * TEXELS_PER_M))
    for top in np.arange(1.6, height - 3.0, STOREY_M):
        if rng.random() < 0.7:
            paint_window(
                rng, canvas, (width * 0.4, float(top), width * 0.4 + 1.0, float(top) + 1.4), bgr(220, 218, 212), 1
            )
    return Texture(np.clip(canvas, 0, 255).astype(np.uint8), width, height)
