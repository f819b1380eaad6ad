"""What kind of street and weather a seed stands for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Street:
    """Cross-section and population of a street; all lengths in metres, densities per 100 m of one side."""

    name: str
    lane_width: float
    lanes_each_way: int
    cycle_strip: float
    parking: float
    pavement: float
    verge: float
    building_gap: float
    storeys: tuple[int, int]
    shops: float
    houses: bool
    yellow_centre: bool
    tree_density: float
    parked_share: float
    walkers: float
    traffic_gap: float
    cruise_mps: float
    crossing_gap: float
    turn_rad: float
    straight_m: float

    @property
    def road_half_width(self) -> float:
        """Centreline to kerb."""
        return self.lanes_each_way * self.lane_width + self.cycle_strip + self.parking

    def lane_centre(self, lane: int) -> float:
        """Distance from the centreline to the middle of a lane, 0 = innermost."""
        return (lane + 0.5) * self.lane_width


@dataclass(frozen=True, slots=True)
class Light:
    """Daylight: all colours BGR, 1.0 = the level that shows an albedo as it is."""

    name: str
    sun_direction: FloatArray
    """Unit vector to the sun in world axes."""
    sun: FloatArray
    sky: FloatArray
    bounce: FloatArray
    zenith: FloatArray
    horizon: FloatArray
    haze_m: float
    shadow: float
    cloudiness: float
    lamps_on: bool

    @property
    def ground(self) -> FloatArray:
        """Light that falls on level ground, BGR [3]."""
        return self.sky + self.sun * max(0.0, float(self.sun_direction[2]))


STREETS = (
    Street(
        "city", 3.2, 1, 1.3, 2.3, 3.2, 0.0, 0.2, (3, 6), 0.7, False, False, 2.5, 0.7, 9.0, 26.0, 9.0, 75.0, 0.8, 60.0
    ),
    Street(
        "boulevard",
        3.3,
        2,
        1.4,
        0.0,
        3.0,
        2.5,
        4.0,
        (4, 7),
        0.4,
        False,
        True,
        9.0,
        0.0,
        5.0,
        30.0,
        12.0,
        110.0,
        0.5,
        90.0,
    ),
    Street(
        "suburb",
        3.2,
        1,
        0.6,
        2.2,
        2.0,
        2.0,
        6.0,
        (2, 2),
        0.0,
        True,
        False,
        6.0,
        0.35,
        3.5,
        38.0,
        10.0,
        120.0,
        0.9,
        60.0,
    ),
    Street(
        "country",
        3.5,
        1,
        1.0,
        0.0,
        0.0,
        6.0,
        30.0,
        (1, 2),
        0.0,
        True,
        True,
        7.0,
        0.0,
        0.7,
        36.0,
        15.0,
        400.0,
        0.8,
        90.0,
    ),
)


def bgr(red: float, green: float, blue: float) -> FloatArray:
    """A BGR triple from red, green, blue."""
    return np.array([blue, green, red], dtype=np.float64)


def draw_light(rng: np.random.Generator, kind: str) -> Light:
    """Vary one of the kinds `sun`, `overcast`, `haze`, `dusk`."""
    azimuth = float(rng.uniform(-math.pi, math.pi))
    low = {"sun": 0.5, "overcast": 1.0, "haze": 0.5, "dusk": 0.16}[kind]
    elevation = low + float(rng.uniform(0.0, 0.35 if kind != "dusk" else 0.12))
    direction = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    if kind == "sun":
        return Light(
            kind,
            direction,
            bgr(0.86, 0.81, 0.70),
            bgr(0.60, 0.65, 0.72),
            bgr(0.42, 0.40, 0.37),
            bgr(62, 116, 190),
            bgr(196, 214, 232),
            900.0,
            0.5,
            float(rng.uniform(0.2, 0.6)),
            False,
        )
    if kind == "overcast":
        return Light(
            kind,
            direction,
            bgr(0.18, 0.18, 0.18),
            bgr(0.86, 0.89, 0.92),
            bgr(0.46, 0.46, 0.46),
            bgr(148, 156, 168),
            bgr(202, 208, 214),
            500.0,
            0.12,
            0.9,
            False,
        )
    if kind == "haze":
        return Light(
            kind,
            direction,
            bgr(0.58, 0.55, 0.48),
            bgr(0.68, 0.69, 0.69),
            bgr(0.42, 0.41, 0.39),
            bgr(150, 172, 196),
            bgr(216, 216, 210),
            260.0,
            0.3,
            0.5,
            False,
        )
    return Light(
        kind,
        direction,
        bgr(0.52, 0.36, 0.22),
        bgr(0.56, 0.55, 0.60),
        bgr(0.35, 0.32, 0.32),
        bgr(54, 68, 108),
        bgr(206, 158, 122),
        450.0,
        0.25,
        0.6,
        True,
    )


def draw_scenario(seed: int) -> tuple[Street, Light]:
    """The street and the light of a seed; neighbouring seeds walk through all streets."""
    rng = np.random.default_rng([seed, 11])
    street = STREETS[seed % len(STREETS)]
    kind = str(rng.choice(["sun", "sun", "overcast", "haze", "dusk"]))
    return street, draw_light(rng, kind)
