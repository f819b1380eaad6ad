"""What a segment of either version of the data set gives for one camera."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from cable_rpc.data.waymo.camera import Calibration, CameraName
from cable_rpc.data.waymo.labels import BoxLabel
from cable_rpc.types import EgoMotion

WEBSITE = "https://waymo.com/open"
NS_PER_MICROSECOND = 1_000


@dataclass(frozen=True, slots=True)
class CameraRecord:
    """One image with what is stored about its instant."""

    place: str
    """Where it stands, for error texts."""
    time_ns: int
    """Of the frame: all sensors of one turn of the lidar share it."""
    jpeg: bytes
    ego: EgoMotion | None
    """None where the segment has but one pose and no velocity."""
    labels: Sequence[BoxLabel] | None
    """None where nobody annotated the frame."""


class Segment(Protocol):
    """One camera of a segment."""

    @property
    def name(self) -> str:
        """The segment's."""
        ...

    @property
    def camera(self) -> CameraName:
        """Which camera it is."""
        ...

    @property
    def calibration(self) -> Calibration:
        """The camera's."""
        ...

    @property
    def times_ns(self) -> Sequence[int]:
        """Of all frames, strictly rising."""
        ...

    def records(self, places: Sequence[int]) -> Iterator[CameraRecord]:
        """The frames at some places of `times_ns`, one at a time in that order, damaged ones left out.

        Raises:
            SourceError: a frame is damaged, unless that is to be skipped.
        """
        ...
