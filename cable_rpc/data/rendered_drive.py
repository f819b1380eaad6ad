"""The rendered world as a recording vehicle would have surveyed it: frames with poses and 3-D boxes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_rpc.data.cuboids import Cuboid
from cable_rpc.data.poses import rigid
from cable_rpc.data.synthetic import Camera, SyntheticConfig, SyntheticSource
from cable_rpc.data.synthetic.actors import Actor, Crosser, Cyclist, Vehicle, Walker, actor_pose
from cable_rpc.data.synthetic.people import Limb, cycling_limbs, walking_limbs
from cable_rpc.data.synthetic.road import Pose
from cable_rpc.types import Frame

FloatArray = npt.NDArray[np.float64]

GAIT_PHASES = 16
STANDING_STRIDE = 0.12
"""How far the feet of somebody who stands are drawn apart, as a share of a walker's stride."""
LEFT_FOR_RIGHT = np.diag([1.0, -1.0, 1.0])
"""From the renderer's object axes (forward, right, up) to those of data sets (forward, left, up) and back."""


@dataclass(frozen=True, slots=True)
class DriveFrame:
    """A rendered frame with its geometry in right-handed axes."""

    frame: Frame
    """As `SyntheticSource` gives it."""
    world_from_vehicle: FloatArray
    """float64 [4, 4]; world z up; vehicle x forward, y LEFT, z up, origin on the road under the camera, the point
    whose motion `frame.ego` tells."""
    vehicle_from_camera: FloatArray
    """float64 [4, 4]; camera in optical axes (x right, y down, z forward)."""
    cuboids: tuple[Cuboid, ...]
    """In vehicle axes; row by row those of `frame.truth`, with the same class and track ids."""


@dataclass(frozen=True, slots=True)
class RenderedDrive:
    """The drive of a `SyntheticConfig`, rendered anew by each iteration."""

    config: SyntheticConfig

    @property
    def name(self) -> str:
        """The source spec of the world."""
        return self.config.name

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.config.fps

    @property
    def size_wh(self) -> tuple[int, int]:
        """(width, height) of the frames in pixels."""
        return self.config.width, self.config.height

    def __iter__(self) -> Iterator[DriveFrame]:
        """Frames with index 0, 1, 2, ..."""
        source = SyntheticSource(self.config)
        actors = {actor.track_id: actor for actor in source.world.actors}
        extents: dict[int, FloatArray] = {}
        for frame in source:
            time_s = frame.index / source.fps
            ego = source.world.ego(time_s)[0]
            cuboids: list[Cuboid] = []
            for track_id in [] if frame.truth is None else frame.truth.track_ids.tolist():
                actor = actors[track_id]
                if track_id not in extents:
                    extents[track_id] = drawn_extent(actor)
                where = actor_pose(source.world.road, actor.place(time_s))
                cuboids.append(cuboid_at(actor, extents[track_id], where, ego))
            yield DriveFrame(frame, world_pose(ego), camera_pose(source.camera), tuple(cuboids))


def world_pose(pose: Pose) -> FloatArray:
    """world_from_vehicle, float64 [4, 4], of a pose on the plane."""
    cosine, sine = math.cos(pose.heading), math.sin(pose.heading)
    return rigid(np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]), (pose.x, pose.y, 0.0))


def camera_pose(camera: Camera) -> FloatArray:
    """vehicle_from_camera, float64 [4, 4], vehicle y left."""
    return rigid(LEFT_FOR_RIGHT @ camera.vehicle_to_camera.T, (0.0, 0.0, camera.mount_height_m))


def cuboid_at(actor: Actor, extent: FloatArray, where: Pose, ego: Pose) -> Cuboid:
    """The box of an actor at a world pose, in the axes (forward, left, up) of the vehicle at `ego`."""
    centre = where.to_world(extent.mean(axis=0)[None])
    forward, right, up = ego.to_local(centre)[0].tolist()
    length, width, height = np.diff(extent, axis=0)[0].tolist()
    yaw = math.remainder(where.heading - ego.heading, 2.0 * math.pi)
    return Cuboid((forward, -right, up), (length, width, height), yaw, actor.class_id, actor.track_id)


def drawn_extent(actor: Actor) -> FloatArray:
    """Lowest and highest corner, float64 [2, 3], of all that is ever drawn of an actor, in object axes.

    People are bounded over a whole turn of gait or crank, as annotators give one box size to a track.
    """
    phases = np.linspace(0.0, 2.0 * math.pi, GAIT_PHASES, endpoint=False).tolist()
    if isinstance(actor, Vehicle):
        corners = actor.model.mesh(braking=False).corners
        return np.stack([corners.min(axis=1), corners.max(axis=1)])
    if isinstance(actor, Cyclist):
        return limbs_extent([limb for crank in phases for limb in cycling_limbs(actor.look, crank)])
    if isinstance(actor, Walker | Crosser):
        stride = 1.0 if actor.speed else STANDING_STRIDE
        return limbs_extent([limb for phase in phases for limb in walking_limbs(actor.look, phase, stride)])
    length, width = actor.footprint
    return np.array([[-length / 2, -width / 2, 0.0], [length / 2, width / 2, actor.height]])


def limbs_extent(limbs: list[Limb]) -> FloatArray:
    """Lowest and highest corner, float64 [2, 3], of capsules and rings in object axes."""
    ends = np.array([point for limb in limbs for point in (limb.start, limb.stop)])
    radii = np.array(
        [
            radius * np.array([1.0, 0.0 if limb.ring else 1.0, 1.0])
            for limb in limbs
            for radius in (limb.start_radius, limb.stop_radius)
        ]
    )
    return np.stack([(ends - radii).min(axis=0), (ends + radii).max(axis=0)])
