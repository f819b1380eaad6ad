"""Images in files and records that must be whole."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from cable_rpc.errors import SourceError
from cable_rpc.types import Image

JPEG_START, JPEG_SCAN, JPEG_END = b"\xff\xd8", b"\xff\xda", b"\xff\xd9"


def read_whole_image(path: Path) -> Image:
    """An image file as `decode_whole_image` gives it.

    Raises:
        SourceError: it is missing, cut off, or no image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"can't read image {path}: {error.strerror}") from error
    return decode_whole_image(data, str(path))


def decode_whole_image(data: bytes, place: str) -> Image:
    """A coded image as uint8 [height, width, 3], BGR, in the orientation that it is stored in.

    Annotations are in pixels of the stored image, so a camera's orientation tag is not heeded.

    Args:
        data: the bytes of a file.
        place: where they stand, for error texts.

    Raises:
        SourceError: they are cut off, or no image.
    """
    # OpenCV fills the rest of a cut JPEG with grey and says so on stderr only. Neither marker can occur within coded
    # data, and a thumbnail's end comes before the picture's scan.
    if data.startswith(JPEG_START) and data.rfind(JPEG_END) <= data.rfind(JPEG_SCAN):
        raise SourceError(f"{place}: the image is cut off, a JPEG of {len(data)} bytes without its end")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise SourceError(f"{place}: the image is cut off or no JPEG or PNG ({len(data)} bytes)")
    return image.astype(np.uint8, copy=False)
