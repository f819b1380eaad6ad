"""Ego-motion from nuScenes' CAN bus expansion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.json_fields import numbers
from cable_rpc.data.nuscenes.tables import SITE, TableRow, read_rows, time_of
from cable_rpc.errors import SourceError
from cable_rpc.types import EgoMotion

FloatArray = npt.NDArray[np.float64]

BRIDGED_NS = 500_000_000
"""Longest hole between messages that is bridged in a straight line; they come at 50 Hz."""
HELD_NS = 100_000_000
"""How long before the first and after the last message these still hold: recordings start within a few messages."""


@dataclass(frozen=True, slots=True)
class CanMotion:
    """Ego-motion over a scene, in vehicle axes x forward, y RIGHT."""

    times_ns: npt.NDArray[np.int64]
    """int64 [N], strictly rising."""
    motion: FloatArray
    """float64 [N, 3]: speed m/s, lateral m/s positive to the right, yaw rate rad/s positive to the left."""

    def at(self, time_ns: int) -> EgoMotion | None:
        """Ego-motion at a time, linear between messages; None in a hole of over 0.5 s and beyond the ends."""
        first, last = int(self.times_ns[0]), int(self.times_ns[-1])
        if not first - HELD_NS <= time_ns <= last + HELD_NS:
            return None
        later = int(np.searchsorted(self.times_ns, time_ns))
        if 0 < later < len(self.times_ns) and self.times_ns[later] - self.times_ns[later - 1] > BRIDGED_NS:
            return None if time_ns != self.times_ns[later] else EgoMotion(*self.motion[later].tolist())
        # Relative to the first: an absolute time in ns has more digits than a float.
        since, known = float(time_ns - first), (self.times_ns - first).astype(np.float64)
        return EgoMotion(*(float(np.interp(since, known, column)) for column in self.motion.T))


def read_can_motion(root: Path, scene: str, bad_frames: BadFrames) -> CanMotion:
    """Read ``can_bus/SCENE_pose.json``: velocity and rotation rate in the vehicle's axes, y to the left, at 50 Hz.

    Raises:
        SourceError: the file is missing (scenes 161-176 and 309-314 have no CAN bus data), has no usable message, or a
            message is damaged, unless that is to be skipped.
    """
    path = root / "can_bus" / f"{scene}_pose.json"
    if not path.is_file():
        raise SourceError(
            f"{path} is missing; it belongs to the CAN bus expansion of {SITE}, which some scenes are not part of; "
            "use ?ego=pose"
        )
    times: list[int] = []
    motion: list[tuple[float, float, float]] = []
    for row in read_rows(path):
        try:
            time_ns, values = message_of(row)
            if times and time_ns <= times[-1]:
                raise SourceError(f"{row.place}: utime {row.values['utime']} does not rise")
        except SourceError as error:
            bad_frames.found(error)
            continue
        times.append(time_ns)
        motion.append(values)
    if not times:
        raise SourceError(f"{path} holds no message that can be used; use ?ego=pose")
    return CanMotion(np.array(times, np.int64), np.array(motion, np.float64))


def message_of(row: TableRow) -> tuple[int, tuple[float, float, float]]:
    """Time in ns, and speed, lateral speed to the right and yaw rate to the left of a pose message.

    Raises:
        SourceError: a value is missing or can't be used.
    """
    forward, left, _ = numbers(row.values, "vel", 3, row.place)
    yaw_rate = numbers(row.values, "rotation_rate", 3, row.place)[2]
    return time_of(row, "utime"), (forward, -left, yaw_rate)
