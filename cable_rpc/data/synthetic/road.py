"""The road's centreline: a smooth plane curve with an arc-length parameter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

STEP_M = 0.5
START_M = -120.0


@dataclass(frozen=True, slots=True)
class Pose:
    """Position (world metres, y to the left of x) and heading (radians, counter-clockwise)."""

    x: float
    y: float
    heading: float

    def to_local(self, points: FloatArray) -> FloatArray:
        """World points [N, 2] or [N, 3] to (forward, right[, up])."""
        cosine, sine = math.cos(self.heading), math.sin(self.heading)
        dx, dy = points[:, 0] - self.x, points[:, 1] - self.y
        local = points.copy()
        local[:, 0] = cosine * dx + sine * dy
        local[:, 1] = sine * dx - cosine * dy
        return local

    def to_world(self, points: FloatArray) -> FloatArray:
        """Points (forward, right[, up]) [N, 2 or 3] to world axes."""
        cosine, sine = math.cos(self.heading), math.sin(self.heading)
        world = points.copy()
        world[:, 0] = self.x + cosine * points[:, 0] + sine * points[:, 1]
        world[:, 1] = self.y + sine * points[:, 0] - cosine * points[:, 1]
        return world


def road_arc(length_m: float) -> FloatArray:
    """Arc lengths, metres, at which a road of this drivable length is sampled."""
    return np.arange(START_M, length_m + 500.0, STEP_M)


class Road:
    """Centreline sampled every half metre; road coordinates are (s along, d to the right)."""

    def __init__(self, curvature: FloatArray) -> None:
        """Integrate a curvature, 1/m and positive to the left, given every `STEP_M` from `START_M` on."""
        self.arc = START_M + STEP_M * np.arange(len(curvature))
        self.curvature = curvature
        middle = (curvature[1:] + curvature[:-1]) / 2.0
        self.heading = np.concatenate([[0.0], np.cumsum(middle) * STEP_M])
        self.heading -= np.interp(0.0, self.arc, self.heading)
        half = (self.heading[1:] + self.heading[:-1]) / 2.0
        self.x = np.concatenate([[0.0], np.cumsum(np.cos(half)) * STEP_M])
        self.y = np.concatenate([[0.0], np.cumsum(np.sin(half)) * STEP_M])
        self.table = np.column_stack([self.x, self.y, self.heading, self.curvature])

    def curvature_at(self, s: float) -> float:
        """Curvature in 1/m, positive to the left."""
        return float(np.interp(s, self.arc, self.curvature))

    def pose(self, s: float, d: float = 0.0, turned: float = 0.0) -> Pose:
        """The pose at road coordinates (s, d), heading along the road plus `turned` radians."""
        index = min(max((s - START_M) / STEP_M, 0.0), len(self.arc) - 1.001)
        low = int(index)
        share = index - low
        heading = float(self.heading[low] + share * (self.heading[low + 1] - self.heading[low]))
        x = float(self.x[low] + share * (self.x[low + 1] - self.x[low]))
        y = float(self.y[low] + share * (self.y[low + 1] - self.y[low]))
        return Pose(x + d * math.sin(heading), y - d * math.cos(heading), heading + turned)

    def coordinates(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """World points [N, 2] to road coordinates s [N] and d [N], by the nearest centreline point."""
        centre = points.mean(axis=0)
        reach = float(np.abs(points - centre).max()) * 1.5 + 40.0
        gap = np.sqrt((self.x - centre[0]) ** 2 + (self.y - centre[1]) ** 2)
        near = np.flatnonzero(gap < max(reach, float(gap.min()) + reach))[::4]
        squared = (points[:, :1] - self.x[near]) ** 2 + (points[:, 1:] - self.y[near]) ** 2
        s = self.arc[near[np.argmin(squared, axis=1)]]
        d = np.zeros_like(s)
        for _ in range(3):
            index = np.clip((s - START_M) / STEP_M, 0.0, len(self.arc) - 1.001)
            low = index.astype(np.int64)
            share = index - low
            x, y, heading, curvature = self.table[low].T * (1.0 - share) + self.table[low + 1].T * share
            sine, cosine = np.sin(heading), np.cos(heading)
            dx, dy = points[:, 0] - x, points[:, 1] - y
            d = sine * dx - cosine * dy
            along = cosine * dx + sine * dy
            bend = np.maximum(1.0 + curvature * d, 0.4)
            s = s + np.clip(along / bend, -3.0, 3.0)
        return s, d
