"""Polygon meshes in object axes: x forward, y right, z up, standing on z = 0."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Colour = FloatArray


@dataclass(frozen=True, slots=True)
class Mesh:
    """Convex planar faces with material and drawing order."""

    corners: FloatArray
    """[3, V], metres; every face has its own."""
    spans: tuple[tuple[int, int], ...]
    """First vertex of every face and the one after its last."""
    normals: FloatArray
    """[F, 3], outward."""
    centres: FloatArray
    offsets: FloatArray
    """[F], distance of the face's plane from the origin along its normal, metres."""
    colours: FloatArray
    """[F, 3], BGR albedo times 255."""
    gloss: FloatArray
    """[F], 0 matt, 1 glass or lacquer."""
    glow: FloatArray
    """[F], 1 where the face shines by itself."""
    layers: IntArray
    """[F], later layers lie on earlier ones of the same part."""
    parts: IntArray
    part_centres: FloatArray
    sizes: FloatArray
    """[F], shorter extent in metres; infinite on layer 0, which is never left out."""


@dataclass(slots=True)
class MeshBuilder:
    """Collects faces; every `add` takes the current part."""

    vertices: list[FloatArray] = field(default_factory=list)
    spans: list[tuple[int, int]] = field(default_factory=list)
    outward: list[tuple[FloatArray | None, FloatArray]] = field(default_factory=list)
    materials: list[tuple[Colour, float, float, int, int]] = field(default_factory=list)
    count: int = 0
    part: int = 0
    centre: FloatArray = field(default_factory=lambda: np.zeros(3))

    def add(
        self,
        polygon: FloatArray | Sequence[Sequence[float]],
        colour: Colour,
        *,
        gloss: float = 0.0,
        glow: float = 0.0,
        layer: int = 0,
        normal: FloatArray | None = None,
    ) -> None:
        """Add one face; without a normal it faces away from the builder's centre."""
        corners = np.asarray(polygon, dtype=np.float64)
        self.vertices.append(corners)
        self.spans.append((self.count, self.count + len(corners)))
        self.count += len(corners)
        self.outward.append((normal, self.centre))
        self.materials.append((colour, gloss, glow, layer, self.part))

    def both_sides(
        self, polygon: FloatArray, colour: Colour, *, gloss: float = 0.0, glow: float = 0.0, layer: int = 0
    ) -> None:
        """Add a face on the right side (+y) and its mirror image on the left."""
        flipped = np.asarray(polygon, dtype=np.float64) * np.array([1.0, -1.0, 1.0])
        self.add(polygon, colour, gloss=gloss, glow=glow, layer=layer)
        self.add(flipped, colour, gloss=gloss, glow=glow, layer=layer)

    def box(
        self, low: Sequence[float], high: Sequence[float], colour: Colour, *, gloss: float = 0.0, layer: int = 0
    ) -> None:
        """Add the six faces of an axis-aligned box."""
        held, (x0, y0, z0), (x1, y1, z1) = self.centre, low, high
        self.centre = (np.asarray(low) + np.asarray(high)) / 2.0
        for quad in (
            [[x0, y0, z0], [x0, y1, z0], [x0, y1, z1], [x0, y0, z1]],
            [[x1, y0, z0], [x1, y1, z0], [x1, y1, z1], [x1, y0, z1]],
            [[x0, y0, z0], [x1, y0, z0], [x1, y0, z1], [x0, y0, z1]],
            [[x0, y1, z0], [x1, y1, z0], [x1, y1, z1], [x0, y1, z1]],
            [[x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1]],
            [[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]],
        ):
            self.add(quad, colour, gloss=gloss, layer=layer)
        self.centre = held

    def loft(self, rings: Sequence[FloatArray], colour: Colour, *, gloss: float, layer: int = 0) -> None:
        """Skin consecutive rings [K, 3], right half from the bottom to the top; mirrored, ends closed."""
        full = [np.vstack([ring, ring[::-1] * np.array([1.0, -1.0, 1.0])]) for ring in rings]
        for one, two in pairwise(full):
            for k in range(len(one) - 1):
                self.add([one[k], one[k + 1], two[k + 1], two[k]], colour, gloss=gloss, layer=layer)
        for end, toward in ((full[0], -1.0), (full[-1], 1.0)):
            half = len(end) // 2
            for k in range(half - 1):
                quad = [end[k], end[k + 1], end[-k - 2], end[-k - 1]]
                self.add(quad, colour, gloss=gloss, layer=layer, normal=np.array([toward, 0.0, 0.0]))

    def disc(self, centre: Sequence[float], radius: float, colour: Colour, *, layer: int, gloss: float = 0.0) -> None:
        """Add a disc in a vertical plane along x, facing away from the middle of the object."""
        angle = np.linspace(0.0, 2.0 * math.pi, 15)[:-1]
        points = np.column_stack(
            [
                centre[0] + radius * np.cos(angle),
                np.full(14, centre[1]),
                centre[2] + radius * np.sin(angle),
            ]
        )
        side = np.array([0.0, math.copysign(1.0, centre[1]), 0.0])
        self.add(points, colour, gloss=gloss, layer=layer, normal=side)

    def build(self) -> Mesh:
        """The finished mesh."""
        most = max(map(len, self.vertices))
        padded = np.array([[*polygon, *[polygon[-1]] * (most - len(polygon))] for polygon in self.vertices])
        following = np.roll(padded, -1, axis=1)
        # Newell's normal is robust for slightly bent quadrilaterals; repeated corners add nothing to it.
        normals = np.stack(
            [
                ((padded[..., j] - following[..., j]) * (padded[..., k] + following[..., k])).sum(axis=1)
                for j, k in ((1, 2), (2, 0), (0, 1))
            ],
            axis=1,
        )
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
        centres = (padded.min(axis=1) + padded.max(axis=1)) / 2.0
        reference = np.array(
            [
                middle - centre if normal is None else normal
                for middle, (normal, centre) in zip(centres, self.outward, strict=True)
            ]
        )
        normals *= np.where((normals * reference).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        colours, gloss, glow, layers, parts = zip(*self.materials, strict=True)
        part_of = np.array(parts, dtype=np.int64)
        part_centres = np.array(
            [
                centres[part_of == part].mean(axis=0) if (part_of == part).any() else np.zeros(3)
                for part in range(int(part_of.max()) + 1)
            ]
        )
        return Mesh(
            np.ascontiguousarray(np.vstack(self.vertices).T),
            tuple(self.spans),
            normals,
            centres,
            (normals * centres).sum(axis=1),
            np.array(colours),
            np.array(gloss),
            np.array(glow),
            np.array(layers, dtype=np.int64),
            part_of,
            part_centres,
            np.where(np.array(layers) == 0, np.inf, np.sort(np.ptp(padded, axis=1), axis=1)[:, 1]),
        )


def inset(quad: FloatArray, u0: float, v0: float, u1: float, v1: float) -> FloatArray:
    """The sub-quadrilateral u0..u1 along the first edge, v0..v1 along the second, of corners [4, 3]."""
    a, b, c, d = quad

    def at(u: float, v: float) -> FloatArray:
        point: FloatArray = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * d + u * c)
        return point

    return np.array([at(u0, v0), at(u1, v0), at(u1, v1), at(u0, v1)])
