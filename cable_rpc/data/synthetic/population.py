"""Who is in the world: traffic, parked vehicles, pedestrians and cyclists."""

from __future__ import annotations

import math

import numpy as np

from cable_rpc.data.synthetic.actors import (
    KIND_SHARES,
    Actor,
    Crosser,
    Cyclist,
    Placement,
    Vehicle,
    VehicleModel,
    Walker,
)
from cable_rpc.data.synthetic.people import draw_look
from cable_rpc.data.synthetic.road import Road
from cable_rpc.data.synthetic.scenario import Street
from cable_rpc.data.synthetic.traffic import Traffic

PARKED_SHARES = np.array([0.28, 0.2, 0.17, 0.19, 0.07, 0.09, 0.0, 0.0])
MODELS_PER_KIND = 4
NARROWEST_BAY = 0.8
"""Length of a parking bay on the inside of a bend, as a share of one on a straight."""


def populate(rng: np.random.Generator, street: Street, road: Road, traffic: Traffic, reach_m: float) -> list[Actor]:
    """All actors between s = -20 m and `reach_m`; track ids count from 1."""
    models = [[VehicleModel(rng, kind) for _ in range(MODELS_PER_KIND)] for kind in range(len(KIND_SHARES))]
    actors: list[Actor] = []
    nowhere = Placement(0.0, 0.0, 0.0, 0.0)
    for index in range(1, len(traffic.kind)):
        model = models[int(traffic.kind[index])][int(rng.integers(MODELS_PER_KIND))]
        actors.append(Vehicle(len(actors) + 1, model, traffic, index, nowhere))
    add_parked(rng, actors, street, road, traffic, models, reach_m)
    add_walkers(rng, actors, street, reach_m)
    add_crossers(rng, actors, street, traffic)
    add_cyclists(rng, actors, street, reach_m)
    return actors


def add_parked(
    rng: np.random.Generator,
    actors: list[Actor],
    street: Street,
    road: Road,
    traffic: Traffic,
    models: list[list[VehicleModel]],
    reach_m: float,
) -> None:
    """Cars in the parking lanes, clear of crossings."""
    if not street.parking:
        return
    place = street.road_half_width - street.parking / 2
    for side in (1, -1):
        for bay in np.arange(-18.0, reach_m, 6.0):
            if rng.random() > street.parked_share:
                continue
            s = float(bay + 3.0 + rng.uniform(-0.3, 0.3))
            if any(abs(crossing.s - s) < 8.0 for crossing in traffic.crossings):
                continue
            if 1.0 + road.curvature_at(s) * side * place < NARROWEST_BAY:
                continue
            kind = int(rng.choice(len(PARKED_SHARES), p=PARKED_SHARES))
            turned = (0.0 if side > 0 else math.pi) + float(rng.uniform(-0.03, 0.03))
            spot = Placement(s, side * (place + float(rng.uniform(-0.1, 0.1))), turned, 0.0)
            model = models[kind][int(rng.integers(MODELS_PER_KIND))]
            actors.append(Vehicle(len(actors) + 1, model, None, 0, spot))


def add_walkers(rng: np.random.Generator, actors: list[Actor], street: Street, reach_m: float) -> None:
    """People on the pavements, some in pairs, some standing."""
    inner = street.road_half_width + 0.6
    outer = inner + max(street.pavement - 1.0, 0.5)
    for side in (1, -1):
        for _ in range(int(rng.poisson(0.65 * street.walkers * (reach_m + 20.0) / 100.0))):
            s, d = float(rng.uniform(-20.0, reach_m)), side * float(rng.uniform(inner, outer))
            stands = rng.random() < 0.2
            speed = 0.0 if stands else float(rng.uniform(0.9, 1.7))
            direction = int(rng.choice([-1, 1]))
            for companion in range(2 if rng.random() < 0.3 else 1):
                offset = 0.55 * companion
                actors.append(
                    Walker(
                        len(actors) + 1,
                        draw_look(rng),
                        s + 0.2 * companion,
                        d + side * offset,
                        speed,
                        direction,
                        float(rng.uniform(-math.pi, math.pi)),
                    )
                )


def add_crossers(rng: np.random.Generator, actors: list[Actor], street: Street, traffic: Traffic) -> None:
    """Pedestrians who use the red phases."""
    kerb = street.road_half_width + 0.5
    for crossing in traffic.crossings:
        for start, _ in crossing.red:
            for _ in range(int(rng.integers(1, 5))):
                sign = float(rng.choice([-1.0, 1.0]))
                actors.append(
                    Crosser(
                        len(actors) + 1,
                        draw_look(rng),
                        crossing.s + float(rng.uniform(-1.2, 1.2)),
                        -sign * kerb,
                        sign * (kerb + 0.6),
                        start + float(rng.uniform(0.3, 1.8)),
                        float(rng.uniform(1.35, 1.9)),
                    )
                )


def add_cyclists(rng: np.random.Generator, actors: list[Actor], street: Street, reach_m: float) -> None:
    """Riders on both sides of the road."""
    d = street.lanes_each_way * street.lane_width + max(street.cycle_strip * 0.5, 0.35)
    for direction in (1, -1):
        s = float(rng.uniform(4.0, 30.0))
        while s < reach_m + 100.0:
            place = direction * (d + float(rng.uniform(-0.15, 0.2)))
            actors.append(Cyclist(len(actors) + 1, draw_look(rng), s, place, float(rng.uniform(3.6, 6.2)), direction))
            s += float(rng.uniform(18.0, 90.0))
