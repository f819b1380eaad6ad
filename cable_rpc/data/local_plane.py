"""Latitude and longitude to metres on the plane that touches the earth, and back, for drives of some kilometres."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

SEMI_MAJOR_M = 6_378_137.0
ECCENTRICITY_SQUARED = 6.69437999014e-3
"""Of the WGS 84 ellipsoid."""


def metres_per_degree(latitude_deg: float) -> tuple[float, float]:
    """Metres to the north and to the east per degree of latitude and of longitude, by the radii of curvature."""
    latitude = math.radians(latitude_deg)
    bulge = 1.0 - ECCENTRICITY_SQUARED * math.sin(latitude) ** 2
    meridian = SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED) / bulge**1.5
    normal = SEMI_MAJOR_M / math.sqrt(bulge)
    return math.radians(meridian), math.radians(normal * math.cos(latitude))


def east_north_of(latitude_longitude_deg: FloatArray) -> FloatArray:
    """Metres east and north of the first point, float64 [N, 2], of points [N, 2] in degrees."""
    to_north, to_east = metres_per_degree(float(latitude_longitude_deg[0, 0]))
    away = latitude_longitude_deg - latitude_longitude_deg[0]
    return np.stack([away[:, 1] * to_east, away[:, 0] * to_north], axis=1)


def geodetic_of(east_north_m: FloatArray, origin_deg: tuple[float, float]) -> tuple[float, float]:
    """Latitude and longitude in degrees of a point [2] in metres east and north of an origin."""
    to_north, to_east = metres_per_degree(origin_deg[0])
    east, north = east_north_m.tolist()
    return origin_deg[0] + north / to_north, origin_deg[1] + east / to_east
