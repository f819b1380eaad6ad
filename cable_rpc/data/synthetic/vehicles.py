"""Cars in several body styles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.mesh import Mesh, MeshBuilder, inset
from cable_rpc.data.synthetic.scenario import bgr

FloatArray = npt.NDArray[np.float64]

GLASS = bgr(26, 32, 38)
RUBBER = bgr(24, 24, 25)
ALLOY = bgr(150, 153, 158)
DARK = bgr(34, 35, 37)
CHROME = bgr(176, 178, 182)
TAIL_RED = bgr(186, 22, 26)
LAMP = bgr(236, 238, 240)
PLATE = bgr(226, 226, 216)

PAINTS = tuple(
    bgr(*rgb)
    for rgb in (
        (226, 227, 228),
        (186, 189, 193),
        (120, 124, 130),
        (60, 63, 68),
        (28, 29, 32),
        (150, 22, 26),
        (30, 62, 132),
        (24, 84, 58),
        (92, 110, 130),
        (196, 172, 132),
        (206, 126, 30),
        (66, 100, 146),
        (110, 24, 40),
        (238, 238, 236),
        (40, 44, 52),
        (160, 164, 168),
    )
)


@dataclass(frozen=True, slots=True)
class CarShape:
    """Proportions of a car in metres; x runs from the rear (negative) to the front."""

    length: float
    width: float
    belt: float
    roof: float
    nose: float
    """Height of the bonnet's front edge."""
    tail: float
    """Height of the boot's rear edge."""
    rear_base: float
    rear_top: float
    front_top: float
    front_base: float
    clearance: float = 0.2
    wheel: float = 0.32


CAR_SHAPES = {
    "hatch": CarShape(4.05, 1.76, 0.93, 1.47, 0.74, 0.92, -1.98, -1.55, 0.32, 1.12),
    "sedan": CarShape(4.65, 1.82, 0.92, 1.44, 0.72, 0.94, -1.62, -0.98, 0.36, 1.18),
    "estate": CarShape(4.7, 1.83, 0.94, 1.48, 0.73, 0.93, -2.28, -1.92, 0.36, 1.18),
    "suv": CarShape(4.55, 1.88, 1.07, 1.69, 0.92, 1.06, -2.2, -1.85, 0.3, 1.12, 0.26, 0.37),
    "van": CarShape(5.0, 1.95, 1.12, 1.96, 0.98, 1.1, -2.46, -2.38, 0.95, 1.72, 0.24, 0.34),
}


def build_car(style: str, paint: FloatArray, braking: bool, panel_van: bool = False) -> Mesh:
    """A car of one of CAR_SHAPES."""
    shape = CAR_SHAPES[style]
    builder = MeshBuilder(centre=np.array([0.0, 0.0, 0.75]))
    add_tyre_treads(builder, shape)
    add_lower_body(builder, shape, paint)
    add_greenhouse(builder, shape, paint, panel_van)
    add_wheels(builder, shape)
    add_front(builder, shape)
    add_rear(builder, shape, braking)
    add_sides(builder, shape, paint)
    return builder.build()


def add_tyre_treads(builder: MeshBuilder, shape: CarShape) -> None:
    """What is seen of the tyres and the dark underside from front and rear."""
    half = shape.width / 2
    for x in wheel_places(shape):
        for side in (-1.0, 1.0):
            inner, outer = sorted((side * (half - 0.24), side * (half - 0.02)))
            builder.box((x - shape.wheel * 0.9, inner, 0.02), (x + shape.wheel * 0.9, outer, 0.4), RUBBER)
    low, high = -shape.length / 2 + 0.2, shape.length / 2 - 0.2
    builder.box((low, -half + 0.25, 0.17), (high, half - 0.25, 0.34), DARK * 0.6)


def wheel_places(shape: CarShape) -> tuple[float, float]:
    """Positions of the axles along x."""
    return -0.295 * shape.length, 0.31 * shape.length


def body_ring(shape: CarShape, x: float, top: float, narrow: float) -> FloatArray:
    """Right half of a cross-section of the lower body, bottom to top."""
    half, low = shape.width / 2 * narrow, shape.clearance
    waist = low + (top - low) * 0.55
    return np.array(
        [
            [x, half * 0.90, low],
            [x, half * 0.985, low + 0.12],
            [x, half, waist],
            [x, half * 0.975, top - 0.13],
            [x, half * 0.93, top - 0.035],
            [x, half * 0.80, top],
            [x, half * 0.35, top + 0.02],
        ]
    )


def add_lower_body(builder: MeshBuilder, shape: CarShape, paint: FloatArray) -> None:
    """Bumper to bumper below the windows, rounded in plan and in section."""
    end = shape.length / 2
    tops = [
        (-end, shape.tail - 0.13, 0.86),
        (-end + 0.07, shape.tail - 0.03, 0.94),
        (-end + 0.3, shape.tail, 0.985),
        (shape.rear_base + 0.35, shape.belt, 1.0),
        (0.0, shape.belt - 0.01, 1.0),
        (shape.front_base - 0.25, shape.belt, 1.0),
        (shape.front_base + 0.1, shape.belt - 0.02, 0.995),
        ((shape.front_base + end) / 2 + 0.1, (shape.belt + shape.nose) / 2 + 0.05, 0.985),
        (end - 0.22, shape.nose + 0.02, 0.955),
        (end - 0.05, shape.nose - 0.08, 0.90),
        (end, shape.nose - 0.18, 0.83),
    ]
    builder.loft([body_ring(shape, x, top, narrow) for x, top, narrow in tops], paint, gloss=0.75)


def add_greenhouse(builder: MeshBuilder, shape: CarShape, paint: FloatArray, panel_van: bool) -> None:
    """Windows, pillars and the crowned roof."""
    bottom, roof = shape.belt - 0.02, shape.roof
    lower, upper = shape.width / 2 * 0.935, shape.width / 2 * 0.76
    edge = roof - 0.07
    rear = np.array([shape.rear_base, lower, bottom]), np.array([shape.rear_top, upper, edge])
    front = np.array([shape.front_base, lower, bottom]), np.array([shape.front_top, upper, edge])
    side = np.array([rear[0], front[0], front[1], rear[1]])
    builder.both_sides(side, paint, gloss=0.7, layer=1)
    mirror = np.array([1.0, -1.0, 1.0])
    wind = np.array([front[0] * mirror, front[0], front[1], front[1] * mirror])
    back = np.array([rear[0] * mirror, rear[0], rear[1], rear[1] * mirror])
    builder.add(wind, paint, gloss=0.7, layer=1)
    builder.add(back, paint, gloss=0.7, layer=1)
    span = shape.front_top - shape.rear_top
    stations = [
        (0.0, edge, 1.0),
        (0.08, roof - 0.015, 0.97),
        (0.5, roof + 0.015, 0.96),
        (0.9, roof - 0.01, 0.97),
        (1.0, edge, 1.0),
    ]
    rings = [
        np.array(
            [
                [shape.rear_top + share * span, upper * wide, edge],
                [shape.rear_top + share * span, upper * wide * 0.92, edge + (top - edge) * 0.7],
                [shape.rear_top + share * span, upper * wide * 0.6, top],
            ]
        )
        for share, top, wide in stations
    ]
    builder.loft(rings, paint, gloss=0.75, layer=1)
    builder.add(inset(wind, 0.045, 0.04, 0.955, 0.95), GLASS, gloss=1.0, layer=2)
    if panel_van:
        builder.both_sides(inset(side, 0.72, 0.10, 0.95, 0.9), GLASS, gloss=1.0, layer=2)
        for u in (0.08, 0.52):
            builder.add(inset(back, u, 0.12, u + 0.4, 0.85), GLASS, gloss=0.9, layer=2)
        return
    builder.add(inset(back, 0.08, 0.08, 0.92, 0.9), GLASS, gloss=0.9, layer=2)
    builder.both_sides(inset(side, 0.06, 0.07, 0.95, 0.95), DARK, gloss=0.4, layer=2)
    panes = ((0.085, 0.23), (0.25, 0.52), (0.545, 0.925)) if shape.length > 4.3 else ((0.1, 0.46), (0.49, 0.925))
    for start, stop in panes:
        pane = inset(side, start, 0.1, stop, 0.92)
        builder.both_sides(pane, GLASS, gloss=1.0, layer=3)
        builder.both_sides(inset(side, start, 0.62, stop, 0.92), GLASS * 1.7, gloss=1.0, layer=4)


def add_wheels(builder: MeshBuilder, shape: CarShape) -> None:
    """Arches, tyres and rims on both sides."""
    plane, radius = shape.width / 2 + 0.004, shape.wheel
    for x in wheel_places(shape):
        for side in (-1.0, 1.0):
            y = side * plane
            builder.disc((x, y, radius + 0.03), radius + 0.07, DARK * 0.5, layer=2)
            builder.disc((x, y, radius), radius, RUBBER, layer=3)
            builder.disc((x, y, radius), radius * 0.66, ALLOY * 0.55, layer=4, gloss=0.3)
            for spoke in range(5):
                angle = spoke * 2 * np.pi / 5 + 0.3
                tip = radius * 0.62 * np.array([np.cos(angle), np.sin(angle)])
                wide = radius * 0.11 * np.array([-np.sin(angle), np.cos(angle)])
                hub = np.array([x, radius])
                flat = np.array([hub - wide * 1.4, hub + tip - wide, hub + tip + wide, hub + wide * 1.4])
                quad = np.column_stack([flat[:, 0], np.full(4, y), flat[:, 1]])
                builder.add(quad, ALLOY, gloss=0.5, layer=5, normal=np.array([0.0, side, 0.0]))


def add_sides(builder: MeshBuilder, shape: CarShape, paint: FloatArray) -> None:
    """Sill, door gaps, handles and mirrors."""
    y, low = shape.width / 2 + 0.002, shape.clearance
    rear, front = wheel_places(shape)
    gap = shape.wheel + 0.08
    sill = [[rear + gap, y, low], [front - gap, y, low], [front - gap, y, low + 0.1], [rear + gap, y, low + 0.1]]
    builder.both_sides(np.array(sill), DARK, layer=2)
    waist = low + (shape.belt - low) * 0.66
    doors = [0.02, -1.0] if shape.length > 4.3 else [-0.35]
    for x in [*doors, front - gap - 0.12]:
        line = [
            [x, y, low + 0.1],
            [x + 0.014, y, low + 0.1],
            [x + 0.014, y * 0.985, shape.belt - 0.1],
            [x, y * 0.985, shape.belt - 0.1],
        ]
        builder.both_sides(np.array(line), paint * 0.35, layer=2)
    for x in doors:
        handle = [
            [x + 0.08, y, waist],
            [x + 0.26, y, waist],
            [x + 0.26, y, waist + 0.035],
            [x + 0.08, y, waist + 0.035],
        ]
        builder.both_sides(np.array(handle), paint * 0.6, gloss=0.6, layer=3)
    crease = [
        [rear + 0.2, y, waist + 0.09],
        [front, y, waist + 0.05],
        [front, y, waist + 0.065],
        [rear + 0.2, y, waist + 0.105],
    ]
    builder.both_sides(np.array(crease), paint * 0.75, gloss=0.6, layer=2)
    x = shape.front_base - 0.3
    for side in (-1.0, 1.0):
        # Parts of their own: the mirror beyond the cabin must be hidden by it.
        builder.part += 1
        inner, outer = sorted((side * (y - 0.04), side * (y + 0.17)))
        builder.box((x - 0.06, inner, shape.belt), (x + 0.08, outer, shape.belt + 0.14), paint * 0.9, gloss=0.5)


def end_patch(x: float, left: float, right: float, low: float, high: float, slope: float = 0.0) -> FloatArray:
    """A quadrilateral across the car at x; its top leans back by `slope` metres."""
    return np.array([[x, left, low], [x, right, low], [x - slope, right, high], [x - slope, left, high]])


def add_front(builder: MeshBuilder, shape: CarShape) -> None:
    """Grille, head lamps, plate and lower bumper."""
    x, half, nose = shape.length / 2 + 0.004, shape.width / 2, shape.nose
    forward = np.array([1.0, 0.0, 0.0])
    low = shape.clearance
    builder.add(end_patch(x, -half * 0.8, half * 0.8, low, low + 0.11), DARK, layer=2, normal=forward)
    builder.add(
        end_patch(x, -half * 0.52, half * 0.52, nose - 0.33, nose - 0.2), DARK, gloss=0.3, layer=2, normal=forward
    )
    builder.add(
        end_patch(x, -half * 0.5, half * 0.5, nose - 0.27, nose - 0.255), CHROME, gloss=0.5, layer=3, normal=forward
    )
    for side in (-1.0, 1.0):
        lamp = np.array(
            [
                [x, side * half * 0.5, nose - 0.27],
                [x - 0.02, side * half * 0.84, nose - 0.25],
                [x - 0.16, side * half * 0.92, nose - 0.1],
                [x - 0.04, side * half * 0.54, nose - 0.15],
            ]
        )
        builder.add(lamp, CHROME * 0.75, gloss=0.6, layer=3, normal=forward)
        builder.add(lamp.mean(axis=0) + (lamp - lamp.mean(axis=0)) * 0.6, LAMP, glow=1.0, layer=4, normal=forward)
        fog = end_patch(x, side * half * 0.62, side * half * 0.8, low + 0.1, low + 0.18)
        builder.add(fog, DARK * 0.8, layer=3, normal=forward)
    builder.add(end_patch(x + 0.01, -0.26, 0.26, low + 0.16, low + 0.27), PLATE, layer=4, normal=forward)
    builder.add(end_patch(x + 0.01, -0.2, 0.2, low + 0.19, low + 0.24), DARK * 1.6, layer=5, normal=forward)


def add_rear(builder: MeshBuilder, shape: CarShape, braking: bool) -> None:
    """Tail lamps, plate, bumper and exhaust."""
    x, half, tail = -shape.length / 2 - 0.004, shape.width / 2, shape.tail
    back = np.array([-1.0, 0.0, 0.0])
    low = shape.clearance
    red = TAIL_RED * (1.3 if braking else 0.8)
    builder.add(end_patch(x, -half * 0.82, half * 0.82, low, low + 0.14), DARK, layer=2, normal=back)
    builder.add(end_patch(x, -half * 0.84, half * 0.84, low + 0.3, low + 0.315), DARK, layer=2, normal=back)
    for side in (-1.0, 1.0):
        lamp = end_patch(x, side * half * 0.52, side * half * 0.85, tail - 0.31, tail - 0.14, -0.01)
        wrap = np.array(
            [
                [x, side * half * 0.85, tail - 0.31],
                [x + 0.22, side * half * 0.99, tail - 0.29],
                [x + 0.22, side * half * 0.97, tail - 0.14],
                [x, side * half * 0.85, tail - 0.14],
            ]
        )
        builder.add(lamp, red, gloss=0.3, glow=float(braking), layer=3, normal=back)
        builder.add(wrap, red, gloss=0.3, layer=3, normal=np.array([-0.4, side, 0.0]))
        inner = end_patch(x, side * half * 0.56, side * half * 0.68, tail - 0.28, tail - 0.22)
        builder.add(inner, LAMP * 0.7, layer=4, normal=back)
    builder.add(end_patch(x, -0.27, 0.27, tail - 0.32, tail - 0.2), PLATE, layer=4, normal=back)
    builder.add(end_patch(x, -0.21, 0.21, tail - 0.29, tail - 0.23), DARK * 1.6, layer=5, normal=back)
