"""Folders of images named by their frame numbers."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from cable_rpc.data.frame_rate import nominal_fps, thinned
from cable_rpc.data.image_file import read_whole_image
from cable_rpc.data.source import SourceOptions
from cable_rpc.errors import SourceError
from cable_rpc.types import Image

SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})


@dataclass(frozen=True, slots=True)
class NumberedImage:
    """One image file of a sequence."""

    number: int
    """What the file is named by; labels and motion go by it."""
    path: Path
    time_ns: int


def list_images(folder: Path, time_of: Callable[[int], int]) -> list[NumberedImage]:
    """The images of a folder by number.

    Args:
        folder: of ``000000.png`` and so on.
        time_of: number to capture time in ns.

    Raises:
        SourceError: there is no image, or times don't rise along the numbers.
    """
    files = {int(file.stem): file for file in folder.glob("*") if is_numbered_image(file)}
    if not files:
        raise SourceError(f"{folder} holds no PNG or JPEG files named by frame numbers")
    images = [NumberedImage(number, files[number], time_of(number)) for number in sorted(files)]
    for before, after in itertools.pairwise(images):
        if after.time_ns <= before.time_ns:
            raise SourceError(
                f"{after.path} is of {after.time_ns} ns, not after {before.path.name} of {before.time_ns} ns"
            )
    return images


def is_numbered_image(file: Path) -> bool:
    """Whether a file's name is a frame number with an image's suffix."""
    return file.suffix.lower() in SUFFIXES and file.stem.isascii() and file.stem.isdecimal()


class NumberedImages:
    """The images that a user asked for, read one at a time.

    Args:
        images: of the sequence, at least one, times rising.
        options: ``fps``, ``size``, ``max_frames`` and ``bad_frames`` are heeded.

    Raises:
        SourceError: no image can be read.
    """

    def __init__(self, images: Sequence[NumberedImage], options: SourceOptions) -> None:
        self._options = options
        times = [image.time_ns for image in images]
        native = nominal_fps(times)
        thinned_fps = options.fps if options.fps is not None and native is not None and options.fps < native else None
        self.fps = thinned_fps or native or options.fps or 1.0
        self.chosen = [images[place] for place in thinned(times, thinned_fps)[: options.max_frames]]
        self.file_size_wh = self._first_size()
        self.size_wh = self.file_size_wh if options.size is None else options.size

    def _first_size(self) -> tuple[int, int]:
        for entry in self.chosen:
            try:
                image = read_whole_image(entry.path)
            except SourceError as error:
                self._options.bad_frames.found(error)
                continue
            return image.shape[1], image.shape[0]
        raise SourceError(f"none of the {len(self.chosen)} images in {self.chosen[0].path.parent} can be read")

    def __iter__(self) -> Iterator[tuple[NumberedImage, Image]]:
        """Entries and their images, uint8 [height, width, 3] BGR, damaged ones left out.

        Raises:
            SourceError: an image is damaged or of another size, unless that is to be skipped.
        """
        for entry in self.chosen:
            try:
                image = self._read(entry)
            except SourceError as error:
                self._options.bad_frames.found(error)
                continue
            yield entry, image

    def _read(self, entry: NumberedImage) -> Image:
        image = read_whole_image(entry.path)
        found = (image.shape[1], image.shape[0])
        if found != self.file_size_wh:
            raise SourceError(
                f"{entry.path} is {found[0]}x{found[1]}, the sequence's first image is "
                f"{self.file_size_wh[0]}x{self.file_size_wh[1]}"
            )
        return image
