"""Encoder and decoder of frames with a region: treatment and codec in one."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Self

from cable_codecs.base import BoolMask, CodecParameters, Decoder, EncodedFrame, Encoder, Image
from cable_codecs.region_receiver import RegionReceiver, RestoredFrame
from cable_codecs.region_sender import RegionSender
from cable_codecs.registry import STILL_CODECS, create_decoder, create_encoder
from cable_codecs.sized_codecs import SizedDecoder, SizedEncoder
from cable_codecs.treatment import RegionTreatment
from cable_codecs.upload_scale import uploaded_size


@dataclass(frozen=True, slots=True)
class TreatedPacket:
    """A coded frame, and the region that must travel with it."""

    encoded: EncodedFrame
    blocks: BoolMask | None
    """bool [rows, columns] over the full picture; None: the whole frame was sent."""
    block_size: int
    treat_ns: int
    """Time the treatment took, before the encoder."""


def coded_parameters(parameters: CodecParameters, treatment: RegionTreatment) -> CodecParameters:
    """The codec's parameters for the picture that is coded: reduced, and with the quantiser's offset.

    Raises:
        CodecError: The codec can't carry pictures treated so.
    """
    treatment.check_codec(parameters.name, stateless=parameters.name in STILL_CODECS)
    height, width = uploaded_size(parameters.height, parameters.width, treatment.scale)
    return replace(
        parameters,
        height=height,
        width=width,
        background_offset=treatment.quantiser_offset,
        size_offset=treatment.size_offset,
    )


class TreatedEncoder:
    """Treats and encodes the frames of one stream. Not safe for use by several threads at once.

    Args:
        parameters: of the full picture.
        treatment: what becomes of regions.

    Raises:
        CodecError: The codec can't be opened, or can't carry pictures treated so.
    """

    def __init__(self, parameters: CodecParameters, treatment: RegionTreatment) -> None:
        coded = coded_parameters(parameters, treatment)
        # Other encoders would only check the mask's shape, and making it costs time.
        self.heeds_region = parameters.name in STILL_CODECS or treatment.quantiser_offset > 0
        self.sender = RegionSender(treatment, parameters.height, parameters.width)
        self.encoder: Encoder = create_encoder(coded) if treatment.crop == "none" else SizedEncoder(coded)

    def encode(
        self, image: Image, blocks: BoolMask | None, block_size: int = 1, *, keyframe: bool = False
    ) -> TreatedPacket:
        """Encode the next frame.

        Args:
            image: uint8 [height, width, 3], BGR; left unchanged.
            blocks: bool [ceil(height / block_size), ceil(width / block_size)], the region; None: the whole frame.
            block_size: Side of a block in pixels.
            keyframe: Make this frame one that a decoder can start at.

        Raises:
            CodecError: Arrays that don't fit, or the encoder failed.
        """
        started_ns = time.monotonic_ns()
        treated = self.sender.treat(image, blocks, block_size, keyframe=keyframe)
        treat_ns = time.monotonic_ns() - started_ns
        roi = treated.encoder_roi() if self.heeds_region else None
        encoded = self.encoder.encode(treated.image, roi, keyframe=keyframe)
        return TreatedPacket(encoded, treated.blocks, treated.block_size, treat_ns)

    def set_quality(self, quality: int) -> None:
        """Change the quality from the next frame on.

        Raises:
            CodecError: Outside the codec's range, or the codec is opened at a constant bit rate.
        """
        self.encoder.set_quality(quality)

    def close(self) -> None:
        """Release the codec."""
        self.encoder.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class TreatedDecoder:
    """Decodes the packets of a `TreatedEncoder` with the same parameters, and undoes the treatment.

    The same packets and regions give bit-identical frames in every instance. Not safe for use by several threads at
    once.

    Args:
        parameters: of the full picture.
        treatment: as the sender's.

    Raises:
        CodecError: The codec can't be opened, or can't carry pictures treated so.
    """

    def __init__(self, parameters: CodecParameters, treatment: RegionTreatment) -> None:
        coded = coded_parameters(parameters, treatment)
        self.receiver = RegionReceiver(treatment, parameters.height, parameters.width)
        self.sized = SizedDecoder(coded) if treatment.crop != "none" else None
        self.decoder: Decoder = self.sized or create_decoder(coded)

    @property
    def needs_keyframe(self) -> bool:
        """True while only a keyframe can be decoded."""
        return self.decoder.needs_keyframe

    def decode(
        self, data: bytes, blocks: BoolMask | None, block_size: int = 1, *, stamp: int | None = None
    ) -> RestoredFrame:
        """Decode one packet.

        Args:
            data: the packet.
            blocks: bool, the region that travelled with it; None: a whole frame.
            block_size: Side of a block in pixels.
            stamp: Frame number or time, for the ages of what is composed.

        Raises:
            CodecError: The packet is damaged, doesn't fit its region, or needs a keyframe before it.
        """
        box = self.receiver.crop_of(blocks, block_size)
        if self.sized is None or box is None:
            picture = self.decoder.decode(data)
        else:
            picture = self.sized.decode_sized(data, box.height, box.width)
        return self.receiver.restore(picture, blocks, block_size, stamp=stamp)

    def close(self) -> None:
        """Release the codec."""
        self.decoder.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
