"""A folder of still images as a frame source."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from cable_rpc.data.ego_csv import EgoLog
from cable_rpc.data.resize import resize_image, scaled_intrinsics
from cable_rpc.errors import SourceError
from cable_rpc.types import CameraIntrinsics, CameraMount, Frame, Image

SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
DEFAULT_FPS = 10.0
"""Rate of the driving data sets that come as folders (KITTI, Waymo)."""

NS_PER_S = 1_000_000_000


class ImageFolderSource:
    """PNG and JPEG files of one folder, in the order of their names.

    Ego-motion by frame is looked up by the number a file is named by (``000036.png`` is frame 36), or by
    position where not all names are numbers.

    Args:
        path: the folder.
        max_frames: stop after that many.
        ego: ego-motion of the recording.
        size: (width, height) to resize to.
        intrinsics: the camera, in pixels of the files.
        fps: rate at which the images were taken.
        mount: where the camera sits on its vehicle.

    Raises:
        SourceError: no images, or the first can't be read.
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
        self.name = path.resolve().name
        self.fps = DEFAULT_FPS if fps is None else fps
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
        if not files:
            raise SourceError(f"folder {path} holds no PNG or JPEG files")
        numbered = all(file.stem.isdecimal() for file in files)
        numbers = [int(file.stem) if numbered else place for place, file in enumerate(files)]
        self._files = list(zip(numbers, files, strict=True))[:max_frames]
        self.frame_count: int | None = len(self._files)
        height, width = read_image(files[0]).shape[:2]
        self._file_size_wh = (width, height)
        self.size_wh = (width, height) if size is None else size
        self._ego = ego
        self.mount = mount
        self.intrinsics = scaled_intrinsics(intrinsics, self._file_size_wh, self.size_wh)

    def __iter__(self) -> Iterator[Frame]:
        """Frames with index 0, 1, 2, ...

        Raises:
            SourceError: a file can't be read or differs in size from the first.
        """
        for index, (number, file) in enumerate(self._files):
            image = read_image(file)
            if (image.shape[1], image.shape[0]) != self._file_size_wh:
                raise SourceError(
                    f"{file} is {image.shape[1]}x{image.shape[0]}, the first image of the folder is "
                    f"{self._file_size_wh[0]}x{self._file_size_wh[1]}"
                )
            time_s = index / self.fps
            yield Frame(
                image=resize_image(image, self.size_wh),
                index=index,
                capture_time_ns=round(time_s * NS_PER_S),
                ego=None if self._ego is None else self._ego.at(number, time_s),
                intrinsics=self.intrinsics,
                mount=self.mount,
            )


def read_image(path: Path) -> Image:
    """An image file as uint8 [height, width, 3], BGR; grey files get three equal channels."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise SourceError(f"{path} is not a readable image")
    return image.astype(np.uint8, copy=False)
