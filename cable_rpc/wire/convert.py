"""Conversions between protobuf messages and domain types; the only place where both meet field by field."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from cable_codecs import CodecError, decode_mask, encode_mask
from google.rpc import code_pb2, error_details_pb2, status_pb2

from cable_rpc.errors import CableError, ProtocolError, Refusal
from cable_rpc.types import CameraIntrinsics, Detections, EgoMotion, PrefillCost, RoiMask, Segmentation
from cable_rpc.wire.uncertainty import decode_uncertainty, encode_uncertainty
from cable_rpc.wire.v1 import perception_pb2 as pb

PROTOCOL_REVISION = 1

CODECS_BY_NAME = {
    "h264": pb.CODEC_H264,
    "hevc": pb.CODEC_H265,
    "av1": pb.CODEC_AV1,
    "vp9": pb.CODEC_VP9,
    "jpeg": pb.CODEC_JPEG,
    "jpeg-ffmpeg": pb.CODEC_JPEG,
    "webp": pb.CODEC_WEBP,
    "webp-lossless": pb.CODEC_WEBP_LOSSLESS,
}
"""Codec of `cable_codecs` to bitstream format; some differ in the encoder only."""
CODEC_NAMES = {
    pb.CODEC_H264: "h264",
    pb.CODEC_H265: "hevc",
    pb.CODEC_AV1: "av1",
    pb.CODEC_VP9: "vp9",
    pb.CODEC_JPEG: "jpeg",
    pb.CODEC_WEBP: "webp",
    pb.CODEC_WEBP_LOSSLESS: "webp-lossless",
}
"""Bitstream format to the codec that decodes it."""


def codec_name(codec: pb.Codec) -> str:
    """The codec's name in `cable_codecs`.

    Raises:
        ProtocolError: if this build does not decode it.
    """
    if codec not in CODEC_NAMES:
        try:
            shown = pb.Codec.Name(codec)
        except ValueError:
            shown = str(codec)
        raise ProtocolError(
            f"CodecConfig.codec is {shown}, which this server does not decode; use one of {', '.join(CODECS_BY_NAME)}"
        )
    return CODEC_NAMES[codec]


def region_to_message(roi: RoiMask) -> pb.Region:
    """Codes a region for the uplink."""
    rows, columns = roi.blocks.shape
    return pb.Region(block_size=roi.block_size, columns=columns, rows=rows, data=encode_mask(roi.blocks))


def region_from_message(region: pb.Region, height: int, width: int) -> RoiMask:
    """Decodes a region that belongs to a frame of the given size.

    Raises:
        ProtocolError: if the grid does not fit the frame or the bitmap is damaged.
    """
    size = region.block_size
    if not 1 <= size <= max(height, width):
        raise ProtocolError(f"Region.block_size is {size}; it must lie in 1..{max(height, width)}")
    expected = (-(-height // size), -(-width // size))
    if (region.rows, region.columns) != expected:
        raise ProtocolError(
            f"Region is {region.columns}x{region.rows} blocks of {size} px, but a {width}x{height} frame "
            f"has {expected[1]}x{expected[0]}"
        )
    try:
        blocks = decode_mask(region.data, region.rows, region.columns)
    except CodecError as error:
        raise ProtocolError(f"Region.data is damaged: {error}") from error
    return RoiMask(blocks, size, height, width)


def detections_to_messages(detections: Detections) -> list[pb.Detection]:
    """One message for each box, in order."""
    rows = zip(detections.boxes_xyxy.tolist(), detections.class_ids.tolist(), detections.scores.tolist(), strict=True)
    return [
        pb.Detection(x_min=box[0], y_min=box[1], x_max=box[2], y_max=box[3], class_id=class_id, score=score)
        for box, class_id, score in rows
    ]


def detections_from_messages(messages: Iterable[pb.Detection]) -> Detections:
    """The inverse of `detections_to_messages`."""
    rows = [(m.x_min, m.y_min, m.x_max, m.y_max, m.score, m.class_id) for m in messages]
    if not rows:
        return Detections.empty()
    table = np.array(rows, np.float64)
    return Detections(table[:, :4].astype(np.float32), table[:, 5].astype(np.int32), table[:, 4].astype(np.float32))


def mask_to_message(segmentation: Segmentation) -> pb.Mask:
    """Codes a segmenter's answer for the downlink; its stages travel in ServerTiming instead."""
    height, width = segmentation.mask.shape
    uncertainty, prefill = segmentation.uncertainty, segmentation.prefill
    return pb.Mask(
        width=width,
        height=height,
        data=encode_mask(segmentation.mask),
        confidence=segmentation.confidence,
        tokens_in=segmentation.tokens_in,
        tokens_full=segmentation.tokens_full,
        uncertainty=b"" if uncertainty is None else encode_uncertainty(uncertainty),
        prefill=None if prefill is None else prefill_to_message(prefill),
        answer=segmentation.answer,
        decoding=segmentation.decoding,
    )


def mask_from_message(message: pb.Mask, height: int, width: int) -> Segmentation:
    """Decodes a mask that must have the frame's size; what the server does not tell is None or empty.

    Raises:
        ProtocolError: if the size differs, or the bitmap or the uncertainty is damaged.
    """
    if (message.height, message.width) != (height, width):
        raise ProtocolError(f"the server sent a {message.width}x{message.height} mask for a {width}x{height} frame")
    try:
        mask = decode_mask(message.data, height, width)
    except CodecError as error:
        raise ProtocolError(f"Mask.data is damaged: {error}") from error
    uncertainty = decode_uncertainty(message.uncertainty, height, width) if message.uncertainty else None
    return Segmentation(
        mask,
        message.confidence,
        message.tokens_in,
        message.tokens_full,
        uncertainty,
        prefill_from_message(message.prefill) if message.HasField("prefill") else None,
        answer=message.answer,
        decoding=message.decoding,
    )


def prefill_to_message(prefill: PrefillCost) -> pb.PrefillCost:
    """The cost of a language model's prefill for the downlink."""
    return pb.PrefillCost(
        prompt_tokens=prefill.prompt_tokens,
        speedup_quadratic=prefill.speedup_quadratic,
        speedup_flops=prefill.speedup_flops,
        measured_ns=prefill.measured_ns,
        whole_ns=prefill.whole_ns,
    )


def prefill_from_message(message: pb.PrefillCost) -> PrefillCost:
    """The inverse of `prefill_to_message`."""
    return PrefillCost(
        message.prompt_tokens,
        message.speedup_quadratic,
        message.speedup_flops,
        message.measured_ns,
        message.whole_ns,
    )


def ego_to_message(ego: EgoMotion) -> pb.EgoMotion:
    """Vehicle motion for the uplink."""
    return pb.EgoMotion(speed_mps=ego.speed_mps, lateral_mps=ego.lateral_mps, yaw_rate_radps=ego.yaw_rate_radps)


def intrinsics_to_message(intrinsics: CameraIntrinsics) -> pb.CameraIntrinsics:
    """Camera geometry for the hello."""
    return pb.CameraIntrinsics(
        focal_x=intrinsics.fx, focal_y=intrinsics.fy, center_x=intrinsics.cx, center_y=intrinsics.cy
    )


def status_of(error: CableError) -> status_pb2.Status:
    """The in-band status that an error travels as; a refusal brings a google.rpc.RetryInfo."""
    number, _ = error.code.value
    status = status_pb2.Status(code=number, message=str(error))
    if isinstance(error, Refusal):
        retry = error_details_pb2.RetryInfo()
        retry.retry_delay.FromNanoseconds(round(error.retry_after_s * 1e9))
        status.details.add().Pack(retry)
    return status


def retry_after_s(status: status_pb2.Status) -> float | None:
    """The seconds after which the peer may ask again; None where the status does not say."""
    for detail in status.details:
        retry = error_details_pb2.RetryInfo()
        if detail.Unpack(retry):
            return retry.retry_delay.ToNanoseconds() / 1e9
    return None


def status_code_name(status: status_pb2.Status) -> str:
    """E.g. "INVALID_ARGUMENT"."""
    try:
        return str(code_pb2.Code.Name(status.code))
    except ValueError:
        return f"code {status.code}"
