"""The shape of a drive: which bends the road has and whether the ego vehicle moves at all."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.road import Road, road_arc
from cable_rpc.data.synthetic.scenario import Street

FloatArray = npt.NDArray[np.float64]

CORNER_CURVATURES = (0.062, 0.080)
"""Curvature of a corner's centreline, 1/m."""
CORNER_PARKING_M = 2.2
CORNER_RAMP_M = 9.0
"""Length over which the curvature of a corner rises or falls."""
CORNER_INNER_RADIUS_M = 2.0
"""Smallest radius of the pavement's far edge on the inside of a corner."""


@dataclass(frozen=True, slots=True)
class Route:
    """One kind of drive."""

    name: str
    bends: bool = True
    corners: bool = False
    """Bends as tight as at street corners, one after the other."""
    stands: bool = False
    """The ego vehicle waits at a red light all the time."""
    lateral_mps2: float = 2.0
    """Lateral acceleration that drivers allow themselves in bends."""


STREETS_ROUTE = Route("streets")
ROUTES: Mapping[str, Route] = {
    route.name: route
    for route in (
        STREETS_ROUTE,
        Route("turns", corners=True, lateral_mps2=3.0),
        Route("straight", bends=False),
        Route("standstill", stands=True),
    )
}
TRAFFICS = ("normal", "none")


def street_on(route: Route, street: Street) -> Street:
    """The street as this route needs it: corners are narrower and busier, since each hides what lies beyond."""
    if not route.corners:
        return street
    return replace(
        street,
        lanes_each_way=1,
        parking=max(street.parking, CORNER_PARKING_M) if street.pavement else 0.0,
        parked_share=max(street.parked_share, 0.4),
        walkers=max(street.walkers, 10.0),
        traffic_gap=min(street.traffic_gap, 24.0),
        cruise_mps=min(street.cruise_mps, 9.0),
    )


def draw_road(rng: np.random.Generator, route: Route, street: Street, length_m: float) -> Road:
    """The road of a route, drivable for at least `length_m`."""
    if route.corners:
        return Road(corner_curvature(rng, street, length_m))
    return Road(bend_curvature(rng, length_m, street.turn_rad if route.bends else 0.0, street.straight_m))


def bend_curvature(rng: np.random.Generator, length_m: float, turn_rad: float, straight_m: float) -> FloatArray:
    """Alternating straights and wide bends, 1/m at the points of `road_arc(length_m)`.

    Args:
        rng: Source of all choices.
        length_m: Drivable length; the curve goes on straight for a while beyond it.
        turn_rad: Largest heading away from the main direction, which keeps the road free of loops.
        straight_m: Typical length of the straights.
    """
    arc = road_arc(length_m)
    curvature = np.zeros_like(arc)
    position, heading = float(rng.uniform(-30.0, 0.5 * straight_m)), 0.0
    while position < length_m + 300.0:
        target = float(rng.uniform(0.35, 1.0) * turn_rad) * (-1.0 if heading > 0 else 1.0)
        if abs(heading) < 1e-9 and rng.random() < 0.5:
            target = -target
        change = target - heading
        bend = max(18.0, abs(change) * float(rng.uniform(85.0, 140.0)))
        # A raised-cosine bend has a continuous curvature, so the yaw rate never jumps.
        inside = (arc >= position) & (arc < position + bend)
        phase = (arc[inside] - position) / bend
        curvature[inside] += change / bend * (1.0 - np.cos(2.0 * math.pi * phase))
        heading = target
        position += bend + float(rng.uniform(0.2, 0.8)) * straight_m
    return curvature


def corner_curvature(rng: np.random.Generator, street: Street, length_m: float) -> FloatArray:
    """Corners to the left and to the right in turn with short straights between, 1/m on `road_arc(length_m)`.

    Every heading stays within 60 degrees of the main direction, so the road never comes back to itself.
    """
    arc = road_arc(length_m)
    curvature = np.zeros_like(arc)
    widest = 1.0 / (street.road_half_width + street.pavement + CORNER_INNER_RADIUS_M)
    sign = float(rng.choice([-1.0, 1.0]))
    heading, position = -sign * float(rng.uniform(0.75, 1.0)), float(rng.uniform(-4.0, 8.0))
    while position < length_m + 300.0:
        target = sign * float(rng.uniform(0.75, 1.0))
        peak = min(float(rng.uniform(*CORNER_CURVATURES)), widest)
        # Both ramps together turn as much as one ramp's length at the peak.
        plateau = abs(target - heading) / peak - CORNER_RAMP_M
        along = np.minimum(arc - position, position + plateau + 2.0 * CORNER_RAMP_M - arc)
        ramp = np.clip(along / CORNER_RAMP_M, 0.0, 1.0)
        curvature += sign * peak * (1.0 - np.cos(math.pi * ramp)) / 2.0
        heading, sign = target, -sign
        position += plateau + 2.0 * CORNER_RAMP_M + float(rng.uniform(10.0, 24.0))
    return curvature
