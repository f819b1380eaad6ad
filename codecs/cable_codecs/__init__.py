"""Image, video and mask codecs, background fills, and quality inside a region.

Images are uint8 [height, width, 3] in BGR order; masks are bool [height, width], True inside.
"""

from cable_codecs.base import CodecParameters, Decoder, EncodedFrame, Encoder
from cable_codecs.errors import CodecError, CodecUnavailableError
from cable_codecs.fill import FillMode, fill_background, fill_blocks
from cable_codecs.h264 import DEFAULT_CRF
from cable_codecs.mask_codec import decode_mask, encode_mask
from cable_codecs.quality import roi_psnr, roi_ssim
from cable_codecs.registry import available_codecs, create_decoder, create_encoder
from cable_codecs.still import DEFAULT_QUALITY

__all__ = [
    "DEFAULT_CRF",
    "DEFAULT_QUALITY",
    "CodecError",
    "CodecParameters",
    "CodecUnavailableError",
    "Decoder",
    "EncodedFrame",
    "Encoder",
    "FillMode",
    "available_codecs",
    "create_decoder",
    "create_encoder",
    "decode_mask",
    "encode_mask",
    "fill_background",
    "fill_blocks",
    "roi_psnr",
    "roi_ssim",
]
