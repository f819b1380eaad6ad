"""What stands beside a road of tight corners: fronts along the building line, and nothing on the carriageway."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.buildings import Building
from cable_rpc.data.synthetic.road import Pose, Road

FloatArray = npt.NDArray[np.float64]

WALK_M = 0.5
TRIED_CHORDS = 240
SHARED_GROUND_M2 = 12.0
"""How much neighbours at a kink may overlap behind their fronts."""
LINE_SLACK_M = 0.35


def front_along(road: Road, s: float, side: int, line: float, width: float) -> tuple[Pose, float] | None:
    """Where a front of a given width stands whose ends touch the building line.

    Args:
        road: The road.
        s: Where the front begins.
        side: +1 right of the road, -1 left.
        line: Distance of the building line from the centreline, metres.
        width: Width of the front, metres.

    Returns:
        The pose of the front's middle, which looks out to the road, and where the front ends along the road;
        None where the line folds back on itself.
    """
    first = road.pose(s, side * line)
    for step in range(1, TRIED_CHORDS):
        stop = s + step * WALK_M
        last = road.pose(stop, side * line)
        if math.hypot(last.x - first.x, last.y - first.y) < width:
            continue
        along = math.atan2(last.y - first.y, last.x - first.x)
        middle = road.pose((s + stop) / 2.0)
        if math.cos(along - middle.heading) < 0.5:
            return None
        x, y = first.x + width / 2 * math.cos(along), first.y + width / 2 * math.sin(along)
        # On the outside of a bend the front moves back until its middle keeps the line, too.
        _, d = road.coordinates(np.array([[x, y]]))
        back = max(0.0, line - abs(float(d[0])))
        outward = along + side * math.pi / 2
        return Pose(x - back * math.cos(outward), y - back * math.sin(outward), outward), stop
    return None


def footprint(pose: Pose, width: float, depth: float) -> FloatArray:
    """Corners [4, 2] of a building, world metres, and the middles of its sides [4, 2] after them."""
    half = width / 2
    corners = pose.to_world(np.array([[0.0, half], [0.0, -half], [-depth, -half], [-depth, half]]))
    return np.vstack([corners, (corners + np.roll(corners, -1, axis=0)) / 2.0])


def fits(road: Road, outline: FloatArray, line: float, built: list[Building]) -> bool:
    """Whether a building [8, 2] keeps the building line everywhere and leaves its neighbours standing."""
    _, d = road.coordinates(outline)
    if float(np.abs(d).min()) < line - LINE_SLACK_M:
        return False
    corners = outline[:4].astype(np.float32)
    return all(
        cv2.intersectConvexConvex(corners, other.outline.astype(np.float32))[0] <= SHARED_GROUND_M2 for other in built
    )


def standing_room(road: Road, places: FloatArray, nearest: float, buildings: list[Building]) -> npt.NDArray[np.bool_]:
    """Which of the world places [N, 2] are off the carriageway, `nearest` metres from the centreline, and outdoors."""
    _, d = road.coordinates(places)
    free: npt.NDArray[np.bool_] = np.abs(d) >= nearest
    for building in buildings:
        local = building.pose.to_local(places)
        # The pose's forward axis looks out of the front; the footprint lies behind it.
        ahead, aside = local[:, 0], np.abs(local[:, 1])
        size = building.pose.to_local(building.outline)
        free &= (ahead > 0.1) | (ahead < size[:, 0].min()) | (aside > np.abs(size[:, 1]).max())
    return free
