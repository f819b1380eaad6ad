"""What the tables are made of: which sequences, and how each of them is run."""

from __future__ import annotations

from dataclasses import dataclass, field

from cable_codecs import STILL_CODECS, RegionTreatment, default_quality

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.study.closed_loop.models import ModelChoice

REFERENCE_CODEC = "h264"
"""Whole frames are always coded in it: what any saving of bytes is held against."""
FULL_FRAME = "full-frame"
"""The strategy that is its own reference."""


@dataclass(frozen=True, slots=True)
class SequenceRequest:
    """One sequence of a data set."""

    dataset: str
    """Scheme of its source, e.g. ``kitti``; sequences of one scheme share a row."""
    spec: str
    """As `cable_rpc.data.source.open_source` takes it."""


@dataclass(frozen=True, slots=True)
class RunSettings:
    """How a sequence is run; the same for all cells of a table."""

    roi: RoiConfig = field(default_factory=RoiConfig)
    codec: str = "h264"
    quality: int | None = None
    """JPEG/WebP 1..100, video codecs CRF; None = the codec's default."""
    treatment: RegionTreatment | None = None
    """What becomes of regions before coding; None = what measured best for the codec."""
    block_size: int = 8
    segmenter: str = "embedded"
    detector: str = "embedded"
    device: str = "auto"
    threads: int = 1
    """CPU threads of each model."""
    prompt: str = ""
    max_frames: int | None = None
    size: tuple[int, int] | None = None
    """(width, height) to resize to."""
    fps: float | None = None
    skip_bad: bool = False
    equal_quality: bool = True
    """Whether whole frames are also coded at other settings, for the bytes that equal quality takes."""

    @property
    def models(self) -> ModelChoice:
        """What answers the frames."""
        return ModelChoice(self.segmenter, self.detector, self.device, self.threads)

    @property
    def used_treatment(self) -> RegionTreatment:
        """The treatment, the codec's own where none was asked for."""
        return self.treatment or RegionTreatment.default_for(stateless=self.codec in STILL_CODECS)

    @property
    def reference_quality(self) -> int | None:
        """CRF of the whole frames: the same as that of the regions where both have the codec in common."""
        return self.quality if self.codec == REFERENCE_CODEC else None

    @property
    def quality_text(self) -> str:
        """The codec and its setting, for people."""
        return coded_as(self.codec, self.quality)

    @property
    def reference_text(self) -> str:
        """The same of the whole frames."""
        return coded_as(REFERENCE_CODEC, self.reference_quality)


def coded_as(codec: str, quality: int | None) -> str:
    """ "h264 at CRF 28"."""
    setting = default_quality(codec) if quality is None else quality
    if setting is None:
        return f"{codec}, lossless"
    return f"{codec} at quality {setting}" if codec in STILL_CODECS else f"{codec} at CRF {setting}"
