"""Coarse coding of a segmenter's uncertainty: one of four levels for each block of 8 x 8 pixels.

A block's level is 0..3 and stands for 0, 85, 170 or 255; it is the largest uncertainty of the block's pixels,
rounded up, so doubt may grow on the way but never gets lost. The plane of the levels' high bits and, below it, the
plane of their low bits make one bitmap, which travels in the coding of all masks.
"""

from __future__ import annotations

import numpy as np
from cable_codecs import CodecError, decode_mask, encode_mask

from cable_rpc.errors import ProtocolError
from cable_rpc.types import UncertaintyMap

BLOCK_PX = 8
"""Side of a block. Blocks at the right and bottom edge may hang over the frame."""
LEVEL_STEP = 85
"""From one level to the next, of 0..255."""


def encode_uncertainty(uncertainty: UncertaintyMap) -> bytes:
    """Codes a map for the downlink; never empty.

    Args:
        uncertainty: uint8 [height, width], 0 = sure, 255 = undecided.

    Raises:
        CodecError: a side outside 1..16384.
    """
    levels = (block_maxima(uncertainty).astype(np.uint16) + (LEVEL_STEP - 1)) // LEVEL_STEP
    return encode_mask(np.concatenate([levels & 2, levels & 1]) > 0)


def decode_uncertainty(data: bytes, height: int, width: int) -> UncertaintyMap:
    """Decodes the map of a frame of the given size.

    Returns:
        uint8 [height, width] of 0, 85, 170 and 255; nowhere below what was coded.

    Raises:
        ProtocolError: the data are damaged or of a map of another size.
    """
    rows, columns = -(-height // BLOCK_PX), -(-width // BLOCK_PX)
    try:
        planes = decode_mask(data, 2 * rows, columns)
    except CodecError as error:
        raise ProtocolError(f"Mask.uncertainty is damaged: {error}") from error
    levels = 2 * planes[:rows].view(np.uint8) + planes[rows:].view(np.uint8)
    # Along the short rows first: the second step then copies whole rows.
    grown = (levels * np.uint8(LEVEL_STEP)).repeat(BLOCK_PX, axis=1)[:, :width].repeat(BLOCK_PX, axis=0)
    return grown[:height]


def block_maxima(uncertainty: UncertaintyMap) -> UncertaintyMap:
    """Largest value of each block, uint8 [ceil(height / 8), ceil(width / 8)]."""
    height, width = uncertainty.shape
    rows, columns = -(-height // BLOCK_PX), -(-width // BLOCK_PX)
    padded = np.zeros((rows * BLOCK_PX, columns * BLOCK_PX), np.uint8)
    padded[:height, :width] = uncertainty
    by_rows = padded.reshape(rows, BLOCK_PX, columns * BLOCK_PX).max(axis=1)
    return np.asarray(by_rows.reshape(rows, columns, BLOCK_PX).max(axis=2), np.uint8)
