"""KITTI's GPS/IMU record (OXTS RT3003)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.text_fields import finite_number
from cable_rpc.errors import SourceError
from cable_rpc.types import EgoMotion

COLUMNS = 30
VELOCITY_FORWARD, VELOCITY_LEFT, YAW_RATE_UP = 8, 9, 22
"""Columns vf and vl (m/s, parallel to the earth's surface) and wu (rad/s about the upward axis, left positive), as in
dataformat.txt of the raw data's devkit."""


def read_oxts(path: Path, bad_frames: BadFrames) -> dict[int, EgoMotion]:
    """Ego-motion by frame number: line ``n``, counted from 0, is that of frame ``n``. Empty lines have none.

    Raises:
        SourceError: the file can't be read, or a line is damaged and that isn't to be skipped.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"can't read GPS/IMU record {path}: {error}") from error
    motions: dict[int, EgoMotion] = {}
    for frame, line in enumerate(lines):
        words = line.split()
        if not words:
            continue
        try:
            motions[frame] = motion_of(words, f"{path} line {frame + 1}")
        except SourceError as error:
            bad_frames.found(error)
    return motions


def motion_of(words: Sequence[str], place: str) -> EgoMotion:
    """Ego-motion of one line.

    Raises:
        SourceError: it hasn't 30 values, or one that is needed is no finite number.
    """
    if len(words) != COLUMNS:
        raise SourceError(f"{place}: {len(words)} values; a line of the GPS/IMU record has {COLUMNS}")
    columns = (VELOCITY_FORWARD, VELOCITY_LEFT, YAW_RATE_UP)
    forward, left, yaw_rate = (finite_number(words[column], f"value {column + 1}", place) for column in columns)
    return EgoMotion(forward, -left, yaw_rate)
