"""JPEG images held in records and tables."""

from __future__ import annotations

import cv2
import numpy as np

from cable_rpc.errors import SourceError
from cable_rpc.types import Image

JPEG_SCAN, JPEG_END = b"\xff\xda", b"\xff\xd9"


def decode_jpeg(data: bytes, place: str) -> Image:
    """A whole JPEG as uint8 [height, width, 3], BGR.

    Args:
        data: the file's bytes.
        place: where they stand, for error texts.

    Raises:
        SourceError: it is cut off, or no image.
    """
    # OpenCV fills the rest of a cut JPEG with grey and says so on stderr only. Neither marker can occur within coded
    # data, and a thumbnail's end comes before the picture's scan.
    if data.rfind(JPEG_END) <= data.rfind(JPEG_SCAN):
        raise SourceError(f"{place}: the image is cut off or no JPEG ({len(data)} bytes)")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise SourceError(f"{place}: the image can't be decoded ({len(data)} bytes)")
    return image.astype(np.uint8, copy=False)
