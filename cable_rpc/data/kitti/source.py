"""One sequence of KITTI tracking as a frame source."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from cable_rpc.data.ego_csv import EgoLog
from cable_rpc.data.kitti.calibration import KittiCalibration
from cable_rpc.data.kitti.labels import LabelRow, ground_truth
from cable_rpc.data.numbered_images import NumberedImage, NumberedImages
from cable_rpc.data.resize import resize_frame, scaled_intrinsics
from cable_rpc.data.source import SourceOptions
from cable_rpc.types import EgoMotion, Frame

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class KittiSequence:
    """What is held of a sequence: labels, but no images."""

    name: str
    images: Sequence[NumberedImage]
    """At least one, times rising."""
    calibration: KittiCalibration
    labels: Mapping[int, Sequence[LabelRow]] | None
    """By frame number; None for a sequence without labels."""
    motions: Mapping[int, EgoMotion] | EgoLog
    """By frame number, or a user's own log."""


class KittiSource:
    """Frames of the left colour camera with truth, ego-motion, intrinsics and mount.

    Args:
        sequence: what is known besides the images.
        options: what is asked of it.

    Raises:
        SourceError: no image can be read.
    """

    def __init__(self, sequence: KittiSequence, options: SourceOptions) -> None:
        self.name = sequence.name
        self._sequence = sequence
        self._images = NumberedImages(sequence.images, options)
        self.fps = self._images.fps
        self.size_wh = self._images.size_wh
        self.frame_count: int | None = len(self._images.chosen)
        """Of frames listed; a skipped one is delivered less."""
        self.mount = sequence.calibration.mount
        self.intrinsics = scaled_intrinsics(
            sequence.calibration.intrinsics, self._images.file_size_wh, self._images.size_wh
        )

    def __iter__(self) -> Iterator[Frame]:
        """Frames with index 0, 1, 2, ...

        Raises:
            SourceError: an image is damaged or of another size, unless that is to be skipped.
        """
        labels = self._sequence.labels
        size_wh = self._images.file_size_wh
        for index, (entry, image) in enumerate(self._images):
            frame = Frame(
                image=image,
                index=index,
                capture_time_ns=entry.time_ns,
                ego=self._ego(entry),
                intrinsics=self._sequence.calibration.intrinsics,
                truth=None if labels is None else ground_truth(labels.get(entry.number, ()), size_wh),
                mount=self.mount,
            )
            yield resize_frame(frame, self.size_wh)

    def _ego(self, entry: NumberedImage) -> EgoMotion | None:
        motions = self._sequence.motions
        if isinstance(motions, EgoLog):
            return motions.at(entry.number, (entry.time_ns - self._sequence.images[0].time_ns) / NS_PER_S)
        return motions.get(entry.number)
