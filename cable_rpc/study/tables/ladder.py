"""Whole frames at several constant rate factors, each a stream of its own, coded once for all strategies."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from cable_codecs import CodecParameters, TreatedDecoder, TreatedEncoder, default_quality
from cable_codecs.quality import luma

from cable_rpc.data.source import FrameSource
from cable_rpc.study.closed_loop.lane import LaneSettings, Passage
from cable_rpc.study.tables.equal_quality import EqualQuality, Rung
from cable_rpc.types import Image
from cable_rpc.wire.v1 import perception_pb2 as pb

CRF_STEPS = (-12, -9, -6, -3, 0, 3, 6)
"""From the whole frames' own; mostly finer, since a region alone is coded better than in its frame."""
FINEST_CRF, COARSEST_CRF = 1, 51
"""CRF 0 is lossless, another profile."""


@dataclass(frozen=True, slots=True)
class CodedWhole:
    """One frame at one setting."""

    crf: int
    message_bytes: int
    luma: Image
    """uint8 [height, width], as decoded."""


@dataclass(frozen=True, slots=True)
class LadderFrame:
    """One frame at all settings."""

    luma: Image
    """uint8 [height, width], as it came from the source."""
    own_crf: int
    coded: tuple[CodedWhole, ...]
    """By rising factor."""

    def beside(self, passage: Passage) -> EqualQuality:
        """The same frame under a strategy, and all settings inside what that sent."""
        sent = np.ascontiguousarray(passage.prepared.sent_region.pixels()).view(np.uint8)
        rungs = (Rung(one.crf, one.message_bytes, self.squared_error(one.luma, sent)) for one in self.coded)
        return EqualQuality(
            int(np.count_nonzero(sent)),
            self.squared_error(luma(passage.picture), sent),
            passage.prepared.uplink_message_bytes,
            self.own_crf,
            tuple(rungs),
        )

    def squared_error(self, test: Image, sent: Image) -> float:
        """Sum over the pixels of a uint8 mask [height, width]."""
        return float(cv2.norm(self.luma, test, cv2.NORM_L2SQR, sent))


class WholeFrameLadder:
    """Encoders and decoders at every setting but the reference's own, which has been through them; close after use.

    Args:
        settings: of the reference.
        source: what the frames are of.

    Raises:
        CodecError: the codec can't be opened.
    """

    def __init__(self, settings: LaneSettings, source: FrameSource) -> None:
        width, height = source.size_wh
        own = default_quality(settings.codec) if settings.quality is None else settings.quality
        self.own_crf = own or 0
        self._streams: dict[int, tuple[TreatedEncoder, TreatedDecoder]] = {}
        for crf in ladder_crfs(self.own_crf):
            if crf != self.own_crf:
                parameters = CodecParameters(settings.codec, width, height, source.fps, crf)
                self._streams[crf] = (
                    TreatedEncoder(parameters, settings.treatment),
                    TreatedDecoder(parameters, settings.treatment),
                )

    def code(self, image: Image, whole: Passage) -> LadderFrame:
        """Code the next frame.

        Args:
            image: uint8 [height, width, 3], BGR, as it came from the source.
            whole: the same frame's way through the reference.

        Raises:
            CodecError: coding failed.
        """
        prepared = whole.prepared
        coded = [CodedWhole(self.own_crf, prepared.uplink_message_bytes, luma(whole.picture))]
        message = pb.StreamPerceptionRequest(frame=prepared.message)
        for crf, (encoder, decoder) in self._streams.items():
            packet = encoder.encode(image, None, keyframe=False).encoded
            message.frame.data = packet.data
            coded.append(CodedWhole(crf, message.ByteSize(), luma(decoder.decode(packet.data, None).image)))
        return LadderFrame(luma(image), self.own_crf, tuple(sorted(coded, key=lambda one: one.crf)))

    def close(self) -> None:
        """Release the codecs."""
        for encoder, decoder in self._streams.values():
            encoder.close()
            decoder.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def ladder_crfs(own: int) -> list[int]:
    """The factors to code at, rising, each once."""
    return sorted({own, *(min(max(own + step, FINEST_CRF), COARSEST_CRF) for step in CRF_STEPS)})
