"""One cell of a sweep: everything that determines it, and what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import PurePath
from typing import Any, Literal, Self

from cable_codecs import RegionTreatment

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.study.closed_loop.models import ModelChoice
from cable_rpc.study.sequence_metrics import SequenceMetrics
from cable_rpc.study.sweep.simulated_link import SimulatedLink

TruthChoice = Literal["auto", "annotated", "detector"]
"""What objects are judged by. ``annotated``: the source's own boxes; ``detector``: what the same detector finds on
the uncompressed whole frame (pseudo ground truth); ``auto``: annotated where the source has boxes."""
ANCHOR_STRATEGY = "full-frame"
ANCHOR_CODEC = "h264"


@dataclass(frozen=True, slots=True)
class ClipRequest:
    """Which frames, and what judges them: what cells share, and what is decoded and judged once for all of them."""

    source: str
    """One sequence, as `cable_rpc.data.source.open_source` takes it."""
    fps: float | None = None
    """Frames per second that are sent; None = the source's own."""
    size: tuple[int, int] | None = None
    """(width, height) that the camera's frames are resized to before anything else; None = as they are."""
    max_frames: int | None = None
    truth: TruthChoice = "auto"
    prompt: str = ""
    models: ModelChoice = field(default_factory=ModelChoice)


@dataclass(frozen=True, slots=True)
class RatePoint:
    """Where on its curve a cell lies: a constant quality, or a target bit rate."""

    quality: int | None = None
    """JPEG/WebP 1..100, video codecs CRF; None = the codec's default, or rate control."""
    bitrate_kbps: int | None = None

    @property
    def label(self) -> str:
        """ "q 28" or "600 kbit/s"; equal labels pool over sequences."""
        if self.bitrate_kbps is not None:
            return f"{self.bitrate_kbps} kbit/s"
        return "default" if self.quality is None else f"q {self.quality}"


@dataclass(frozen=True, slots=True)
class SweepCell:
    """One combination of all axes."""

    clip: ClipRequest
    strategy: str
    """As `cable_rpc.study.strategies.open_strategy` takes it."""
    treatment_label: str
    """The treatment's name in the sweep, for people; takes no part in the cell's identity."""
    treatment: RegionTreatment
    """Upload scale included."""
    codec: str
    rate: RatePoint
    feedback_delay: int = 1
    """Frames after which an answer is there at the earliest; 1 = before the next frame is looked at."""
    link: SimulatedLink | None = None
    """None = an answer takes no time but the feedback delay, and no frame is dropped."""
    roi: RoiConfig = field(default_factory=RoiConfig)
    roi_label: str = "robust"
    """The ROI settings' name, for people."""
    block_size: int = 8
    name: str = ""
    """For people, in place of what `method` is otherwise put together from."""

    @property
    def method(self) -> str:
        """Everything but the sequence and the rate point, for people: cells of equal method lie on one curve."""
        if self.name:
            return self.name
        kind, separator, detector = self.strategy.partition(":")
        parts = [f"{kind}{separator}{PurePath(detector).stem}"]
        if self.strategy != ANCHOR_STRATEGY:
            parts.append(self.treatment_label)
        parts.append(self.codec)
        if self.treatment.scale != 1.0:
            parts.append(f"scale {self.treatment.scale:g}")
        if self.clip.fps is not None:
            parts.append(f"{self.clip.fps:g} fps")
        if self.link is not None:
            parts.append(self.link.name)
        if self.feedback_delay != 1:
            parts.append(f"delay {self.feedback_delay}")
        if self.roi_label != "robust":
            parts.append(self.roi_label)
        return " · ".join(parts)

    @property
    def setting(self) -> str:
        """What was turned along the method's curve, for people; equal settings pool over sequences."""
        return self.rate.label if self.treatment.scale == 1.0 else f"{self.rate.label}, scale {self.treatment.scale:g}"

    @property
    def title(self) -> str:
        """For people: sequence, method and rate point."""
        return f"{self.clip.source}, {self.method}, {self.rate.label}"

    def settings(self) -> dict[str, Any]:
        """All that determines the cell, but for code and weights, as plain JSON values; labels are left out."""
        content = asdict(self)
        del content["treatment_label"], content["roi_label"], content["name"]
        if self.link is not None:
            del content["link"]["name"]
        return content


@dataclass(frozen=True, slots=True)
class RegionQuality:
    """Sums over frames of a picture's fidelity inside a region."""

    frames: int = 0
    """In which the region was not empty and the frame arrived."""
    pixels: int = 0
    squared_error: float = 0.0
    """Of luma, in grey levels squared."""
    ssim: float = 0.0
    """Sum of the frames' SSIM of luma."""
    ssim_frames: int = 0

    def __add__(self, other: RegionQuality) -> RegionQuality:
        return RegionQuality(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(self)))


@dataclass(frozen=True, slots=True)
class UplinkBytes:
    """What the uplink's bytes were spent on; the four add up to all of them."""

    keyframe_pictures: int = 0
    """Coded pictures of frames that were sent whole because the loop wanted it, the first frame included."""
    region_pictures: int = 0
    """Coded pictures of all other frames."""
    side_information: int = 0
    """Coded regions."""
    message_overhead: int = 0
    """Everything else in the messages: ego-motion, stamps, identifiers, framing."""

    def __add__(self, other: UplinkBytes) -> UplinkBytes:
        return UplinkBytes(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(self)))

    @property
    def total(self) -> int:
        """All bytes up at the message layer."""
        return self.keyframe_pictures + self.region_pictures + self.side_information + self.message_overhead


@dataclass(frozen=True, slots=True)
class CellResult:
    """What a cell came to; sums, so that sequences pool."""

    sequence: str
    """The source's own name."""
    seconds: float
    """Frames over frame rate, dropped ones included: what bytes are divided by."""
    truth: Literal["annotated", "detector"]
    """What objects were judged by."""
    detector: str
    """With revision and device."""
    segmenter: str
    metrics: SequenceMetrics
    """Of all frames; a dropped one is a frame with nothing sent and nothing found. `SequenceMetrics.end_to_end_ns` is
    the sum of the stages as timed, or, with a link, the simulated time from capture to answer."""
    uplink: UplinkBytes
    sent: RegionQuality
    """Inside what was sent, which differs from strategy to strategy."""
    objects: RegionQuality
    """Inside the boxes of the objects that are judged by, sent or not: the same pixels for every strategy."""
    dropped: int = 0
    """Frames that a full link left no room for."""
    size_wh: tuple[int, int] = (0, 0)

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        content = {one.name: getattr(self, one.name) for one in fields(self)}
        content |= {name: asdict(content[name]) for name in ("uplink", "sent", "objects")}
        return content | {"metrics": self.metrics.to_json(), "size_wh": list(self.size_wh)}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """The inverse of `to_json`.

        Raises:
            ConfigurationError, KeyError, TypeError, ValueError: it does not hold a cell's result.
        """
        return cls(
            **{
                **content,
                "metrics": SequenceMetrics.from_json(content["metrics"]),
                "uplink": UplinkBytes(**content["uplink"]),
                "sent": RegionQuality(**content["sent"]),
                "objects": RegionQuality(**content["objects"]),
                "size_wh": tuple(content["size_wh"]),
            }
        )


@dataclass(frozen=True, slots=True)
class ExampleFrame:
    """One received picture of a cell, for the report."""

    index: int
    picture: bytes
    """JPEG, at most 640 pixels wide, as the models saw it; the kept detections boxed in green, the lost in red, the
    invented in yellow."""
    message_bytes: int
    """What it cost to send."""


@dataclass(frozen=True, slots=True)
class MeasuredCell:
    """What became of a cell."""

    cell: SweepCell
    result: CellResult | None
    """None where it failed."""
    error: str = ""
    """Why it failed, one line; empty where it didn't."""
    example: ExampleFrame | None = None
    seconds_taken: float = 0.0
    """Of computing."""
    key: str = ""
    """Under which it is stored; empty before it is."""
