"""One frame after another through treatment, encoder, decoder and the treatment's undoing, timed and counted."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
from cable_codecs import CodecParameters, Decoder, Encoder, create_decoder, create_encoder, encode_mask
from cable_codecs.region_receiver import RegionReceiver
from cable_codecs.region_sender import RegionSender, TreatedFrame
from cable_codecs.treatment import RegionTreatment

from cable_rpc.study.study_points import Setting
from cable_rpc.study.study_treatments import find_treatment
from cable_rpc.types import BoolMask, Image, RoiMask


@dataclass(frozen=True, slots=True)
class Passage:
    """What became of one frame."""

    shown: Image
    """uint8 [height, width, 3], BGR, at the far end."""
    bitstream_bytes: int
    mask_bytes: int
    coverage: float
    """Share of the picture that was sent, 0..1."""
    durations_ns: tuple[int, int, int, int]
    """Treatment with mask coding, encoder, decoder, undoing."""


class CodedLoop:
    """A setting opened for frames of one size. An image codec is opened again for each size of crop that comes."""

    def __init__(self, setting: Setting, height: int, width: int, fps: float) -> None:
        """Open.

        Raises:
            ConfigurationError: Unknown treatment.
            CodecError: The codec can't be opened with this quality, or not for this treatment.
        """
        treatment = find_treatment(setting.treatment)
        self.treatment = RegionTreatment() if treatment is None else treatment
        self.always_whole = treatment is None
        self.setting = setting
        self.fps = fps
        self.sender = RegionSender(self.treatment, height, width)
        self.receiver = RegionReceiver(self.treatment, height, width)
        self.stack = ExitStack()
        self.codecs: dict[tuple[int, int], tuple[Encoder, Decoder]] = {}
        self.frame_count = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stack.close()

    def step(self, image: Image, region: BoolMask | None) -> Passage:
        """Send one frame.

        Args:
            image: uint8 [height, width, 3], BGR.
            region: bool [height, width], what must be seen; None sends the frame whole.

        Raises:
            CodecError: The codec failed.
        """
        started = time.perf_counter_ns()
        wanted = None if self.always_whole else region
        treated = self.sender.treat(image, wanted, keyframe=self.frame_count == 0)
        mask = b"" if treated.blocks is None else encode_mask(treated.blocks)
        roi = self.encoder_roi(treated) if self.treatment.quantiser_offset > 0 else None
        ready = time.perf_counter_ns()
        encoder, decoder = self.codecs_for(treated.image.shape[0], treated.image.shape[1])
        encoded = encoder.encode(treated.image, roi)
        packed = time.perf_counter_ns()
        decoded = decoder.decode(encoded.data)
        unpacked = time.perf_counter_ns()
        restored = self.receiver.restore(decoded, treated.blocks, treated.block_size)
        durations = (ready - started, encoded.duration_ns, unpacked - packed, time.perf_counter_ns() - unpacked)
        self.frame_count += 1
        coverage = 1.0
        if treated.blocks is not None:
            height, width = image.shape[:2]
            coverage = RoiMask(np.asarray(treated.blocks), treated.block_size, height, width).coverage
        return Passage(restored.image, len(encoded.data), len(mask), coverage, durations)

    def encoder_roi(self, treated: TreatedFrame) -> BoolMask:
        """Where the encoder is to spend its bits: everywhere in a frame that is sent whole."""
        roi = treated.encoder_roi()
        # Not None: x265 crashes on offsets that only begin after the first frame.
        return np.ones(treated.image.shape[:2], np.bool_) if roi is None else roi

    def codecs_for(self, height: int, width: int) -> tuple[Encoder, Decoder]:
        """Encoder and decoder for pictures of a size."""
        if (height, width) not in self.codecs:
            parameters = CodecParameters(
                self.setting.codec,
                width,
                height,
                frame_rate=self.fps,
                quality=self.setting.quality,
                background_offset=self.treatment.quantiser_offset,
            )
            encoder = self.stack.enter_context(create_encoder(parameters))
            self.codecs[height, width] = encoder, self.stack.enter_context(create_decoder(parameters))
        return self.codecs[height, width]
