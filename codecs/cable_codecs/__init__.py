"""Image, video and mask codecs, treatments of regions, rate control, and quality inside a region.

Images are uint8 [height, width, 3] in BGR order; masks are bool [height, width], True inside.
"""

from cable_codecs.base import CodecParameters, Decoder, EncodedFrame, Encoder
from cable_codecs.compose import BackgroundComposer
from cable_codecs.crop import CropBox
from cable_codecs.diffuse import diffuse_background
from cable_codecs.errors import CodecError, CodecUnavailableError
from cable_codecs.fill import FillMode, fill_background, fill_blocks
from cable_codecs.h264 import DEFAULT_CRF
from cable_codecs.mask_codec import decode_mask, encode_mask
from cable_codecs.probe import CodecProbe, probe_codecs
from cable_codecs.quality import roi_psnr, roi_ssim
from cable_codecs.quantiser_offset import require_offsets
from cable_codecs.rate_control import JPEG_CURVE, WEBP_CURVE, QualityCurve, StillRateController, StillRateStatus
from cable_codecs.region_receiver import RegionReceiver, RestoredFrame
from cable_codecs.region_sender import RegionSender, TreatedFrame
from cable_codecs.registry import STILL_CODECS, available_codecs, create_decoder, create_encoder, default_quality
from cable_codecs.sized_codecs import SizedDecoder, SizedEncoder
from cable_codecs.still import DEFAULT_QUALITY
from cable_codecs.treated_codec import TreatedDecoder, TreatedEncoder, TreatedPacket
from cable_codecs.treatment import RefillMode, RegionTreatment

__all__ = [
    "DEFAULT_CRF",
    "DEFAULT_QUALITY",
    "JPEG_CURVE",
    "STILL_CODECS",
    "WEBP_CURVE",
    "BackgroundComposer",
    "CodecError",
    "CodecParameters",
    "CodecProbe",
    "CodecUnavailableError",
    "CropBox",
    "Decoder",
    "EncodedFrame",
    "Encoder",
    "FillMode",
    "QualityCurve",
    "RefillMode",
    "RegionReceiver",
    "RegionSender",
    "RegionTreatment",
    "RestoredFrame",
    "SizedDecoder",
    "SizedEncoder",
    "StillRateController",
    "StillRateStatus",
    "TreatedDecoder",
    "TreatedEncoder",
    "TreatedFrame",
    "TreatedPacket",
    "available_codecs",
    "create_decoder",
    "create_encoder",
    "decode_mask",
    "default_quality",
    "diffuse_background",
    "encode_mask",
    "fill_background",
    "fill_blocks",
    "probe_codecs",
    "require_offsets",
    "roi_psnr",
    "roi_ssim",
]
