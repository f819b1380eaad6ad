"""CADC's GNSS/INS record (NovAtel INSPVAX), one message per file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.local_plane import east_north_of
from cable_rpc.data.poses import LEAST_POSES, NS_PER_S, motion_from_poses, rigid
from cable_rpc.data.text_fields import finite_number
from cable_rpc.data.time_stamps import read_stamps
from cable_rpc.errors import SourceError
from cable_rpc.types import EgoMotion

FloatArray = npt.NDArray[np.float64]

LATITUDE, LONGITUDE, AZIMUTH = 0, 1, 9
"""Columns in degrees; azimuth 0 is north, clockwise (convert_novatel_to_pose.py of the devkit)."""
NORTH_VELOCITY, EAST_VELOCITY = 17, 18
"""Columns of the raw record, m/s; the labelled one ends before them."""
FEWEST_COLUMNS = 10
FARTHEST_S = 0.5
"""A frame farther from all messages than this has no ego-motion."""


@dataclass(frozen=True, slots=True)
class NovatelMessage:
    """What is used of one message."""

    time_ns: int
    latitude_deg: float
    longitude_deg: float
    azimuth_deg: float
    velocity_north_east: tuple[float, float] | None
    """m/s, where the message has it."""


@dataclass(frozen=True, slots=True)
class NovatelLog:
    """Ego-motion over a drive."""

    times_ns: npt.NDArray[np.int64]
    """int64 [N], strictly rising."""
    motions: FloatArray
    """float64 [N, 3]: speed and lateral speed (right) in m/s, yaw rate (left) in rad/s."""

    def at(self, time_ns: int) -> EgoMotion | None:
        """Ego-motion at a time, linearly between messages; None where none is near."""
        since_s = (self.times_ns - time_ns) / NS_PER_S
        if not len(since_s) or float(np.abs(since_s).min()) > FARTHEST_S:
            return None
        speed, lateral, yaw_rate = (float(np.interp(0.0, since_s, column)) for column in self.motions.T)
        return EgoMotion(speed, lateral, yaw_rate)


def read_novatel(folder: Path, image_times_ns: dict[int, int], bad_frames: BadFrames) -> NovatelLog | None:
    """The ego-motion of a drive; None where there is no record, or not enough of it.

    Speeds come from the messages where they have velocities, else from consecutive positions; the yaw rate from
    consecutive azimuths.

    Args:
        folder: of ``data/NNNNNNNNNN.txt`` and ``timestamps.txt``.
        image_times_ns: capture times of images by number, for a record without time stamps of its own: its files then
            belong to the images of their numbers.
        bad_frames: what becomes of damaged messages.

    Raises:
        SourceError: a message is damaged, unless that is to be skipped; or the time stamps are.
    """
    files = sorted(file for file in (folder / "data").glob("*.txt") if file.stem.isdecimal())
    stamp_file = folder / "timestamps.txt"
    times_ns = dict(enumerate(read_stamps(stamp_file))) if stamp_file.exists() else image_times_ns
    messages: list[NovatelMessage] = []
    for file in files:
        time_ns = times_ns.get(int(file.stem))
        if time_ns is None:
            continue
        try:
            message = read_message(file, time_ns)
            if messages and message.time_ns <= messages[-1].time_ns:
                raise SourceError(f"{file} is of {message.time_ns} ns, not after the message before it")
        except SourceError as error:
            bad_frames.found(error)
            continue
        messages.append(message)
    return motion_log(messages) if len(messages) >= LEAST_POSES else None


def read_message(file: Path, time_ns: int) -> NovatelMessage:
    """Read one message.

    Raises:
        SourceError: it can't be read or has too few values, or one that is needed is no finite number.
    """
    try:
        words = file.read_text(encoding="utf-8").split()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"can't read GNSS message {file}: {error}") from error
    if len(words) < FEWEST_COLUMNS:
        raise SourceError(f"{file} line 1: {len(words)} values; a GNSS message has at least {FEWEST_COLUMNS}")
    columns = [LATITUDE, LONGITUDE, AZIMUTH]
    moving = len(words) > EAST_VELOCITY
    columns += [NORTH_VELOCITY, EAST_VELOCITY] if moving else []
    values = [finite_number(words[column], f"value {column + 1}", f"{file} line 1") for column in columns]
    velocity = (values[3], values[4]) if moving else None
    return NovatelMessage(time_ns, values[0], values[1], values[2], velocity)


def motion_log(messages: Sequence[NovatelMessage]) -> NovatelLog:
    """Ego-motion by messages, at least two of rising times."""
    times_ns = np.array([message.time_ns for message in messages], np.int64)
    places = east_north_of(np.array([(message.latitude_deg, message.longitude_deg) for message in messages]))
    headings = np.radians(90.0 - np.array([message.azimuth_deg for message in messages]))
    poses = np.array([flat_pose(place, float(heading)) for place, heading in zip(places, headings, strict=True)])
    motions = motion_from_poses(times_ns, poses)
    table = np.array([(motion.speed_mps, motion.lateral_mps, motion.yaw_rate_radps) for motion in motions])
    for row, (message, heading) in enumerate(zip(messages, headings.tolist(), strict=True)):
        if message.velocity_north_east is not None:
            north, east = message.velocity_north_east
            table[row, 0] = east * math.cos(heading) + north * math.sin(heading)
            table[row, 1] = east * math.sin(heading) - north * math.cos(heading)
    return NovatelLog(times_ns, table)


def flat_pose(east_north_m: FloatArray, heading: float) -> FloatArray:
    """world_from_vehicle, float64 [4, 4], of a place [2] and a heading counter-clockwise from east."""
    cosine, sine = math.cos(heading), math.sin(heading)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return rigid(turn, (*east_north_m.tolist(), 0.0))
