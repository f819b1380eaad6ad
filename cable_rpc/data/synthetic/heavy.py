"""Trucks and buses."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.mesh import Mesh, MeshBuilder, inset
from cable_rpc.data.synthetic.scenario import bgr
from cable_rpc.data.synthetic.vehicles import ALLOY, CHROME, DARK, GLASS, LAMP, PLATE, RUBBER, TAIL_RED, end_patch

FloatArray = npt.NDArray[np.float64]

TRUCK_LENGTH, TRUCK_WIDTH = 8.6, 2.46
BUS_LENGTH, BUS_WIDTH = 11.6, 2.52

CARGO_PAINTS = (
    bgr(226, 224, 218),
    bgr(196, 190, 178),
    bgr(60, 92, 150),
    bgr(170, 52, 44),
    bgr(84, 120, 92),
    bgr(214, 168, 60),
)
BUS_PAINTS = (bgr(40, 118, 186), bgr(196, 44, 40), bgr(230, 226, 216), bgr(60, 140, 92), bgr(226, 170, 40))


def add_axles(builder: MeshBuilder, places: tuple[float, ...], half: float, radius: float) -> None:
    """Wheels on both sides at the given x."""
    for x in places:
        for side in (-1.0, 1.0):
            inner, outer = sorted((side * (half - 0.4), side * (half - 0.01)))
            builder.box((x - radius * 0.9, inner, 0.02), (x + radius * 0.9, outer, radius * 1.2), RUBBER)
            y = side * (half + 0.006)
            builder.disc((x, y, radius), radius + 0.07, DARK * 0.5, layer=4)
            builder.disc((x, y, radius), radius, RUBBER, layer=5)
            builder.disc((x, y, radius), radius * 0.58, ALLOY * 0.7, layer=6, gloss=0.3)
            builder.disc((x, y, radius), radius * 0.22, DARK, layer=7)


def rounded_box(
    builder: MeshBuilder, x: tuple[float, float], half: float, z: tuple[float, float], colour: FloatArray, gloss: float
) -> None:
    """A long box with bevelled edges."""
    low, high = z

    def ring(at: float, shrink: float) -> FloatArray:
        return np.array(
            [
                [at, (half - 0.05) - shrink, low],
                [at, half - shrink, low + 0.08],
                [at, half - shrink, high - 0.22],
                [at, half - 0.06 - shrink, high - 0.06],
                [at, half * 0.85 - shrink, high],
                [at, 0.3, high + 0.02],
            ]
        )

    count = max(2, int((x[1] - x[0]) / 1.6))
    inside = np.linspace(x[0] + 0.1, x[1] - 0.1, count)
    rings = [ring(x[0], 0.06), *(ring(float(at), 0.0) for at in inside), ring(x[1], 0.06)]
    builder.loft(rings, colour, gloss=gloss)


def build_truck(cab: FloatArray, cargo: FloatArray, braking: bool, lettering: FloatArray) -> Mesh:
    """A rigid box truck."""
    half, rear, front = TRUCK_WIDTH / 2, -TRUCK_LENGTH / 2, TRUCK_LENGTH / 2
    builder = MeshBuilder(centre=np.array([-1.0, 0.0, 1.2]))
    builder.box((rear + 0.1, -half + 0.3, 0.55), (front - 0.3, half - 0.3, 1.0), DARK)
    add_axles(builder, (rear + 1.7, front - 1.25), half - 0.02, 0.48)
    guard = [
        [rear + 2.5, half - 0.05, 0.45],
        [front - 2.2, half - 0.05, 0.45],
        [front - 2.2, half - 0.05, 0.85],
        [rear + 2.5, half - 0.05, 0.85],
    ]
    builder.both_sides(np.array(guard), DARK * 1.5, layer=2)
    back = np.array([-1.0, 0.0, 0.0])
    builder.add(end_patch(rear - 0.005, -half * 0.95, half * 0.95, 0.5, 0.66), DARK * 1.4, layer=2, normal=back)
    for side in (-1.0, 1.0):
        lamp = end_patch(rear - 0.01, side * half * 0.62, side * half * 0.93, 0.72, 0.9)
        builder.add(lamp, TAIL_RED * (1.3 if braking else 0.85), glow=float(braking), layer=3, normal=back)
    builder.add(end_patch(rear - 0.01, -0.27, 0.27, 0.7, 0.86), PLATE, layer=3, normal=back)
    builder.part, builder.centre = 1, np.array([-1.1, 0.0, 2.2])
    add_cargo(builder, rear, front - 2.15, half, cargo, lettering)
    builder.part, builder.centre = 2, np.array([front - 1.0, 0.0, 1.6])
    add_cab(builder, front, half - 0.06, cab)
    return builder.build()


def add_cargo(
    builder: MeshBuilder, rear: float, stop: float, half: float, cargo: FloatArray, lettering: FloatArray
) -> None:
    """The box body with doors, ribs and a painted name."""
    rounded_box(builder, (rear, stop), half, (1.0, 3.45), cargo, 0.25)
    back = np.array([-1.0, 0.0, 0.0])
    for y in (-half * 0.93, 0.0, half * 0.93):
        builder.add(end_patch(rear - 0.01, y - 0.02, y + 0.02, 1.08, 3.34), cargo * 0.55, layer=2, normal=back)
    for y in (-half * 0.45, -half * 0.15, half * 0.15, half * 0.45):
        builder.add(end_patch(rear - 0.02, y - 0.02, y + 0.02, 1.08, 3.3), CHROME * 0.8, layer=3, normal=back)
    builder.add(end_patch(rear - 0.01, -half * 0.8, half * 0.8, 2.35, 2.8), lettering, layer=2, normal=back)
    for x in np.arange(rear + 0.5, stop - 0.2, 0.75):
        rib = [
            [x, half + 0.005, 1.1],
            [x + 0.03, half + 0.005, 1.1],
            [x + 0.03, half + 0.005, 3.2],
            [x, half + 0.005, 3.2],
        ]
        builder.both_sides(np.array(rib), cargo * 0.8, layer=2)
    middle, span = (rear + stop) / 2, (stop - rear) * 0.3
    for index in range(7):
        x = middle - span + index * 2 * span / 7
        letter = [
            [x, half + 0.01, 2.05],
            [x + span * 0.2, half + 0.01, 2.05],
            [x + span * 0.2, half + 0.01, 2.6],
            [x, half + 0.01, 2.6],
        ]
        builder.both_sides(np.array(letter), lettering, layer=3)


def add_cab(builder: MeshBuilder, front: float, half: float, paint: FloatArray) -> None:
    """Driver's cab with windscreen, doors, lamps and mirrors."""
    start = front - 2.0

    def ring(x: float, low: float, top: float, narrow: float) -> FloatArray:
        wide = half * narrow
        return np.array(
            [
                [x, wide * 0.97, low],
                [x, wide, low + 0.2],
                [x, wide, min(1.5, top)],
                [x, wide * 0.94, top - 0.15],
                [x, wide * 0.8, top],
                [x, wide * 0.2, top],
            ]
        )

    rings = [
        ring(start, 0.6, 2.75, 0.99),
        ring(front - 0.75, 0.5, 2.78, 1.0),
        ring(front - 0.3, 0.42, 2.6, 0.99),
        ring(front - 0.08, 0.42, 1.62, 0.97),
        ring(front, 0.45, 1.5, 0.93),
    ]
    builder.loft(rings, paint, gloss=0.6)
    ahead = np.array([1.0, 0.0, 0.4])
    wind = np.array(
        [
            [front - 0.06, -half * 0.88, 1.58],
            [front - 0.06, half * 0.88, 1.58],
            [front - 0.3, half * 0.84, 2.5],
            [front - 0.3, -half * 0.84, 2.5],
        ]
    )
    builder.add(wind, GLASS, gloss=1.0, layer=3, normal=ahead)
    side = np.array(
        [
            [start + 0.55, half + 0.004, 1.55],
            [front - 0.35, half + 0.004, 1.5],
            [front - 0.5, half * 0.96, 2.42],
            [start + 0.55, half * 0.96, 2.42],
        ]
    )
    builder.both_sides(side, GLASS, gloss=1.0, layer=3)
    for x in (start + 0.45, front - 0.28):
        line = [
            [x, half + 0.005, 0.8],
            [x + 0.02, half + 0.005, 0.8],
            [x + 0.02, half * 0.97, 2.4],
            [x, half * 0.97, 2.4],
        ]
        builder.both_sides(np.array(line), paint * 0.4, layer=2)
    builder.add(end_patch(front + 0.01, -half * 0.6, half * 0.6, 0.9, 1.4), DARK, gloss=0.3, layer=3, normal=ahead)
    for z in (1.02, 1.15, 1.28):
        builder.add(
            end_patch(front + 0.015, -half * 0.56, half * 0.56, z, z + 0.03), CHROME * 0.8, layer=4, normal=ahead
        )
    builder.add(end_patch(front + 0.01, -half * 0.92, half * 0.92, 0.46, 0.82), DARK * 1.3, layer=3, normal=ahead)
    builder.add(end_patch(front + 0.02, -0.27, 0.27, 0.54, 0.66), PLATE, layer=5, normal=ahead)
    for y in (-half * 0.76, half * 0.76):
        lamp = end_patch(front + 0.015, y - 0.2, y + 0.2, 0.66, 0.86)
        builder.add(lamp, LAMP, glow=1.0, layer=4, normal=ahead)
    builder.part += 1
    for side_sign in (-1.0, 1.0):
        inner, outer = sorted((side_sign * (half + 0.02), side_sign * (half + 0.24)))
        builder.box((front - 0.3, inner, 1.75), (front - 0.18, outer, 2.25), DARK, layer=5)


def build_bus(paint: FloatArray, trim: FloatArray, braking: bool) -> Mesh:
    """A city bus."""
    half, rear, front = BUS_WIDTH / 2, -BUS_LENGTH / 2, BUS_LENGTH / 2
    builder = MeshBuilder(centre=np.array([0.0, 0.0, 1.6]))
    rounded_box(builder, (rear, front), half, (0.32, 3.05), paint, 0.6)
    side = np.array(
        [
            [rear + 0.25, half + 0.004, 0.5],
            [front - 0.25, half + 0.004, 0.5],
            [front - 0.25, half + 0.004, 2.78],
            [rear + 0.25, half + 0.004, 2.78],
        ]
    )
    builder.both_sides(inset(side, 0.0, 0.0, 1.0, 0.09), trim, gloss=0.3, layer=2)
    builder.both_sides(inset(side, 0.02, 0.42, 0.98, 0.95), DARK, gloss=0.5, layer=2)
    for index in range(7):
        start = 0.03 + index * 0.135
        builder.both_sides(inset(side, start, 0.44, start + 0.125, 0.93), GLASS * 1.2, gloss=1.0, layer=3)
        builder.both_sides(inset(side, start, 0.80, start + 0.125, 0.93), GLASS * 1.9, gloss=0.9, layer=4)
    for start in (0.44, 0.87):
        door = inset(side, start, 0.03, start + 0.1, 0.93)
        builder.add(door, DARK, gloss=0.4, layer=5)
        for u in (0.06, 0.54):
            builder.add(inset(door, u, 0.04, u + 0.4, 0.96), GLASS * 1.3, gloss=1.0, layer=6)
    add_axles(builder, (rear + 3.0, front - 2.7), half, 0.48)
    add_bus_front(builder, front + 0.01, half)
    add_bus_rear(builder, rear - 0.01, half, braking, trim)
    for sign in (-1.0, 1.0):
        builder.part += 1
        inner, outer = sorted((sign * (half + 0.02), sign * (half + 0.22)))
        builder.box((front - 0.1, inner, 1.9), (front + 0.08, outer, 2.4), DARK)
    return builder.build()


def add_bus_front(builder: MeshBuilder, x: float, half: float) -> None:
    """Windscreen, destination display, lamps."""
    ahead = np.array([1.0, 0.0, 0.0])
    builder.add(end_patch(x, -half * 0.9, half * 0.9, 1.1, 2.45), GLASS, gloss=1.0, layer=2, normal=ahead)
    builder.add(end_patch(x, -0.012, 0.012, 1.1, 2.45), DARK, layer=3, normal=ahead)
    builder.add(end_patch(x, -half * 0.86, half * 0.86, 2.5, 2.86), DARK * 0.6, gloss=0.4, layer=2, normal=ahead)
    for index in range(8):
        y = -0.75 + index * 0.19
        builder.add(end_patch(x + 0.005, y, y + 0.12, 2.6, 2.77), bgr(240, 160, 40), glow=1.0, layer=3, normal=ahead)
    builder.add(end_patch(x, -half * 0.92, half * 0.92, 0.36, 0.58), DARK, layer=2, normal=ahead)
    for y in (-half * 0.74, half * 0.74):
        builder.add(end_patch(x, y - 0.22, y + 0.22, 0.66, 0.86), LAMP, glow=1.0, layer=3, normal=ahead)
    builder.add(end_patch(x + 0.005, -0.27, 0.27, 0.42, 0.54), PLATE, layer=4, normal=ahead)


def add_bus_rear(builder: MeshBuilder, x: float, half: float, braking: bool, trim: FloatArray) -> None:
    """Rear window, engine flap, lamps."""
    back = np.array([-1.0, 0.0, 0.0])
    builder.add(end_patch(x, -half * 0.82, half * 0.82, 1.75, 2.6), GLASS, gloss=0.9, layer=2, normal=back)
    builder.add(end_patch(x, -half * 0.7, half * 0.7, 0.75, 1.5), trim * 0.8, layer=2, normal=back)
    for z in np.arange(0.85, 1.4, 0.11):
        builder.add(end_patch(x - 0.005, -half * 0.6, half * 0.6, z, z + 0.035), DARK, layer=3, normal=back)
    builder.add(end_patch(x, -half * 0.93, half * 0.93, 0.36, 0.58), DARK, layer=2, normal=back)
    for y in (-half * 0.85, half * 0.85):
        for z in (0.75, 1.05):
            lamp = end_patch(x, y - 0.1, y + 0.1, z, z + 0.24)
            builder.add(lamp, TAIL_RED * (1.3 if braking else 0.85), glow=float(braking), layer=3, normal=back)
    builder.add(end_patch(x - 0.005, -0.27, 0.27, 0.6, 0.72), PLATE, layer=4, normal=back)
