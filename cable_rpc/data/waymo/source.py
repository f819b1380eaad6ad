"""Segments of the Waymo Open Dataset as a frame source."""

from __future__ import annotations

from collections.abc import Iterator

from cable_rpc.data.frame_rate import nominal_fps, thinned
from cable_rpc.data.image_file import decode_whole_image
from cable_rpc.data.names import safe_name
from cable_rpc.data.resize import resize_frame
from cable_rpc.data.source import SourceOptions
from cable_rpc.data.waymo.camera import CameraName, camera_mount
from cable_rpc.data.waymo.labels import TrackNumbers, ground_truth
from cable_rpc.data.waymo.lens import Lens
from cable_rpc.data.waymo.segment import CameraRecord, Segment
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.types import Frame

DEFAULT_FPS = 10.0
"""Of the whole data set; counts for a segment of one frame."""


class WaymoSource:
    """One camera of one segment.

    The truth is that of the 2-D camera boxes, clipped to the image; None where nobody annotated. Intrinsics are the
    pinhole part of the calibration: the lens bends straight lines by up to some pixels at the border, unless the
    images are undistorted.

    Args:
        segment: of either version of the data set.
        options: what is asked of it.
        undistort: rectify images and boxes.

    Raises:
        ConfigurationError: an option makes no sense for a data set that knows its camera and motion.
    """

    def __init__(self, segment: Segment, options: SourceOptions, *, undistort: bool = False) -> None:
        if options.ego_csv is not None or options.intrinsics is not None or options.mount is not None:
            raise ConfigurationError(
                "a Waymo segment holds its own ego-motion and camera; leave ego_csv, intrinsics and mount out"
            )
        suffix = "" if segment.camera is CameraName.FRONT else f"-{segment.camera.name}"
        self.name = f"waymo-{safe_name(segment.name)}{suffix}"
        self._segment = segment
        self._bad_frames = options.bad_frames
        native_fps = nominal_fps(segment.times_ns) or DEFAULT_FPS
        thinned_fps = options.fps if options.fps is not None and options.fps < native_fps else None
        self.fps = thinned_fps or native_fps
        self._places = thinned(segment.times_ns, thinned_fps)[: options.max_frames]
        self.frame_count: int | None = len(self._places)
        """Of frames listed; a skipped one is delivered less."""
        self.size_wh = segment.calibration.size_wh if options.size is None else options.size
        self._mount = camera_mount(segment.calibration.vehicle_from_camera)
        self._lens = Lens(segment.calibration) if undistort else None
        self._tracks = TrackNumbers()

    def __iter__(self) -> Iterator[Frame]:
        """Frames with index 0, 1, 2, ...

        Raises:
            SourceError: an image, a record or a label is damaged, unless that is to be skipped.
        """
        index = 0
        for record in self._segment.records(self._places):
            try:
                frame = self._frame(record, index)
            except SourceError as error:
                self._bad_frames.found(error)
                continue
            yield frame
            index += 1

    def _frame(self, record: CameraRecord, index: int) -> Frame:
        calibration = self._segment.calibration
        image = decode_whole_image(record.jpeg, record.place)
        if (image.shape[1], image.shape[0]) != calibration.size_wh:
            raise SourceError(
                f"{record.place}: the image is {image.shape[1]}x{image.shape[0]}, the calibration is for "
                f"{calibration.size_wh[0]}x{calibration.size_wh[1]}"
            )
        labels = record.labels
        truth = None
        if labels is not None:
            truth = ground_truth(labels, self._tracks, calibration.size_wh, self._bad_frames)
        if self._lens is not None:
            image = self._lens.undistort(image)
            truth = None if truth is None else self._lens.undistort_truth(truth)
        frame = Frame(image, index, record.time_ns, record.ego, calibration.intrinsics, truth, self._mount)
        return resize_frame(frame, self.size_wh)
