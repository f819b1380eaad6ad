"""Road users: who they are, where they are at a time, and how they are drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.camera import NEAR_PLANE_M
from cable_rpc.data.synthetic.heavy import (
    BUS_LENGTH,
    BUS_PAINTS,
    BUS_WIDTH,
    CARGO_PAINTS,
    TRUCK_LENGTH,
    TRUCK_WIDTH,
    build_bus,
    build_truck,
)
from cable_rpc.data.synthetic.mesh import Mesh
from cable_rpc.data.synthetic.occlusion import Occlusion, square
from cable_rpc.data.synthetic.people import Look, cycling_limbs, draw_limbs, draw_walker
from cable_rpc.data.synthetic.raster import Target, draw_mesh, object_axes
from cable_rpc.data.synthetic.road import Pose, Road
from cable_rpc.data.synthetic.shadows import rectangle
from cable_rpc.data.synthetic.traffic import Traffic
from cable_rpc.data.synthetic.vehicles import CAR_SHAPES, PAINTS, build_car

FloatArray = npt.NDArray[np.float64]

HIDES_M = 70.0
PERSON, BICYCLE, CAR, BUS, TRUCK = 0, 1, 2, 5, 7
VEHICLE_KINDS = ("hatch", "sedan", "estate", "suv", "van", "panel_van", "truck", "bus")
KIND_SHARES = np.array([0.22, 0.17, 0.13, 0.16, 0.07, 0.07, 0.11, 0.07])
CORNER_SHARES = np.array([0.25, 0.2, 0.15, 0.18, 0.09, 0.13, 0.0, 0.0])
"""Without what is too long to keep its lane in a tight corner."""
KIND_LENGTHS = np.array([4.05, 4.65, 4.7, 4.55, 5.0, 5.0, TRUCK_LENGTH, BUS_LENGTH])
KIND_CLASSES = (CAR, CAR, CAR, CAR, CAR, TRUCK, TRUCK, BUS)


@dataclass(frozen=True, slots=True)
class Placement:
    """Where an actor is: s and d in metres, turned against the road's direction in radians, speed in m/s."""

    s: float
    d: float
    turned: float
    speed: float


class Actor(Protocol):
    """Anything with a truth box."""

    track_id: int
    class_id: int
    footprint: tuple[float, float]
    """Length and width in metres."""
    height: float

    def place(self, time_s: float) -> Placement:
        """Where it is at a time."""
        ...

    def space(self, pose: Pose) -> tuple[FloatArray, float]:
        """Footprint [4, 2], world metres, and height that hold all of it at a pose."""
        ...

    def cover(self, target: Target, occlusion: Occlusion, pose: Pose) -> None:
        """Add what it covers of the image."""
        ...

    def draw(self, target: Target, pose: Pose, time_s: float, ident: int) -> float:
        """Draw it; returns its whole projected area in pixels."""
        ...


def box_corners(x: tuple[float, float], half: float, z: tuple[float, float]) -> FloatArray:
    """Corners [3, 8] of a box."""
    return np.array([[a, b, c] for a in x for b in (-half, half) for c in z]).T


def solid_blocks(name: str) -> tuple[FloatArray, ...]:
    """Convex bodies [3, N] that lie inside the drawn vehicle and hide what is behind them."""
    if name == "truck":
        rear, front = -TRUCK_LENGTH / 2, TRUCK_LENGTH / 2
        return (box_corners((rear + 0.15, front - 2.35), TRUCK_WIDTH / 2 - 0.2, (1.05, 3.3)),)
    if name == "bus":
        return (box_corners((-BUS_LENGTH / 2 + 0.15, BUS_LENGTH / 2 - 0.15), BUS_WIDTH / 2 - 0.2, (0.4, 2.9)),)
    shape = CAR_SHAPES["van" if name == "panel_van" else name]
    half, low = shape.width / 2 - 0.2, shape.clearance + 0.15
    sill = box_corners((shape.rear_base + 0.1, shape.front_base - 0.25), half, (low, shape.belt))
    roof = box_corners(
        (shape.rear_top + 0.05, shape.front_top - 0.05), shape.width / 2 * 0.76 - 0.05, (shape.belt, shape.roof - 0.1)
    )
    return (np.hstack([sill, roof]),)


class VehicleModel:
    """Kind, colours and meshes of one vehicle."""

    def __init__(self, rng: np.random.Generator, kind: int) -> None:
        self.kind = kind
        name = VEHICLE_KINDS[kind]
        paint = PAINTS[int(rng.integers(len(PAINTS)))] * float(rng.uniform(0.9, 1.05))
        second = CARGO_PAINTS[int(rng.integers(len(CARGO_PAINTS)))]
        third = PAINTS[int(rng.integers(len(PAINTS)))]
        bus_paint = BUS_PAINTS[int(rng.integers(len(BUS_PAINTS)))]

        self.blocks = solid_blocks(name)
        self.colours = (paint, second, third, bus_paint)
        self.built: dict[bool, Mesh] = {}
        width = {"truck": TRUCK_WIDTH, "bus": BUS_WIDTH}.get(name)
        shape = CAR_SHAPES.get("van" if name == "panel_van" else name)
        self.size = (float(KIND_LENGTHS[kind]), width if width is not None else shape.width if shape else 1.8)
        self.height = {"truck": 3.45, "bus": 3.07}.get(name, shape.roof if shape else 1.5)

    def mesh(self, braking: bool) -> Mesh:
        """The mesh with brake lamps on or off, built on first use."""
        if braking not in self.built:
            paint, second, third, bus_paint = self.colours
            name = VEHICLE_KINDS[self.kind]
            if name == "truck":
                self.built[braking] = build_truck(paint, second, braking, third)
            elif name == "bus":
                self.built[braking] = build_bus(bus_paint, third * 0.8, braking)
            else:
                style = "van" if name == "panel_van" else name
                self.built[braking] = build_car(style, paint, braking, panel_van=name == "panel_van")
        return self.built[braking]


class Vehicle:
    """A vehicle of the simulated traffic, or a parked one where `traffic` is None."""

    def __init__(
        self, track_id: int, model: VehicleModel, traffic: Traffic | None, index: int, parked: Placement
    ) -> None:
        self.track_id, self.model, self.traffic, self.index, self.parked = track_id, model, traffic, index, parked
        self.class_id = KIND_CLASSES[model.kind]
        self.footprint = model.size
        self.height = model.height

    def place(self, time_s: float) -> Placement:
        """Where it is at a time."""
        if self.traffic is None:
            return self.parked
        s, speed = self.traffic.at(time_s)
        oncoming = self.traffic.direction[self.index] < 0
        return Placement(
            float(s[self.index]),
            float(self.traffic.lateral[self.index]),
            math.pi if oncoming else 0.0,
            float(speed[self.index]),
        )

    def braking(self, time_s: float) -> bool:
        """Whether the brake lamps are on."""
        if self.traffic is None:
            return False
        now, before = self.place(time_s).speed, self.place(max(0.0, time_s - 0.2)).speed
        return now < 0.2 or now < before - 0.12

    def space(self, pose: Pose) -> tuple[FloatArray, float]:
        """Footprint [4, 2], world metres, and height that hold all of it at a pose."""
        length, width = self.footprint
        # Mirrors and bumpers stand out of the footprint.
        return pose.to_world(rectangle(length + 0.3, width + 0.7)), self.height + 0.2

    def cover(self, target: Target, occlusion: Occlusion, pose: Pose) -> None:
        """Add the inside of the body to what is covered, unless it is too small to hide anything."""
        reach = math.hypot(pose.x - target.ego.x, pose.y - target.ego.y)
        if reach > HIDES_M:
            return
        rotation, origin, _ = object_axes(target, pose)
        for block in self.model.blocks:
            points = (rotation @ block + origin[:, None]).T
            if points[:, 2].min() > NEAR_PLANE_M:
                pixels = target.camera.image_points(points).astype(np.float32)
                occlusion.cover(cv2.convexHull(pixels)[:, 0].astype(np.float64))

    def draw(self, target: Target, pose: Pose, time_s: float, ident: int) -> float:
        """Draw it."""
        return draw_mesh(target, self.model.mesh(self.braking(time_s)), pose, ident)


@dataclass(slots=True)
class Walker:
    """A pedestrian along the pavement, or standing where speed is 0."""

    track_id: int
    look: Look
    s: float
    d: float
    speed: float
    direction: int
    turned: float
    class_id: int = PERSON
    footprint: tuple[float, float] = (0.45, 0.45)
    height: float = 1.75

    def place(self, time_s: float) -> Placement:
        """Where it is at a time."""
        moved = self.s + self.direction * self.speed * time_s
        weave = 0.12 * math.sin(moved * 0.35 + self.track_id)
        turned = (0.0 if self.direction > 0 else math.pi) if self.speed else self.turned
        return Placement(moved, self.d + weave, turned, self.speed)

    def space(self, pose: Pose) -> tuple[FloatArray, float]:
        """Footprint [4, 2], world metres, and height that hold all of it at a pose."""
        return square(pose.x, pose.y, 0.8), self.height + 0.45

    def cover(self, target: Target, occlusion: Occlusion, pose: Pose) -> None:
        """It is too thin to hide anything."""

    def draw(self, target: Target, pose: Pose, time_s: float, ident: int) -> float:
        """Draw it."""
        phase = self.speed * time_s / (0.41 * self.look.height) * math.pi + self.track_id
        return draw_walker(target, self.look, phase, 1.0 if self.speed else 0.12, pose, ident)


@dataclass(slots=True)
class Crosser:
    """A pedestrian who waits at the kerb and crosses at a given time."""

    track_id: int
    look: Look
    s: float
    start_d: float
    stop_d: float
    start_s: float
    speed: float
    class_id: int = PERSON
    footprint: tuple[float, float] = (0.45, 0.45)
    height: float = 1.75

    def walked(self, time_s: float) -> float:
        """Metres walked so far."""
        return min(max(0.0, time_s - self.start_s) * self.speed, abs(self.stop_d - self.start_d))

    def place(self, time_s: float) -> Placement:
        """Where it is at a time."""
        walked = self.walked(time_s)
        sign = 1.0 if self.stop_d > self.start_d else -1.0
        moving = 0.0 < walked < abs(self.stop_d - self.start_d)
        return Placement(self.s, self.start_d + sign * walked, -sign * math.pi / 2, self.speed if moving else 0.0)

    def space(self, pose: Pose) -> tuple[FloatArray, float]:
        """Footprint [4, 2], world metres, and height that hold all of it at a pose."""
        return square(pose.x, pose.y, 0.8), self.height + 0.45

    def cover(self, target: Target, occlusion: Occlusion, pose: Pose) -> None:
        """It is too thin to hide anything."""

    def draw(self, target: Target, pose: Pose, time_s: float, ident: int) -> float:
        """Draw it."""
        walked = self.walked(time_s)
        moving = 0.0 < walked < abs(self.stop_d - self.start_d)
        phase = walked / (0.41 * self.look.height) * math.pi
        return draw_walker(target, self.look, phase, 1.0 if moving else 0.1, pose, ident)


@dataclass(slots=True)
class Cyclist:
    """A rider at the edge of the carriageway."""

    track_id: int
    look: Look
    s: float
    d: float
    speed: float
    direction: int
    class_id: int = BICYCLE
    footprint: tuple[float, float] = (1.75, 0.4)
    height: float = 1.75

    def place(self, time_s: float) -> Placement:
        """Where it is at a time."""
        s = self.s + self.direction * self.speed * time_s
        return Placement(s, self.d + 0.07 * math.sin(0.5 * s), 0.0 if self.direction > 0 else math.pi, self.speed)

    def space(self, pose: Pose) -> tuple[FloatArray, float]:
        """Footprint [4, 2], world metres, and height that hold all of it at a pose."""
        return square(pose.x, pose.y, 1.4), self.height + 0.45

    def cover(self, target: Target, occlusion: Occlusion, pose: Pose) -> None:
        """It is too thin to hide anything."""

    def draw(self, target: Target, pose: Pose, time_s: float, ident: int) -> float:
        """Draw it."""
        crank = self.speed * time_s / 0.34 * 0.42 + self.track_id
        return draw_limbs(target, cycling_limbs(self.look, crank), pose, ident)


def actor_pose(road: Road, placement: Placement) -> Pose:
    """World pose of a placement."""
    return road.pose(placement.s, placement.d, placement.turned)
