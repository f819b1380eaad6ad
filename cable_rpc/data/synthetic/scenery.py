"""Everything that stands still beside the road."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.buildings import Building, build_building, hide_party_wall
from cable_rpc.data.synthetic.camera import Camera
from cable_rpc.data.synthetic.corners import fits, footprint, front_along, standing_room
from cable_rpc.data.synthetic.facades import Texture, facade, plain_wall
from cable_rpc.data.synthetic.furniture import Fixture, bin_or_box, bollard, lamp_post, sign
from cable_rpc.data.synthetic.occlusion import Occlusion
from cable_rpc.data.synthetic.raster import Target
from cable_rpc.data.synthetic.road import Pose, Road
from cable_rpc.data.synthetic.route import Route
from cable_rpc.data.synthetic.scenario import Light, Street, bgr
from cable_rpc.data.synthetic.shadows import ShadowLayer
from cable_rpc.data.synthetic.traffic import Crossing
from cable_rpc.data.synthetic.vegetation import Plant, Sprite, paint_bush, paint_tree

FloatArray = npt.NDArray[np.float64]

FACADES = 9
TREES = 5
BEGIN_M = -60.0
OPEN_STEP_M = 1.5
ROOFS = (bgr(146, 78, 56), bgr(92, 84, 82), bgr(120, 66, 52), bgr(70, 72, 78))


class Prop(Protocol):
    """A still object."""

    s: float

    @property
    def anchor(self) -> tuple[float, float, float]:
        """World x and y, and the distance in metres within which it is seen."""
        ...

    @property
    def shadow_reach(self) -> float:
        """How far its shadow may fall, metres."""
        ...

    def distance(self, ego: Pose, camera: Camera) -> float | None:
        """Sorting distance from the ego vehicle, None where it can't be seen."""
        ...

    def shadow(self, shadows: ShadowLayer) -> None:
        """Add its shadow."""
        ...

    @property
    def space(self) -> tuple[FloatArray, float]:
        """Footprint [4, 2], world metres, and height that hold all of it."""
        ...

    def prepare(self, target: Target, occlusion: Occlusion) -> Callable[[], None]:
        """Add what it covers of the image; returns what draws it."""
        ...


def build_scenery(
    rng: np.random.Generator,
    road: Road,
    street: Street,
    route: Route,
    light: Light,
    crossings: tuple[Crossing, ...],
    reach_m: float,
) -> list[Prop]:
    """All still objects along the road."""
    props: list[Prop] = []
    add_buildings(rng, props, road, street, route, reach_m)
    buildings = [prop for prop in props if isinstance(prop, Building)]
    add_plants(rng, props, road, street, light, reach_m)
    add_furniture(rng, props, road, street, light, crossings, reach_m)
    if not route.corners:
        return props
    # Inside a corner, what was placed beside one leg of the road may stand on the other.
    small = props[len(buildings) :]
    places = np.array([prop.anchor[:2] for prop in small]).reshape(-1, 2)
    free = standing_room(road, places, street.road_half_width + 0.3, buildings)
    return [*buildings, *(prop for prop, kept in zip(small, free, strict=True) if kept)]


def building_line(street: Street) -> float:
    """Distance of the building line from the centreline, metres."""
    return street.road_half_width + 0.16 + street.pavement + street.verge + street.building_gap


def add_buildings(
    rng: np.random.Generator, props: list[Prop], road: Road, street: Street, route: Route, reach_m: float
) -> None:
    """Terraces in town, single houses outside."""
    house = street.houses
    widths = rng.uniform(8.0, 12.0, FACADES) if house else rng.uniform(9.0, 18.0, FACADES)
    fronts: list[Texture] = [
        facade(
            rng,
            float(width),
            int(rng.integers(street.storeys[0], street.storeys[1] + 1)),
            bool(rng.random() < street.shops),
            house,
        )
        for width in widths
    ]
    depth = 8.0 if house else 12.0
    ends = [plain_wall(rng, depth, front.height_m) for front in fronts]
    backs = [plain_wall(rng, front.width_m, front.height_m) for front in fronts[:1]]
    line = building_line(street)
    if route.corners:
        line_corners(rng, props, road, street, fronts, ends, backs[0], reach_m)
        return
    for side in (1, -1):
        s = BEGIN_M + float(rng.uniform(0.0, 8.0))
        before: Building | None = None
        gap = math.inf
        while s < reach_m + 90.0:
            choice = int(rng.integers(FACADES))
            front, end = fronts[choice], ends[choice]
            middle = s + front.width_m / 2
            set_back = float(rng.uniform(0.0, 5.0)) if house else float(rng.choice([0.0, 0.0, 0.4, 1.0]))
            if street.name == "country":
                set_back += float(rng.uniform(0.0, 40.0))
            # The front looks back at the road: to the left of travel for a building on the right.
            pose = road.pose(middle, side * (line + set_back), side * math.pi / 2)
            roof = ROOFS[int(rng.integers(len(ROOFS)))] if house else None
            building = build_building(middle, pose, front.width_m, depth, front, end, backs[0], roof)
            props.append(building)
            if before is not None and not house:
                hide_party_wall(building, before, gap)
                hide_party_wall(before, building, gap)
            if street.name == "country":
                gap = float(rng.uniform(30.0, 120.0))
            elif house:
                gap = float(rng.uniform(3.0, 12.0))
            else:
                gap = float(rng.uniform(3.0, 9.0)) if rng.random() < 0.15 else 0.05
            s, before = s + front.width_m + gap, building


def line_corners(
    rng: np.random.Generator,
    props: list[Prop],
    road: Road,
    street: Street,
    fronts: list[Texture],
    ends: list[Texture],
    back: Texture,
    reach_m: float,
) -> None:
    """Buildings shoulder to shoulder around tight corners; where none fits, the corner stays open."""
    house = street.houses
    depth = 8.0 if house else 12.0
    line = building_line(street)
    built: list[Building] = []
    for side in (1, -1):
        s = BEGIN_M
        while s < reach_m + 90.0:
            choice = int(rng.integers(FACADES))
            front = fronts[choice]
            found = front_along(road, s, side, line, front.width_m)
            if found is None or not fits(road, footprint(found[0], front.width_m, depth), line, built):
                s += OPEN_STEP_M
                continue
            pose, stop = found
            roof = ROOFS[int(rng.integers(len(ROOFS)))] if house else None
            building = build_building((s + stop) / 2.0, pose, front.width_m, depth, front, ends[choice], back, roof)
            if built and not house:
                hide_party_wall(building, built[-1], 0.0)
                hide_party_wall(built[-1], building, 0.0)
            built.append(building)
            s = stop + (float(rng.uniform(2.0, 6.0)) if house else 0.0)
    props += built


def add_plants(
    rng: np.random.Generator, props: list[Prop], road: Road, street: Street, light: Light, reach_m: float
) -> None:
    """Street trees in a row, garden hedges, woods in the country."""
    trees = [paint_tree(rng, light) for _ in range(TREES)]
    bushes = [paint_bush(rng, light) for _ in range(3)]

    def plant(s: float, d: float, height: float, sprite: Sprite, crown: float) -> None:
        place = road.pose(s, d)
        props.append(Plant(s, place.x, place.y, height, sprite, crown))

    kerb = street.road_half_width + 0.16
    spacing = 100.0 / street.tree_density
    row = kerb + (street.pavement + 0.8 if street.verge else 0.9)
    for side in (1, -1):
        s = BEGIN_M + float(rng.uniform(0, spacing))
        while s < reach_m + 60.0:
            height = float(rng.uniform(5.5, 8.5))
            away = float(rng.exponential(9.0)) + 3.0 if street.name == "country" else float(rng.uniform(-0.2, 0.3))
            plant(s, side * (row + away), height, trees[int(rng.integers(TREES))], height * 0.3)
            s += spacing * float(rng.uniform(0.75, 1.25))
        if not street.houses:
            continue
        s = BEGIN_M
        hedge = row + 1.4 if street.name == "suburb" else row + 3.0
        while s < reach_m + 40.0:
            if rng.random() < (0.75 if street.name == "suburb" else 0.35):
                away = 0.0 if street.name == "suburb" else float(rng.uniform(0.0, 14.0))
                plant(s, side * (hedge + away), float(rng.uniform(1.0, 1.5)), bushes[int(rng.integers(3))], 0.7)
            s += 1.5 if street.name == "suburb" else float(rng.uniform(2.0, 9.0))
        for _ in range(int(reach_m / 6.0)):
            s, away = float(rng.uniform(BEGIN_M, reach_m + 120.0)), float(rng.uniform(24.0, 90.0))
            height = float(rng.uniform(6.0, 11.0))
            plant(s, side * (kerb + away), height, trees[int(rng.integers(TREES))], height * 0.3)


def add_furniture(
    rng: np.random.Generator,
    props: list[Prop],
    road: Road,
    street: Street,
    light: Light,
    crossings: tuple[Crossing, ...],
    reach_m: float,
) -> None:
    """Lamps, signs, markers, bins."""
    lamp, marker = lamp_post(light.lamps_on), bollard()
    signs = [sign(kind) for kind in range(5)]
    boxes = [bin_or_box(colour) for colour in (bgr(60, 84, 62), bgr(110, 112, 110), bgr(70, 74, 80))]
    kerb = street.road_half_width + 0.5
    for side in (1, -1):
        turned = 0.0 if side > 0 else math.pi
        if street.name != "country":
            for s in np.arange(BEGIN_M + float(rng.uniform(0, 25)), reach_m + 60.0, 28.0):
                # The arm reaches over the road: to the left of the heading `turned + pi`.
                place = road.pose(float(s), side * kerb, turned + math.pi)
                props.append(Fixture(float(s), place, lamp, 0.2, 7.6))
        else:
            for s in np.arange(BEGIN_M, reach_m + 60.0, 25.0):
                place = road.pose(float(s), side * (kerb + 0.3), 0.0)
                props.append(Fixture(float(s), place, marker, 0.12, 1.0))
        s = BEGIN_M + float(rng.uniform(0, 30))
        while s < reach_m + 60.0:
            kind = int(rng.choice([0, 1, 2, 4]))
            props.append(Fixture(s, road.pose(s, side * (kerb + 0.1), turned), signs[kind], 0.1, 2.8))
            if street.pavement and rng.random() < 0.7:
                s_box = s + float(rng.uniform(4.0, 12.0))
                place = road.pose(s_box, side * (kerb + 0.2), turned)
                props.append(Fixture(s_box, place, boxes[int(rng.integers(3))], 0.7, 1.2))
            s += float(rng.uniform(25.0, 60.0))
        for crossing in crossings:
            place = road.pose(crossing.s - side * 2.2, side * kerb, turned)
            props.append(Fixture(crossing.s, place, signs[3], 0.1, 2.8))
