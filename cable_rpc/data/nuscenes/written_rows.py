"""Rows of nuScenes' tables as the writer of small data sets fills them in."""

from __future__ import annotations

import hashlib
import json
import math
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cable_rpc.data.cuboids import Cuboid
from cable_rpc.data.poses import quaternion_from_rotation, rigid
from cable_rpc.errors import SourceError

if TYPE_CHECKING:
    from cable_rpc.data.rendered_drive import DriveFrame

Row = dict[str, Any]

LEVELS = ((0.4, "v0-40"), (0.6, "v40-60"), (0.8, "v60-80"), (1.0, "v80-100"))
"""Upper bound of the visible share and level; the token is the level's place, counted from 1."""
CAN_PERIOD_US = 20_000


def calibration_row(driven: DriveFrame) -> Row:
    """The camera of a frame as a row of calibrated_sensor, without its token.

    Raises:
        SourceError: the frame has no intrinsics.
    """
    k = driven.frame.intrinsics
    if k is None:
        raise SourceError(f"frame {driven.frame.index} has no intrinsics to write")
    matrix = [[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]]
    return {"sensor_token": token("sensor"), "camera_intrinsic": matrix, **pose(driven.vehicle_from_camera)}


def pose(matrix: npt.NDArray[np.float64]) -> Row:
    """A rigid transform [4, 4] as translation and rotation."""
    return {"translation": matrix[:3, 3].tolist(), "rotation": quaternion_from_rotation(matrix[:3, :3]).tolist()}


def world_pose(cuboid: Cuboid, driven: DriveFrame) -> Row:
    """Translation and rotation of a vehicle's cuboid in the map's axes."""
    cosine, sine = math.cos(cuboid.yaw_rad), math.sin(cuboid.yaw_rad)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return pose(driven.world_from_vehicle @ rigid(turn, cuboid.centre_m))


def can_message(driven: DriveFrame, time_us: int) -> Row:
    """A frame's ego-motion as a pose message.

    Raises:
        SourceError: the frame has no ego-motion.
    """
    ego = driven.frame.ego
    if ego is None:
        raise SourceError(f"frame {driven.frame.index} has no ego-motion to write")
    place = pose(driven.world_from_vehicle)
    return {
        "utime": time_us,
        "pos": place["translation"],
        "orientation": place["rotation"],
        "vel": [ego.speed_mps, -ego.lateral_mps, 0.0],
        "accel": [0.0, 0.0, 9.8],
        "rotation_rate": [0.0, 0.0, ego.yaw_rate_radps],
    }


def messages_at_50_hz(messages: list[Row]) -> list[Row]:
    """Messages of frames, interpolated to the rate of the CAN bus; orientations are those of the frame before."""
    times = [message["utime"] for message in messages]
    wanted = list(range(times[0], times[-1] + 1, CAN_PERIOD_US))
    before = np.searchsorted(times, wanted, side="right") - 1
    rows = [{**messages[place], "utime": time} for place, time in zip(before.tolist(), wanted, strict=True)]
    for key in ("pos", "vel", "rotation_rate"):
        columns = np.array([message[key] for message in messages]).T
        values = np.stack([np.interp(np.array(wanted) - times[0], np.array(times) - times[0], c) for c in columns], 1)
        for row, value in zip(rows, values.tolist(), strict=True):
            row[key] = value
    return rows


def visibility_token(share: float) -> str:
    """Token of the level that a visible share falls into."""
    return str(next((place for place, (bound, _) in enumerate(LEVELS, 1) if share < bound), len(LEVELS)))


def chain(rows: list[Row]) -> None:
    """Fill ``prev`` and ``next`` of rows in order of time."""
    rows[0]["prev"] = rows[-1]["next"] = ""
    for before, after in pairwise(rows):
        before["next"], after["prev"] = after["token"], before["token"]


def token(*parts: str | int) -> str:
    """A token of 32 hexadecimal digits, the same for the same parts."""
    return hashlib.sha256("/".join(map(str, parts)).encode()).hexdigest()[:32]


def write_json(path: Path, rows: list[Row]) -> None:
    """Write rows as the original tables are written, a value per line."""
    made(path).write_text(json.dumps(rows, indent=0), encoding="utf-8")


def made(path: Path) -> Path:
    """A path whose folder is there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
