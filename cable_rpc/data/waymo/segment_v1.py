"""One camera of a version 1 segment: a TFRecord file of serialized ``Frame`` messages."""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from google.protobuf.message import DecodeError

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.waymo.camera import Calibration, CameraName, read_calibration
from cable_rpc.data.waymo.labels import BoxLabel
from cable_rpc.data.waymo.motion import FloatArray, motion_of_poses, motion_of_velocity, pose_matrix
from cable_rpc.data.waymo.schema import frame_class
from cable_rpc.data.waymo.segment import NS_PER_MICROSECOND, CameraRecord
from cable_rpc.data.waymo.stamps import frame_stamp
from cable_rpc.data.waymo.tfrecord import RecordSpan, read_record, record_spans
from cable_rpc.errors import SourceError
from cable_rpc.types import EgoMotion


@dataclass(frozen=True, slots=True)
class StampedSpan:
    """Where a frame lies, and what its motion can be told from."""

    span: RecordSpan
    time_ns: int
    pose: bytes
    """A serialized Transform; empty where the frame has none."""


class RecordSegment:
    """A segment of version 1.

    Opening reads the heads of the records, the time stamps and the poses; a record is read when its frame is asked
    for, and its checksum is verified then.

    Args:
        path: the file.
        name: of the segment.
        camera: which one.
        bad_frames: what becomes of damaged records.

    Raises:
        SourceError: the file can't be read, holds no frame or no such camera; or a record is damaged, unless that is
            to be skipped.
    """

    def __init__(self, path: Path, name: str, camera: CameraName, bad_frames: BadFrames) -> None:
        self.name = name
        self.camera = camera
        self._path = path
        self._bad_frames = bad_frames
        self._frames = stamped_spans(path, bad_frames)
        if not self._frames:
            raise SourceError(f"{path} holds no frame")
        self.times_ns = [frame.time_ns for frame in self._frames]
        self.calibration = self._read_calibration()
        self._motion: Mapping[int, EgoMotion | None] | None = None

    def _read_calibration(self) -> Calibration:
        for frame in self._frames:
            try:
                context = read_frame(self._path, frame.span).context
            except SourceError as error:
                self._bad_frames.found(error)
                continue
            place = f"{self._path} record {frame.span.number}"
            for row in context.camera_calibrations:
                if row.name == self.camera:
                    return read_calibration(
                        list(row.intrinsic),
                        list(row.extrinsic.transform),
                        (row.width, row.height),
                        f"{place}, calibration of {self.camera.name}",
                    )
            raise SourceError(f"{place} has no calibration of camera {self.camera.name}")
        raise SourceError(f"{self._path}: none of {len(self._frames)} records can be read")

    def records(self, places: Sequence[int]) -> Iterator[CameraRecord]:
        """The frames at some places of `times_ns`, damaged ones left out.

        Raises:
            SourceError: a record is damaged, unless that is to be skipped.
        """
        for place in places:
            try:
                record = self._record(place)
            except SourceError as error:
                self._bad_frames.found(error)
                continue
            yield record

    def _record(self, place: int) -> CameraRecord:
        span = self._frames[place].span
        frame = read_frame(self._path, span)
        where = f"{self._path} record {span.number}"
        image = next((image for image in frame.images if image.name == self.camera), None)
        if image is None:
            raise SourceError(f"{where} has no image of camera {self.camera.name}")
        return CameraRecord(
            f"{where}, camera {self.camera.name}",
            self.times_ns[place],
            image.image,
            self._ego(place, frame, image, where),
            labels_of(frame, self.camera, where),
        )

    def _ego(self, place: int, frame: Any, image: Any, where: str) -> EgoMotion | None:
        if image.HasField("velocity"):
            v = image.velocity
            pose = image.pose if image.HasField("pose") else frame.pose
            return motion_of_velocity((v.v_x, v.v_y, v.v_z), (v.w_x, v.w_y, v.w_z), list(pose.transform), where)
        if self._motion is None:
            self._motion = self._motion_of_frames()
        time_ns = self.times_ns[place]
        if time_ns not in self._motion:
            raise SourceError(f"{where} has neither a velocity nor a sound pose")
        return self._motion[time_ns]

    def _motion_of_frames(self) -> dict[int, EgoMotion | None]:
        """What the frames' poses tell; damaged ones are left out."""
        poses: dict[int, FloatArray] = {}
        for frame in self._frames:
            try:
                poses[frame.time_ns] = read_pose(frame, f"{self._path} record {frame.span.number}: the pose")
            except SourceError as error:
                self._bad_frames.found(error)
        return motion_of_poses(poses)


def read_pose(frame: StampedSpan, place: str) -> FloatArray:
    """The pose of a frame, float64 [4, 4].

    Raises:
        SourceError: it is damaged.
    """
    transform = type(frame_class()().pose)
    try:
        values = list(transform.FromString(frame.pose).transform)
    except DecodeError:
        raise SourceError(f"{place} is damaged") from None
    return pose_matrix(values, place)


def stamped_spans(path: Path, bad_frames: BadFrames) -> list[StampedSpan]:
    """The frames of a file with their times, which rise.

    Raises:
        SourceError: a record is damaged or out of order, unless that is to be skipped.
    """
    spans = record_spans(path, bad_frames)
    frames: list[StampedSpan] = []
    if not spans:
        return frames
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        for span in spans:
            try:
                stamp = frame_stamp(mapped, span.start, span.start + span.length, f"{path} record {span.number}")
            except SourceError as error:
                bad_frames.found(error)
                continue
            time_ns = stamp.time_micros * NS_PER_MICROSECOND
            if frames and time_ns <= frames[-1].time_ns:
                bad_frames.found(
                    SourceError(
                        f"{path} record {span.number}: its time stamp of {stamp.time_micros} us doesn't rise above "
                        f"that of record {frames[-1].span.number}"
                    )
                )
                continue
            frames.append(StampedSpan(span, time_ns, stamp.pose))
    return frames


def read_frame(path: Path, span: RecordSpan) -> Any:
    """The ``Frame`` of a record.

    Raises:
        SourceError: the record is damaged or holds something else.
    """
    try:
        return frame_class().FromString(read_record(path, span))
    except DecodeError:
        raise SourceError(f"{path} record {span.number} is no Waymo Frame") from None


def labels_of(frame: Any, camera: CameraName, where: str) -> list[BoxLabel] | None:
    """One camera's boxes; None where no camera of the frame has labels, as in the test split."""
    if not frame.camera_labels:
        return None
    return [
        BoxLabel(
            f"{where}, label {number} of {camera.name}",
            label.id,
            label.type,
            (label.box.center_x, label.box.center_y),
            (label.box.length, label.box.width),
            label.detection_difficulty_level,
        )
        for group in frame.camera_labels
        if group.name == camera
        for number, label in enumerate(group.labels, 1)
    ]
