"""Image codecs for pictures whose size changes from frame to frame, as crops do."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace

from cable_codecs.base import BoolMask, CodecParameters, Decoder, EncodedFrame, Encoder, Image
from cable_codecs.errors import CodecError
from cable_codecs.registry import STILL_CODECS, create_decoder, create_encoder

MOST_SIZES = 64
"""Sizes kept open at once; the rows of a 1024 line picture, cropped at multiples of 16, have as many."""


class SizedEncoder(Encoder):
    """An image encoder that takes any size up to the one in ``parameters``."""

    def __init__(self, parameters: CodecParameters) -> None:
        super().__init__(parameters)
        check_stateless(parameters)
        self.quality = parameters.quality
        whole = create_encoder(parameters)
        self.implementation = whole.implementation
        self.encoders = OrderedDict({(parameters.height, parameters.width): whole})
        self.closed = False

    def set_quality(self, quality: int) -> None:
        """Change the quality from the next frame on, whatever its size."""
        for encoder in self.encoders.values():
            encoder.set_quality(quality)
        self.quality = quality

    def encode(self, image: Image, roi: BoolMask | None = None, *, keyframe: bool = False) -> EncodedFrame:
        """Encode one image of any size up to that in ``parameters``."""
        if self.closed:
            raise CodecError(f"{self.parameters.name} encoder is closed; open a new one")
        size = (image.shape[0], image.shape[1])
        check_size(size, self.parameters)
        if size not in self.encoders:
            self.encoders[size] = create_encoder(at_size(replace(self.parameters, quality=self.quality), size))
        self.encoders.move_to_end(size)
        if len(self.encoders) > MOST_SIZES:
            self.encoders.popitem(last=False)[1].close()
        return self.encoders[size].encode(image, roi, keyframe=keyframe)

    def close(self) -> None:
        """Release the codecs."""
        for encoder in self.encoders.values():
            encoder.close()
        self.encoders.clear()
        self.closed = True


class SizedDecoder(Decoder):
    """An image decoder that is told the size of each picture, at most the one in ``parameters``."""

    def __init__(self, parameters: CodecParameters) -> None:
        super().__init__(parameters)
        check_stateless(parameters)
        whole = create_decoder(parameters)
        self.implementation = whole.implementation
        self.decoders = OrderedDict({(parameters.height, parameters.width): whole})
        self.closed = False

    @property
    def needs_keyframe(self) -> bool:
        """False: every image stands alone."""
        return False

    def decode(self, data: bytes) -> Image:
        """Decode a picture of the size in ``parameters``."""
        return self.decode_sized(data, self.parameters.height, self.parameters.width)

    def decode_sized(self, data: bytes, height: int, width: int) -> Image:
        """Decode a picture.

        Args:
            data: Of the size given, anything else is refused.
            height: Pixels, at most that in ``parameters``.
            width: Pixels, at most that in ``parameters``.

        Raises:
            CodecError: The data are damaged or of another size, or the size is too large.
        """
        if self.closed:
            raise CodecError(f"{self.parameters.name} decoder is closed; open a new one")
        size = (height, width)
        check_size(size, self.parameters)
        if size not in self.decoders:
            self.decoders[size] = create_decoder(at_size(self.parameters, size))
        self.decoders.move_to_end(size)
        if len(self.decoders) > MOST_SIZES:
            self.decoders.popitem(last=False)[1].close()
        return self.decoders[size].decode(data)

    def close(self) -> None:
        """Release the codecs."""
        for decoder in self.decoders.values():
            decoder.close()
        self.decoders.clear()
        self.closed = True


def check_stateless(parameters: CodecParameters) -> None:
    """Check that every picture of a codec stands alone.

    Raises:
        CodecError: It is a video codec, whose pictures can't change their size.
    """
    if parameters.name not in STILL_CODECS:
        raise CodecError(
            f"{parameters.name} pictures can't change their size from frame to frame; use an image codec: "
            f"{', '.join(sorted(STILL_CODECS))}"
        )


def check_size(size: tuple[int, int], parameters: CodecParameters) -> None:
    """Check a picture's (height, width).

    Raises:
        CodecError: Empty, or larger than announced.
    """
    height, width = size
    if not (1 <= height <= parameters.height and 1 <= width <= parameters.width):
        raise CodecError(
            f"a {parameters.name} picture may be up to {parameters.width}x{parameters.height}, got {width}x{height}"
        )


def at_size(parameters: CodecParameters, size: tuple[int, int]) -> CodecParameters:
    """The same parameters for another (height, width)."""
    return replace(parameters, height=size[0], width=size[1])
