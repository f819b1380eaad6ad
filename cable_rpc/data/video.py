"""Video files as a frame source, in true colour and true time."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av

from cable_rpc.data.colour import to_bgr
from cable_rpc.data.ego_csv import EgoLog
from cable_rpc.data.resize import resize_image, scaled_intrinsics
from cable_rpc.errors import SourceError
from cable_rpc.types import CameraIntrinsics, CameraMount, Frame

log = logging.getLogger(__name__)

NS_PER_S = 1_000_000_000


class VideoSource:
    """Any video file that FFmpeg reads.

    Args:
        path: the file.
        max_frames: stop after that many.
        ego: ego-motion of the recording.
        size: (width, height) to resize to.
        intrinsics: the camera, in pixels of the file's frames as displayed.
        fps: thin to this rate where the file's is higher; times stay those of the kept frames.
        mount: where the camera sits on its vehicle.

    Raises:
        SourceError: no such file, not a video, or not a single frame in it.
    """

    def __init__(
        self,
        path: Path,
        *,
        max_frames: int | None = None,
        ego: EgoLog | None = None,
        size: tuple[int, int] | None = None,
        intrinsics: CameraIntrinsics | None = None,
        fps: float | None = None,
        mount: CameraMount | None = None,
    ) -> None:
        self.name = path.stem
        self._path = path
        self._max_frames = max_frames
        self._ego = ego
        self.mount = mount
        with open_container(path) as container:
            stream = container.streams.video[0]
            first = next(decode(path, container), None)
            if first is None:
                raise SourceError(f"{path} has a video stream but not one frame could be decoded from it")
            rate = stream.average_rate or stream.guessed_rate or 25
            stated_frames = count_shown(stream)
        self._file_fps = float(rate)
        self._thinned_fps = fps if fps is not None and fps < self._file_fps else None
        self.fps = self._thinned_fps or self._file_fps
        height, width = to_bgr(first).shape[:2]
        self._file_size_wh = (width, height)
        self.size_wh = (width, height) if size is None else size
        self.intrinsics = scaled_intrinsics(intrinsics, self._file_size_wh, self.size_wh)
        self.frame_count = self._count(stated_frames)

    def _count(self, stated_frames: int) -> int | None:
        """Frames an iteration gives, by the container's word; None where it says nothing."""
        if stated_frames == 0:
            return None
        count = stated_frames
        if self._thinned_fps is not None:
            count = math.ceil(stated_frames * self._thinned_fps / self._file_fps - 1e-6)
        return count if self._max_frames is None else min(count, self._max_frames)

    def __iter__(self) -> Iterator[Frame]:
        """Frames with index 0, 1, 2, ... in display order, the first at time 0.

        A damaged or cut-off file gives what could be decoded, and a log line says so.

        Raises:
            SourceError: the file is gone, or the picture size changes within it.
        """
        index = 0
        slot = -1
        with open_container(self._path) as container:
            for number, (decoded, time_ns) in enumerate(timed(decode(self._path, container), self._file_fps)):
                if index == self._max_frames:
                    return
                if self._thinned_fps is not None:
                    # A frame is kept if it is the first of its period; the slack absorbs rounded time stamps.
                    due = math.floor(time_ns * self._thinned_fps / NS_PER_S + 1e-3)
                    if due <= slot:
                        continue
                    slot = due
                yield self._frame(decoded, number, index, time_ns)
                index += 1

    def _frame(self, decoded: av.VideoFrame, number: int, index: int, time_ns: int) -> Frame:
        image = to_bgr(decoded)
        if (image.shape[1], image.shape[0]) != self._file_size_wh:
            raise SourceError(
                f"{self._path}: frame {number} is {image.shape[1]}x{image.shape[0]}, the first was "
                f"{self._file_size_wh[0]}x{self._file_size_wh[1]}; re-encode it at one size"
            )
        return Frame(
            image=resize_image(image, self.size_wh),
            index=index,
            capture_time_ns=time_ns,
            ego=None if self._ego is None else self._ego.at(number, time_ns / NS_PER_S),
            intrinsics=self.intrinsics,
            mount=self.mount,
        )


def open_container(path: Path) -> av.container.InputContainer:
    """Open a media file that has a video stream.

    Raises:
        SourceError: no such file, no media, or no video in it.
    """
    if not path.is_file():
        raise SourceError(f"no such video file: {path}")
    try:
        container = av.open(str(path))
    except av.FFmpegError as error:
        raise SourceError(f"{path} is not a video that can be read: {error.strerror}") from error
    if not container.streams.video:
        container.close()
        raise SourceError(f"{path} holds no video stream")
    return container


def count_shown(stream: av.VideoStream) -> int:
    """Frames to be shown by the container's index, which an edit list may cut; 0 where it has none."""
    entries = stream.index_entries
    if len(entries) != stream.frames:
        return 0
    return sum(not entry.is_discard for entry in entries)


def decode(path: Path, container: av.container.InputContainer) -> Iterator[av.VideoFrame]:
    """Frames of the first video stream up to the end or the first damage."""
    count = 0
    try:
        for frame in container.decode(video=0):
            yield frame
            count += 1
    except av.FFmpegError as error:
        log.warning("%s is damaged after frame %d: %s", path, count, error.strerror)


def timed(frames: Iterator[av.VideoFrame], fps: float) -> Iterator[tuple[av.VideoFrame, int]]:
    """Frames with their times in ns since the first, strictly rising.

    A frame without a usable time stamp takes the one before plus the nominal period.
    """
    start_s: Fraction | None = None
    last_ns = -1
    for frame in frames:
        time_ns = 0 if last_ns < 0 else last_ns + round(NS_PER_S / fps)
        if frame.pts is not None and frame.time_base is not None:
            exact_s = frame.pts * frame.time_base
            start_s = exact_s if start_s is None else start_s
            stamped_ns = round((exact_s - start_s) * NS_PER_S)
            if stamped_ns > last_ns:
                time_ns = stamped_ns
        last_ns = time_ns
        yield frame, time_ns
