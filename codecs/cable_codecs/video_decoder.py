"""Decoding live video of any codec, one picture for each packet."""

from __future__ import annotations

from av.video.codeccontext import VideoCodecContext

from cable_codecs.base import CodecParameters, Decoder, Image
from cable_codecs.colour import I420ToBgr
from cable_codecs.errors import CodecError
from cable_codecs.ffmpeg import decode_single, open_decoder, read_picture
from cable_codecs.video_format import PacketSummary, VideoFormat


class VideoDecoder(Decoder):
    """Starts at a keyframe, and after any error waits for the next one rather than show drifted frames.

    Every keyframe is decoded in a fresh context, so nothing that came before, damaged or not, can change it or the
    pictures that follow. That costs up to half a millisecond for each.

    A packet that never arrives can't be noticed here: the decoder goes on with a stale reference and without
    an error. Number the packets in the transport and ask for a keyframe where one is missing. Nor do AV1 and VP9
    notice bits changed inside a picture.
    """

    def __init__(self, parameters: CodecParameters, video: VideoFormat) -> None:
        super().__init__(parameters)
        self.video = video
        self.implementation = video.decoder
        self.coded_size = video.coded_size(parameters)
        self.context: VideoCodecContext | None = open_decoder(video.decoder, parameters)
        self.context_is_fresh = True
        self.to_image = I420ToBgr(parameters.height, parameters.width, full_range=False, coded=self.coded_size)
        self.synchronised = False

    @property
    def needs_keyframe(self) -> bool:
        """True at the start and after an error, until a keyframe decodes cleanly."""
        return not self.synchronised

    def decode(self, data: bytes) -> Image:
        """Decode one packet."""
        name = self.parameters.name
        if self.context is None:
            raise CodecError(f"{name} decoder is closed; open a new one")
        was_synchronised, self.synchronised = self.synchronised, False
        summary = self.check_packet(data, was_synchronised)
        if summary.keyframe and not self.context_is_fresh:
            self.context = open_decoder(self.video.decoder, self.parameters)
        self.context_is_fresh = False
        frame = decode_single(self.context, data, self.parameters)
        read_picture(frame, self.to_image.picture, self.coded_size, ("yuv420p",), name)
        self.synchronised = True
        return self.to_image()

    def check_packet(self, data: bytes, synchronised: bool) -> PacketSummary:
        """Check that a packet is one picture that can be decoded in the decoder's state.

        Returns:
            What its headers say.

        Raises:
            CodecError: No picture or several in the packet, or a keyframe with its headers is needed.
        """
        name = self.parameters.name
        summary = self.video.summarise(data)
        if summary.picture_count != 1:
            raise CodecError(
                f"{name} packet of {len(data)} bytes holds {summary.picture_count} pictures, expected exactly one; "
                "send each packet whole, as the encoder made it"
            )
        if summary.keyframe and not summary.has_headers:
            raise CodecError(
                f"{name} keyframe comes without its headers; put {self.video.headers} in band before each keyframe"
            )
        if not synchronised and not summary.keyframe:
            raise CodecError(f"{name} decoder needs a keyframe first, got a predicted picture; request a keyframe")
        return summary

    def close(self) -> None:
        """Release the codec."""
        self.context = None
