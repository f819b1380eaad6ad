"""Longitudinal motion of the ego vehicle and all traffic: intelligent-driver model with red phases.

Car following is Treiber, Hennecke and Helbing (2000), "Congested traffic states in empirical observations
and microscopic simulations".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.road import STEP_M, Road
from cable_rpc.data.synthetic.route import Route
from cable_rpc.data.synthetic.scenario import Street

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

TIME_STEP_S = 0.05
STOP_DISTANCE_M = 3.5
FOLLOW_GAP_M = 2.5
HEADWAY_S = 1.4
ACCELERATION = 1.6
DECELERATION = 2.4
CORNER_BRAKING = 1.8
"""Deceleration with which drivers approach a corner, m/s²."""
RED_LIGHT_M = 6.2
"""Where the crossing lies at which the ego vehicle stands."""
CLEAR_OF_LIGHT_M = 30.0


@dataclass(slots=True)
class Crossing:
    """A zebra crossing; `red` lists the (start, end) seconds in which traffic waits."""

    s: float
    stops_ego: bool
    hold_s: float
    red: list[tuple[float, float]] = field(default_factory=list)

    def is_red(self, time_s: float) -> bool:
        """Whether traffic must wait."""
        return any(start <= time_s < end for start, end in self.red)


@dataclass(frozen=True, slots=True)
class Traffic:
    """Sampled trajectories; vehicle 0 is the ego vehicle."""

    s: FloatArray
    """[steps, vehicles], metres along the centreline."""
    speed: FloatArray
    """[steps, vehicles], m/s along the own lane."""
    lateral: FloatArray
    """[vehicles], metres right of the centreline."""
    direction: IntArray
    """[vehicles], +1 with the ego vehicle, -1 oncoming."""
    kind: IntArray
    """[vehicles], index into the vehicle models."""
    crossings: tuple[Crossing, ...]

    def at(self, time_s: float) -> tuple[FloatArray, FloatArray]:
        """Positions s [vehicles] and speeds [vehicles] at a time, linear between the steps."""
        index = min(max(time_s / TIME_STEP_S, 0.0), len(self.s) - 1.001)
        low = int(index)
        share = index - low
        s = self.s[low] + share * (self.s[low + 1] - self.s[low])
        return s, self.speed[low] + share * (self.speed[low + 1] - self.speed[low])


def place_crossings(rng: np.random.Generator, street: Street, length_m: float) -> tuple[Crossing, ...]:
    """Zebra crossings along the road, some of which will make the ego vehicle wait."""
    crossings = []
    hold = 2.0 * street.road_half_width / 1.7
    s = float(rng.uniform(0.35, 0.8)) * street.crossing_gap
    while s < length_m + 200.0:
        crossings.append(Crossing(s, bool(rng.random() < 0.6), hold + float(rng.uniform(0.5, 2.0))))
        if rng.random() < 0.35 and s > 60.0:
            crossings[-1].red.append((-1.0, float(rng.uniform(2.0, 5.0))))
        s += float(rng.uniform(0.7, 1.3)) * street.crossing_gap
    return tuple(crossings)


def crossings_on(
    rng: np.random.Generator, road: Road, street: Street, route: Route, duration_s: float
) -> tuple[Crossing, ...]:
    """Zebra crossings of a route and the red phases that don't depend on the ego vehicle's arrival."""
    crossings = place_crossings(rng, street, duration_s * street.cruise_mps * 1.15)
    if route.stands:
        for crossing in crossings:
            crossing.stops_ego = False
        return (red_light(rng, street, duration_s), *(other for other in crossings if other.s > CLEAR_OF_LIGHT_M))
    if route.corners:
        straight = [c for c in crossings if np.abs(road.curvature[np.abs(road.arc - c.s) < 5.0]).max() < 0.01]
        return tuple(Crossing(crossing.s, False, crossing.hold_s) for crossing in straight)
    return crossings


def red_light(rng: np.random.Generator, street: Street, duration_s: float) -> Crossing:
    """The crossing at which the ego vehicle stands while others walk and drive by turns."""
    hold = 2.0 * street.road_half_width / 1.7 + float(rng.uniform(0.5, 2.0))
    crossing = Crossing(RED_LIGHT_M, False, hold)
    start = -float(rng.uniform(1.0, 0.5 * hold))
    while start < duration_s:
        crossing.red.append((start, start + hold))
        start += hold + float(rng.uniform(4.0, 7.0))
    return crossing


def place_vehicles(
    rng: np.random.Generator, street: Street, reach_m: float, lengths: FloatArray, shares: FloatArray
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """Start positions s, lateral places, directions and kinds; the first row is the ego vehicle."""
    ego_lane = int(rng.integers(0, street.lanes_each_way))
    rows: list[tuple[float, float, int, int]] = [(0.0, street.lane_centre(ego_lane), 1, 0)]
    for lane in range(street.lanes_each_way):
        for direction in (1, -1):
            if direction == 1 and lane == ego_lane:
                s, stop = float(rng.uniform(14.0, 34.0)), 190.0
            else:
                s, stop = float(rng.uniform(-30.0, 12.0)), 190.0 if direction == 1 else reach_m
            while s < stop:
                kind = int(rng.choice(len(lengths), p=shares))
                s += lengths[kind] / 2
                rows.append((s, direction * street.lane_centre(lane), direction, kind))
                s += lengths[kind] / 2 + float(rng.uniform(0.35, 1.6)) * street.traffic_gap
    table = np.array(rows)
    return table[:, 0], table[:, 1], table[:, 2].astype(np.int64), table[:, 3].astype(np.int64)


def simulate(
    rng: np.random.Generator,
    road: Road,
    street: Street,
    route: Route,
    duration_s: float,
    lengths: FloatArray,
    shares: FloatArray,
) -> Traffic:
    """Run the whole clip once; every frame then reads its instant from the result."""
    travel = duration_s * street.cruise_mps * 1.15
    crossings = crossings_on(rng, road, street, route, duration_s)
    s, lateral, direction, kind = place_vehicles(rng, street, 2.0 * travel + 260.0, lengths, shares)
    count = len(s)
    wanted = street.cruise_mps * rng.uniform(0.75, 1.1, count)
    wanted[0] = street.cruise_mps * 1.1
    length = lengths[kind]
    speed = np.minimum(wanted, street.cruise_mps * rng.uniform(0.6, 1.0, count))
    limits = bend_limits(road, route, lateral, direction)
    if route.corners:
        speed = np.minimum(speed, limits(s))
    if route.stands:
        speed[0] = 0.0
    ahead = leaders(s, lateral, direction)
    steps = int(duration_s / TIME_STEP_S) + 3
    history_s, history_v = np.empty((steps, count)), np.empty((steps, count))
    for step in range(steps):
        history_s[step], history_v[step] = s, speed
        time_s = step * TIME_STEP_S
        update_lights(crossings, time_s, float(s[0]))
        leader = np.maximum(ahead, 0)
        gap = np.where(ahead >= 0, direction * (s[leader] - s) - (length + length[leader]) / 2, 500.0)
        closing = np.where(ahead >= 0, speed - speed[leader], 0.0)
        acceleration = follow(speed, np.minimum(wanted, limits(s)), gap, closing)
        for crossing in crossings:
            if crossing.is_red(time_s):
                line = direction * (crossing.s - s) - STOP_DISTANCE_M - length / 2
                waits = (line > -0.5) & (line > speed**2 / (2.0 * 5.0) - 1.0) & (line < 60.0)
                braking = follow(speed, wanted, line + 1.5, speed)
                acceleration = np.where(waits, np.minimum(acceleration, braking), acceleration)
        faster = np.maximum(speed + np.clip(acceleration, -7.0, ACCELERATION) * TIME_STEP_S, 0.0)
        faster[faster < 0.02] = 0.0
        if route.stands:
            faster[0] = 0.0
        mean_speed = (speed + faster) / 2.0
        # A lane right of the centreline is longer in a left bend: ds/dt = v / (1 + curvature * d).
        stretch = 1.0 + np.interp(s, road.arc, road.curvature) * lateral
        s = s + direction * mean_speed / stretch * TIME_STEP_S
        speed = faster
    return Traffic(history_s, history_v, lateral, direction, kind, crossings)


def leaders(s: FloatArray, lateral: FloatArray, direction: IntArray) -> IntArray:
    """Index of the vehicle ahead in the same lane, -1 where there is none."""
    ahead = np.full(len(s), -1, dtype=np.int64)
    for lane in np.unique(lateral):
        members = np.flatnonzero(lateral == lane)
        ordered = members[np.argsort(s[members] * direction[members])]
        ahead[ordered[:-1]] = ordered[1:]
    return ahead


def update_lights(crossings: tuple[Crossing, ...], time_s: float, ego_s: float) -> None:
    """Begin a red phase when the ego vehicle comes near a crossing that is to stop it."""
    for crossing in crossings:
        near = 18.0 < crossing.s - ego_s < 42.0
        if crossing.stops_ego and near and not any(start >= 0.0 for start, _ in crossing.red):
            crossing.red.append((time_s, time_s + crossing.hold_s))


def bend_limits(
    road: Road, route: Route, lateral: FloatArray, direction: IntArray
) -> Callable[[FloatArray], FloatArray]:
    """Speed limits of all vehicles in bends, m/s, as a function of their places s [vehicles]."""
    if not route.corners:
        return lambda s: cornering_speed(np.abs(np.interp(s, road.arc, road.curvature)), route.lateral_mps2)
    lanes = [(np.flatnonzero(lateral == lane), float(lane)) for lane in np.unique(lateral)]
    profiles = [
        (members, braking_profile(road, route.lateral_mps2, lane, int(direction[members[0]])))
        for members, lane in lanes
    ]

    def limits(s: FloatArray) -> FloatArray:
        limit = np.empty_like(s)
        for members, profile in profiles:
            limit[members] = np.interp(s[members], road.arc, profile)
        return limit

    return limits


def cornering_speed(curvature: FloatArray, lateral_mps2: float) -> FloatArray:
    """Speed at which a path of this curvature, 1/m, takes the given lateral acceleration."""
    speed: FloatArray = np.sqrt(lateral_mps2 / np.maximum(curvature, 1e-4))
    return speed


def braking_profile(road: Road, lateral_mps2: float, lateral: float, direction: int) -> FloatArray:
    """Speed along one lane that leaves room to brake for every bend ahead, m/s at the points of the road."""
    squared = cornering_speed(np.abs(road.curvature / (1.0 + road.curvature * lateral)), lateral_mps2)[::direction] ** 2
    braking = 2.0 * CORNER_BRAKING * STEP_M * np.arange(len(squared))
    # v(s)^2 <= v(t)^2 + 2 b (t - s) for every t ahead of s.
    reachable = np.minimum.accumulate((squared + braking)[::-1])[::-1] - braking
    profile: FloatArray = np.sqrt(reachable)[::direction]
    return profile


def follow(speed: FloatArray, wanted: FloatArray, gap: FloatArray, closing: FloatArray) -> FloatArray:
    """Intelligent-driver acceleration in m/s²."""
    braking = speed * closing / (2.0 * (ACCELERATION * DECELERATION) ** 0.5)
    desired = FOLLOW_GAP_M + np.maximum(0.0, speed * HEADWAY_S + braking)
    result: FloatArray = ACCELERATION * (
        1.0 - (speed / np.maximum(wanted, 0.1)) ** 4 - (desired / np.maximum(gap, 0.3)) ** 2
    )
    return result
