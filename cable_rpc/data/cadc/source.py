"""One drive of CADC as a frame source."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from cable_rpc.data.cadc.annotations import ground_truth
from cable_rpc.data.cadc.calibration import CadcCalibration
from cable_rpc.data.cadc.novatel import NovatelLog
from cable_rpc.data.cuboids import Cuboid
from cable_rpc.data.numbered_images import NumberedImage, NumberedImages
from cable_rpc.data.resize import resize_frame, scaled_intrinsics
from cable_rpc.data.source import SourceOptions
from cable_rpc.errors import SourceError
from cable_rpc.types import CameraMount, Frame


@dataclass(frozen=True, slots=True)
class CadcDrive:
    """What is held of a drive: cuboids, but no images."""

    name: str
    images: Sequence[NumberedImage]
    """At least one, times rising."""
    distorted: bool
    """Whether the images show the lens's distortion."""
    calibration: CadcCalibration
    cuboids: Mapping[int, Sequence[Cuboid]]
    """By image number, in lidar axes; numbers that aren't there weren't annotated."""
    motion: NovatelLog | None
    mount: CameraMount | None


class CadcSource:
    """Frames of the front camera with truth, ego-motion, intrinsics and mount.

    The intrinsics of distorted images are those of the pinhole behind the lens.

    Args:
        drive: what is known besides the images.
        options: what is asked of it.

    Raises:
        SourceError: no image can be read, or the calibration is for images of another size.
    """

    def __init__(self, drive: CadcDrive, options: SourceOptions) -> None:
        self.name = drive.name
        self._drive = drive
        self._images = NumberedImages(drive.images, options)
        self.fps = self._images.fps
        self.size_wh = self._images.size_wh
        self.frame_count: int | None = len(self._images.chosen)
        """Of frames listed; a skipped one is delivered less."""
        self.mount = drive.mount
        stored, calibrated = self._images.file_size_wh, drive.calibration.size_wh
        if calibrated is not None and stored != calibrated:
            raise SourceError(
                f"{drive.images[0].path.parent} holds images of {stored[0]}x{stored[1]}, but the calibration is for "
                f"{calibrated[0]}x{calibrated[1]}"
            )
        self.intrinsics = scaled_intrinsics(drive.calibration.intrinsics, stored, self.size_wh)

    def __iter__(self) -> Iterator[Frame]:
        """Frames with index 0, 1, 2, ...

        Raises:
            SourceError: an image is damaged, missing or of another size, unless that is to be skipped.
        """
        drive = self._drive
        for index, (entry, image) in enumerate(self._images):
            cuboids = drive.cuboids.get(entry.number)
            truth = None
            if cuboids is not None:
                truth = ground_truth(cuboids, drive.calibration, self._images.file_size_wh, drive.distorted)
            frame = Frame(
                image=image,
                index=index,
                capture_time_ns=entry.time_ns,
                ego=None if drive.motion is None else drive.motion.at(entry.time_ns),
                intrinsics=drive.calibration.intrinsics,
                truth=truth,
                mount=drive.mount,
            )
            yield resize_frame(frame, self.size_wh)
