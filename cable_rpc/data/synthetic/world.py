"""The world of one seed and its pictures."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from cable_rpc.data.synthetic.actors import CORNER_SHARES, KIND_LENGTHS, KIND_SHARES, actor_pose
from cable_rpc.data.synthetic.camera import Camera
from cable_rpc.data.synthetic.ground import Ground
from cable_rpc.data.synthetic.groundpaint import GroundPainter
from cable_rpc.data.synthetic.occlusion import Occlusion, image_bounds
from cable_rpc.data.synthetic.population import populate
from cable_rpc.data.synthetic.raster import Target
from cable_rpc.data.synthetic.render import Drawn, collect_truth
from cable_rpc.data.synthetic.road import Pose
from cable_rpc.data.synthetic.route import Route, draw_road, street_on
from cable_rpc.data.synthetic.scenario import draw_scenario
from cable_rpc.data.synthetic.scenery import Prop, build_scenery
from cable_rpc.data.synthetic.sensor import Sensor
from cable_rpc.data.synthetic.shadows import SHADOWS_M, ShadowLayer
from cable_rpc.data.synthetic.sky import Sky
from cable_rpc.data.synthetic.traffic import simulate
from cable_rpc.types import EgoMotion, GroundTruth, Image

VIEW_AHEAD_M = 170.0
ACTORS_AHEAD_M = 105.0
VIEW_BEHIND_M = 14.0
Entry = tuple[float, int, Prop | None, int, Pose]
"""Distance, place among the props or the actors, the prop or None, identity, pose."""
SKYLINES_RAD = {"city": 0.05, "boulevard": 0.05, "suburb": 0.035, "country": 0.03}


class World:
    """Everything that is fixed by the seed; `render` is a pure function of time."""

    def __init__(
        self,
        seed: int,
        camera: Camera,
        duration_s: float,
        route: Route,
        peopled: bool,
        noise: float,
        blur: float,
        vignette: float,
    ) -> None:
        self.camera = camera
        street, self.light = draw_scenario(seed)
        self.street = street_on(route, street)
        rng = np.random.default_rng([seed, 1])
        travel = duration_s * self.street.cruise_mps * 1.15
        self.road = draw_road(rng, route, self.street, travel + 60.0)
        self.traffic = simulate(
            rng,
            self.road,
            self.street,
            route,
            duration_s,
            KIND_LENGTHS,
            CORNER_SHARES if route.corners else KIND_SHARES,
        )
        self.reach_m = float(self.traffic.s[-1, 0]) + VIEW_AHEAD_M + 10.0
        self.actors = populate(rng, self.street, self.road, self.traffic, self.reach_m)
        painter = GroundPainter(rng, self.road, self.street, self.light, self.traffic.crossings)
        self.ground = Ground(camera, painter)
        self.sky = Sky(rng, camera, self.light, SKYLINES_RAD[self.street.name])
        self.props: list[Prop] = build_scenery(
            rng, self.road, self.street, route, self.light, self.traffic.crossings, self.reach_m
        )
        # Only now: with and without traffic, the drive and the scenery are the same.
        if not peopled:
            self.actors = []
        self.anchors = np.array([[*prop.anchor, prop.shadow_reach, prop.s] for prop in self.props]).reshape(-1, 5).T
        self.spaces = [prop.space for prop in self.props]
        self.sensor = Sensor(seed, camera.width, camera.height, noise, blur, vignette)

    def ego(self, time_s: float) -> tuple[Pose, EgoMotion]:
        """Pose and motion of the ego vehicle at a time."""
        s, speed = self.traffic.at(time_s)
        d = float(self.traffic.lateral[0])
        curvature = self.road.curvature_at(float(s[0]))
        yaw_rate = float(speed[0]) * curvature / (1.0 + curvature * d)
        return self.road.pose(float(s[0]), d), EgoMotion(float(speed[0]), 0.0, yaw_rate)

    def may_be_seen(self, ego: Pose, where: Pose, reach_m: float) -> bool:
        """Whether something within `reach_m` of a pose can be in the horizontal field of view."""
        forward, right = ego.to_local(np.array([[where.x, where.y]]))[0]
        half = self.camera.width / (2.0 * self.camera.intrinsics.fx)
        return bool(forward > -reach_m and abs(right) < half * max(forward, 0.0) + 1.5 * reach_m)

    def nearby(self, ego: Pose, ego_s: float) -> tuple[list[int], list[int]]:
        """Indices of the props that may be seen and of those whose shadow may be seen."""
        x, y, reach, shadow_reach, s = self.anchors
        cosine, sine = math.cos(ego.heading), math.sin(ego.heading)
        forward = cosine * (x - ego.x) + sine * (y - ego.y)
        aside = np.abs(sine * (x - ego.x) - cosine * (y - ego.y))
        along = (s > ego_s - 40.0) & (s < ego_s + VIEW_AHEAD_M + 40.0)
        half = self.camera.width / (2.0 * self.camera.intrinsics.fx) * 1.05
        wedge = half * np.maximum(forward, 0.0)
        seen = along & (forward > -reach) & (aside < wedge + 2.0 * reach)
        margin = 2.0 * shadow_reach + reach
        shadowing = along & (forward > -margin) & (forward < SHADOWS_M + margin) & (aside < wedge + margin)
        return np.flatnonzero(seen).tolist(), np.flatnonzero(shadowing).tolist()

    def in_sight(self, target: Target, queue: list[Entry]) -> list[tuple[Callable[[], None] | None, int, Pose]]:
        """The entries, given far to near, that nearer ones don't hide; what draws a prop, None for an actor."""
        if not queue:
            return []
        spaces = [
            self.spaces[place] if prop is not None else self.actors[place].space(where)
            for _, place, prop, _, where in queue
        ]
        footprints, heights = np.array([space[0] for space in spaces]), np.array([space[1] for space in spaces])
        bounds = image_bounds(target.camera, target.ego, footprints, heights)
        occlusion = Occlusion(target.camera)
        kept: list[tuple[Callable[[], None] | None, int, Pose]] = []
        for (_, place, prop, ident, where), (x0, y0, x1, y1) in zip(reversed(queue), reversed(bounds), strict=True):
            if occlusion.hides((x0, y0, x1, y1)):
                continue
            if prop is not None:
                kept.append((prop.prepare(target, occlusion), ident, where))
                continue
            self.actors[place].cover(target, occlusion, where)
            kept.append((None, ident, where))
        return kept[::-1]

    def render(self, time_s: float, index: int) -> tuple[Image, GroundTruth]:
        """The camera frame and its truth at a time; `index` chooses the sensor noise."""
        camera, pose = self.camera, self.ego(time_s)[0]
        image = np.zeros((camera.height, camera.width, 3), np.uint8)
        target = Target(image, np.zeros((camera.height, camera.width), np.int32), camera, self.light, pose)
        self.sky.render(image, pose.heading)
        self.ground.render(image, pose)
        ego_s = float(self.traffic.at(time_s)[0][0])
        shadows = ShadowLayer(target)
        queue: list[Entry] = []
        seen, shadowing = self.nearby(pose, ego_s)
        for place in seen:
            distance = self.props[place].distance(pose, camera)
            if distance is not None:
                queue.append((distance, place, self.props[place], 0, pose))
        for place in shadowing:
            self.props[place].shadow(shadows)
        for number, actor in enumerate(self.actors):
            placement = actor.place(time_s)
            if not ego_s - VIEW_BEHIND_M < placement.s < ego_s + ACTORS_AHEAD_M:
                continue
            where = actor_pose(self.road, placement)
            distance = math.hypot(where.x - pose.x, where.y - pose.y)
            if self.may_be_seen(pose, where, max(actor.footprint)):
                queue.append((distance, number, None, number + 1, where))
            shadows.add_box(where, *actor.footprint, actor.height)
        shadows.apply()
        queue.sort(key=lambda entry: (-entry[0], entry[3], entry[1]))
        drawn: list[Drawn] = []
        for draw, ident, where in self.in_sight(target, queue):
            if draw is not None:
                draw()
            else:
                actor = self.actors[ident - 1]
                drawn.append(Drawn(actor, ident, actor.draw(target, where, time_s, ident)))
        return self.sensor.expose(image, index), collect_truth(target.ids, drawn, target.windows)
