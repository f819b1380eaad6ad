"""Conversions between BGR images and the planar 4:2:0 pictures that codecs take.

Two YCbCr variants of ITU-R BT.601: limited range (H.264, WebP), by OpenCV both ways, and full range (JPEG, as
JFIF demands). swscale, FFmpeg's converter, is not used: its default path loses 10 dB and is biased.

A picture is a uint8 array ``[even_height * 3 / 2, even_width]`` in I420 layout: Y, then Cb, then Cr.
Odd sizes are padded to even ones by repeating the last row or column, and to a codec's least size likewise.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Plane = npt.NDArray[np.uint8]
Image = npt.NDArray[np.uint8]


def even(length: int) -> int:
    """The length rounded up to an even number."""
    return length + (length & 1)


def empty_picture(height: int, width: int) -> Plane:
    """An uninitialised I420 picture for an image of the given size, padded to even sides."""
    return np.empty((even(height) * 3 // 2, even(width)), np.uint8)


def picture_planes(picture: Plane) -> tuple[Plane, Plane, Plane]:
    """Views of the Y [h, w], Cb and Cr [h/2, w/2] planes of an I420 picture."""
    width = picture.shape[1]
    height = picture.shape[0] * 2 // 3
    flat = picture.reshape(-1)
    luma_size, chroma_size = height * width, height * width // 4
    chroma_shape = (height // 2, width // 2)
    return (
        flat[:luma_size].reshape(height, width),
        flat[luma_size : luma_size + chroma_size].reshape(chroma_shape),
        flat[luma_size + chroma_size :].reshape(chroma_shape),
    )


class BgrToI420:
    """Converts images of one size to I420, reusing its buffers; each call overwrites the last result."""

    def __init__(self, height: int, width: int, *, full_range: bool, coded: tuple[int, int] | None = None) -> None:
        """Prepare for images of one size; ``coded`` is the (height, width) of the picture, even, None for the least."""
        self.full_range = full_range
        self.height, self.width = height, width
        coded = coded or (even(height), even(width))
        self.picture = empty_picture(*coded)
        self.planes = picture_planes(self.picture)
        size = (*coded, 3)
        self.padded = np.empty(size, np.uint8) if coded != (height, width) else None
        if full_range:
            self.ycrcb = np.empty(size, np.uint8)
            self.halved = np.empty((size[0] // 2, size[1] // 2, 3), np.uint8)

    def __call__(self, image: Image) -> Plane:
        """Convert a BGR image uint8 [height, width, 3] to the I420 picture, BT.601."""
        if self.padded is not None:
            image = pad_by_repeating(image, self.padded)
        if self.full_range:
            self.convert_full_range(image)
        else:
            cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420, dst=self.picture)
        return self.picture

    def convert_full_range(self, image: Image) -> None:
        """JFIF: full-range YCbCr, chroma averaged over 2x2 pixels."""
        luma, blue, red = self.planes
        cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb, dst=self.ycrcb)
        halved_size = (blue.shape[1], blue.shape[0])
        cv2.resize(self.ycrcb, halved_size, dst=self.halved, interpolation=cv2.INTER_AREA)
        cv2.extractChannel(self.ycrcb, 0, dst=luma)
        cv2.extractChannel(self.halved, 2, dst=blue)
        cv2.extractChannel(self.halved, 1, dst=red)


def pad_by_repeating(image: Image, out: Image) -> Image:
    """Copy an image into a larger buffer, repeating its last row and column."""
    height, width = image.shape[:2]
    out[:height, :width] = image
    out[:height, width:] = image[:, width - 1 :]
    out[height:] = out[height - 1 : height]
    return out


class I420ToBgr:
    """Converts I420 pictures, BT.601, of one size to images; the caller fills ``picture`` first."""

    def __init__(self, height: int, width: int, *, full_range: bool, coded: tuple[int, int] | None = None) -> None:
        """Prepare for images of one size; ``coded`` is the (height, width) of the picture, even, None for the least."""
        self.full_range = full_range
        self.height, self.width = height, width
        coded = coded or (even(height), even(width))
        self.picture = empty_picture(*coded)
        self.planes = picture_planes(self.picture)
        if full_range:
            self.chroma = np.empty((2, *coded), np.uint8)
            self.ycrcb = np.empty((*coded, 3), np.uint8)

    def __call__(self) -> Image:
        """The image of the picture, a new uint8 [height, width, 3], BGR, without the padding."""
        if self.full_range:
            image = self.convert_full_range()
        else:
            image = np.asarray(cv2.cvtColor(self.picture, cv2.COLOR_YUV2BGR_I420), np.uint8)
        return np.ascontiguousarray(image[: self.height, : self.width])

    def convert_full_range(self) -> Image:
        """JFIF, each chroma sample repeated over its 2x2 pixels: the exact inverse of averaging where flat."""
        luma, blue, red = self.planes
        size = (luma.shape[1], luma.shape[0])
        for plane, grown in zip((red, blue), self.chroma, strict=True):
            cv2.resize(plane, size, dst=grown, interpolation=cv2.INTER_NEAREST)
        cv2.merge([luma, *self.chroma], dst=self.ycrcb)
        return np.asarray(cv2.cvtColor(self.ycrcb, cv2.COLOR_YCrCb2BGR), np.uint8)
