"""Sequences of annotated images in COCO's format as a frame source."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.coco.boxes import BoxRow, TrackKey, ground_truth, number_tracks, read_boxes
from cable_rpc.data.coco.images import NS_PER_S, ImageRow
from cable_rpc.data.coco.order import read_images, times_ns
from cable_rpc.data.coco.tables import CocoTables
from cable_rpc.data.ego_csv import EgoLog
from cable_rpc.data.frame_rate import nominal_fps, thinned
from cable_rpc.data.image_file import read_whole_image
from cable_rpc.data.json_fields import Identifier
from cable_rpc.data.names import safe_name
from cable_rpc.data.resize import resize_frame
from cable_rpc.errors import SourceError
from cable_rpc.types import CameraIntrinsics, CameraMount, EgoMotion, Frame, GroundTruth


@dataclass(frozen=True, slots=True)
class CocoSequence:
    """What is held of a sequence: labels, but no images."""

    name: str
    images: Sequence[ImageRow]
    """In order, at least one."""
    times_ns: Sequence[int]
    boxes: Mapping[Identifier, Sequence[BoxRow]] | None
    """By image id; None where the file has no annotations."""
    track_numbers: Mapping[TrackKey, int]


@dataclass(frozen=True, slots=True)
class CocoView:
    """How a sequence is delivered."""

    size: tuple[int, int] | None = None
    """(width, height) to resize to."""
    fps: float | None = None
    """Thin to this rate by the time stamps, where the sequence's is higher."""
    max_frames: int | None = None
    ego: EgoLog | None = None
    """In place of the rows' own ego-motion."""
    intrinsics: CameraIntrinsics | None = None
    """In place of the rows' own camera, pixels of the files."""
    mount: CameraMount | None = None
    bad_frames: BadFrames = field(default_factory=BadFrames)


class CocoSource:
    """One sequence.

    The truth is that of the annotation file, boxes clipped to the image; None on every frame of a file without
    annotations. Images are read one at a time.

    Args:
        sequence: its labels.
        folder: where the rows' file names begin.
        view: what is asked of it.

    Raises:
        SourceError: the size isn't in the rows and no image can be read.
    """

    def __init__(self, sequence: CocoSequence, folder: Path, view: CocoView) -> None:
        self.name = safe_name(sequence.name)
        self._sequence = sequence
        self._folder = folder
        self._view = view
        native_fps = nominal_fps(sequence.times_ns)
        self._thinned_fps = (
            view.fps if view.fps is not None and native_fps is not None and view.fps < native_fps else None
        )
        self.fps = self._thinned_fps or native_fps or view.fps or 1.0
        self._file_size_wh = sequence.images[0].size_wh or self._first_size()
        self.size_wh = self._file_size_wh if view.size is None else view.size
        self._chosen = thinned(sequence.times_ns, self._thinned_fps)[: view.max_frames]
        self.frame_count: int | None = len(self._chosen)
        """Of frames listed; a skipped one is delivered less."""

    def _first_size(self) -> tuple[int, int]:
        for row in self._sequence.images:
            try:
                image = read_whole_image(self._folder / row.file_name)
            except SourceError as error:
                self._view.bad_frames.found(error)
                continue
            return image.shape[1], image.shape[0]
        raise SourceError(f"none of the {len(self._sequence.images)} images of '{self._sequence.name}' can be read")

    def __iter__(self) -> Iterator[Frame]:
        """Frames with index 0, 1, 2, ...

        Raises:
            SourceError: an image is missing, damaged or of another size, unless that is to be skipped.
        """
        index = 0
        for place in self._chosen:
            try:
                frame = self._frame(place, index)
            except SourceError as error:
                self._view.bad_frames.found(error)
                continue
            yield frame
            index += 1

    def _frame(self, place: int, index: int) -> Frame:
        row, time_ns = self._sequence.images[place], self._sequence.times_ns[place]
        image = read_whole_image(self._folder / row.file_name)
        found = (image.shape[1], image.shape[0])
        stated = row.size_wh or self._file_size_wh
        if found != stated or found != self._file_size_wh:
            expected = stated if found != stated else self._file_size_wh
            whose = f"{row.place} says" if found != stated else "the sequence's first image is"
            raise SourceError(
                f"{self._folder / row.file_name} is {found[0]}x{found[1]}, but {whose} {expected[0]}x{expected[1]}"
            )
        frame = Frame(
            image,
            index,
            time_ns,
            self._ego(row, place),
            self._view.intrinsics or row.intrinsics,
            self._truth(row),
            self._view.mount or row.mount,
        )
        return resize_frame(frame, self.size_wh)

    def _ego(self, row: ImageRow, place: int) -> EgoMotion | None:
        if self._view.ego is None:
            return row.ego
        since_first_s = (self._sequence.times_ns[place] - self._sequence.times_ns[0]) / NS_PER_S
        return self._view.ego.at(place if row.number is None else row.number, since_first_s)

    def _truth(self, row: ImageRow) -> GroundTruth | None:
        boxes = self._sequence.boxes
        if boxes is None:
            return None
        return ground_truth(boxes.get(row.image_id, ()), self._sequence.track_numbers, self._file_size_wh)


def read_sequence(tables: CocoTables, name: str, fps: float, bad_frames: BadFrames) -> CocoSequence:
    """The labels of one sequence of a file.

    Args:
        tables: of the file.
        name: one of its sequences.
        fps: rate of the frame numbers, for images without time stamps.
        bad_frames: what becomes of damaged rows.

    Raises:
        SourceError: a row is damaged, unless that is to be skipped; or not one image is left.
    """
    images = read_images(tables, name, bad_frames)
    if not images:
        raise SourceError(f"{tables.path}: sequence '{name}' has no image whose row can be used")
    boxes = None
    if tables.annotations is not None:
        boxes = read_boxes(tables, {image.image_id for image in images}, bad_frames)
    return CocoSequence(name, images, times_ns(images, fps), boxes, number_tracks(boxes or {}))
