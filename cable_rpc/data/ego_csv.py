"""Ego-motion logs: CSV with a header, one row per video frame or per instant."""

from __future__ import annotations

import csv
import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.types import EgoMotion

KEY_COLUMNS = ("time_s", "frame")
REQUIRED_COLUMNS = ("speed_mps", "yaw_rate_radps")
LATERAL_COLUMN = "lateral_mps"
"""Optional, positive to the right."""

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class EgoLog:
    """Ego-motion over a recording."""

    key: Literal["time_s", "frame"]
    """What ``keys`` holds: seconds since the first video frame, or frame numbers."""
    keys: FloatArray
    """float64 [N], strictly rising."""
    speed_mps: FloatArray
    """float64 [N]."""
    lateral_mps: FloatArray
    """float64 [N], positive to the right."""
    yaw_rate_radps: FloatArray
    """float64 [N], positive to the left."""

    def at(self, frame_number: int, time_s: float) -> EgoMotion | None:
        """Ego-motion of a frame.

        Args:
            frame_number: the frame's number in the recording; counts for logs by frame.
            time_s: the frame's time since the first frame; counts for logs by time, linearly interpolated.

        Returns:
            None where the log has no such frame, or does not reach to that time.
        """
        if self.key == "time_s":
            if not self.keys[0] <= time_s <= self.keys[-1]:
                return None
            return EgoMotion(
                float(np.interp(time_s, self.keys, self.speed_mps)),
                float(np.interp(time_s, self.keys, self.lateral_mps)),
                float(np.interp(time_s, self.keys, self.yaw_rate_radps)),
            )
        row = int(np.searchsorted(self.keys, frame_number))
        if row == len(self.keys) or self.keys[row] != frame_number:
            return None
        return EgoMotion(float(self.speed_mps[row]), float(self.lateral_mps[row]), float(self.yaw_rate_radps[row]))


def read_ego_csv(path: Path) -> EgoLog:
    """Read an ego-motion log.

    Columns, in any order: ``time_s`` (seconds since the first frame) or ``frame`` (frame number);
    ``speed_mps``; ``yaw_rate_radps``, positive to the left; optionally ``lateral_mps``, positive to the
    right. Others are ignored.

    Raises:
        SourceError: the file can't be read or has no rows.
        ConfigurationError: a column is missing or a value can't be used; the text names line and column.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = csv.reader(file)
            header = [name.strip() for name in next(lines, [])]
            key = key_column(path, header)
            rows = [read_row(path, lines.line_num, header, key, row) for row in lines if any(row)]
    except OSError as error:
        raise SourceError(f"can't read ego-motion log {path}: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise SourceError(f"{path} isn't a CSV text file: {error}") from error
    if not rows:
        raise SourceError(f"ego-motion log {path} has a header but no rows")
    for (line, earlier), (later_line, later) in itertools.pairwise(rows):
        if later[0] <= earlier[0]:
            raise ConfigurationError(
                f"{path} line {later_line}, column {key}: {later[0]:g} does not rise above "
                f"{earlier[0]:g} of line {line}; sort the log and remove duplicates"
            )
    table = np.array([values for _, values in rows], np.float64)
    return EgoLog(key, table[:, 0], table[:, 1], table[:, 2], table[:, 3])


def key_column(path: Path, header: list[str]) -> Literal["time_s", "frame"]:
    """The column that says which frame a row belongs to; also checks that the others are there."""
    missing = [name for name in REQUIRED_COLUMNS if name not in header]
    if "time_s" not in header and "frame" not in header:
        missing.insert(0, " or ".join(KEY_COLUMNS))
    if missing:
        raise ConfigurationError(
            f"{path} line 1: no column {', '.join(missing)}; found {', '.join(header) or 'nothing'}"
        )
    return "time_s" if "time_s" in header else "frame"


def read_row(
    path: Path, line: int, header: list[str], key: str, row: list[str]
) -> tuple[int, tuple[float, float, float, float]]:
    """Line number, and key, speed, lateral speed and yaw rate of one row."""
    if len(row) != len(header):
        raise ConfigurationError(f"{path} line {line}: {len(row)} values under {len(header)} columns")
    cells = dict(zip(header, row, strict=True))

    def number(column: str) -> float:
        try:
            value = float(cells[column])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ConfigurationError(f"{path} line {line}, column {column}: '{cells[column]}' is not a finite number")
        return value

    lateral_mps = number(LATERAL_COLUMN) if LATERAL_COLUMN in cells else 0.0
    return line, (number(key), number("speed_mps"), lateral_mps, number("yaw_rate_radps"))
