"""One rate point of a codec study: a clip, a treatment, a codec and a quality, coded and judged frame by frame."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice

import numpy as np
import numpy.typing as npt
from cable_codecs import roi_psnr, roi_ssim
from cable_codecs.quality import without_rim

import cable_rpc
from cable_rpc.cloud.backends import BackendOptions, load_detector
from cable_rpc.data.source import FrameSource, open_source
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.coded_loop import CodedLoop, Passage
from cable_rpc.study.inspect_loop import DetectorCloud
from cable_rpc.study.loop_simulator import CloudModel, TruthCloud
from cable_rpc.study.metrics import visible_truth
from cable_rpc.study.study_masks import StudyRegion, check_truth, corridor_regions, loop_regions
from cable_rpc.study.study_points import ClipRequest, Setting, StudyPoint
from cable_rpc.types import BoolMask, Frame, GroundTruth, Image

PEAK = 255.0


@dataclass(frozen=True, slots=True)
class PreparedClip:
    """Frames in memory with their regions."""

    request: ClipRequest
    frames: tuple[Frame, ...]
    regions: tuple[StudyRegion, ...]
    fps: float


def check_clip(request: ClipRequest) -> None:
    """Look at a clip's first frame, so that one that can't be studied is found before hours of work.

    Raises:
        ConfigurationError: The request doesn't fit the clip.
        SourceError: The clip can't be read.
    """
    first = list(islice(open_request(request), 1))
    if not first:
        raise ConfigurationError(f"'{request.clip}' has no frames to study")
    if request.mask == "loop" and request.detector is None:
        check_truth(first, request.clip)


def open_request(request: ClipRequest) -> FrameSource:
    """The clip, cut and resized as asked for."""
    return open_source(request.clip, max_frames=request.frame_limit, size=request.size, fps=request.fps)


@lru_cache(maxsize=1)
def prepare_clip(request: ClipRequest) -> PreparedClip:
    """Read a clip and find its regions; the last one stays in memory.

    Raises:
        ConfigurationError: The request doesn't fit the clip.
        SourceError: The clip can't be read.
        ModelError: The detector can't be loaded.
    """
    source = open_request(request)
    frames = tuple(source)
    if not frames:
        raise ConfigurationError(f"'{request.clip}' has no frames to study")
    if request.mask == "corridor":
        regions = tuple(corridor_regions(frames))
    else:
        regions = tuple(loop_regions(frames, cloud_of(request, frames)))
    return PreparedClip(request, frames, regions, source.fps)


def cloud_of(request: ClipRequest, frames: Iterable[Frame]) -> CloudModel:
    """What answers the loop.

    Raises:
        ConfigurationError: Without a detector, a frame has no true masks; or the cloud extra is missing.
    """
    if request.detector is None:
        check_truth(frames, request.clip)
        return TruthCloud()
    try:
        return DetectorCloud(load_detector(request.detector, BackendOptions()))
    except ModuleNotFoundError as error:
        raise ConfigurationError("a detector needs the cloud extra: pip install 'cable-rpc[cloud]'") from error


def measure_point(clip: PreparedClip, setting: Setting) -> StudyPoint:
    """Code a clip and judge what comes out.

    Raises:
        ConfigurationError: Unknown treatment.
        CodecError: The codec can't be opened with this quality, or fails.
    """
    height, width = clip.frames[0].size_hw
    everywhere = np.ones((height, width), np.bool_)
    tally = Tally()
    with CodedLoop(setting, height, width, clip.fps) as loop:
        for frame, region in zip(clip.frames, clip.regions, strict=True):
            passed = loop.step(frame.image, None if region.whole else region.pixels)
            tally.passages.append(passed)
            tally.whole_frames += region.whole
            tally.coverages.append(float(np.count_nonzero(region.pixels) / region.pixels.size))
            tally.roi.add(frame.image, passed.shown, region.pixels)
            tally.frame.add(frame.image, passed.shown, everywhere, ssim=False)
            boxes = box_pixels(frame.truth, height, width)
            if boxes is not None:
                tally.boxes.add(frame.image, passed.shown, boxes)
    return tally.point(clip, setting)


class QualityTally:
    """Quality in one region, pooled over frames that all count alike."""

    def __init__(self) -> None:
        self.squared_errors: list[float] = []
        self.similarities: list[float] = []

    def add(self, reference: Image, test: Image, region: BoolMask, *, ssim: bool = True) -> None:
        """Judge one frame; an empty region has nothing to judge."""
        if not region.any():
            return
        self.squared_errors.append(PEAK**2 * 10 ** (-roi_psnr(reference, test, region) / 10))
        if ssim and without_rim(region).any():
            self.similarities.append(roi_ssim(reference, test, region))

    @property
    def psnr_db(self) -> float | None:
        """Of the mean squared error; infinite where it is 0, None of nothing."""
        if not self.squared_errors:
            return None
        error = float(np.mean(self.squared_errors))
        return math.inf if error == 0 else 10 * math.log10(PEAK**2 / error)

    @property
    def ssim(self) -> float | None:
        """Mean; None of nothing."""
        return float(np.mean(self.similarities)) if self.similarities else None


class Tally:
    """What the frames of a clip cost and gave so far."""

    def __init__(self) -> None:
        self.whole_frames = 0
        self.passages: list[Passage] = []
        self.coverages: list[float] = []
        self.roi, self.boxes, self.frame = QualityTally(), QualityTally(), QualityTally()

    def point(self, clip: PreparedClip, setting: Setting) -> StudyPoint:
        """The row of all frames.

        Raises:
            ConfigurationError: No frame had a region.
        """
        roi_psnr_db, frame_psnr_db, similarity = self.roi.psnr_db, self.frame.psnr_db, self.roi.ssim
        if roi_psnr_db is None or frame_psnr_db is None or similarity is None:
            raise ConfigurationError(f"'{clip.request.clip}' has no frame with a region to judge; give more frames")
        height, width = clip.frames[0].size_hw
        durations = [passed.durations_ns for passed in self.passages]
        treat_ms, encode_ms, decode_ms, restore_ms = (np.median(durations, axis=0) / 1e6).tolist()
        return StudyPoint(
            clip=clip.request.clip,
            mask=clip.request.mask_label,
            selection=clip.request.selection,
            treatment=setting.treatment,
            codec=setting.codec,
            quality=setting.quality,
            version=cable_rpc.__version__,
            width=width,
            height=height,
            fps=clip.fps,
            frames=len(clip.frames),
            whole_frames=self.whole_frames,
            coverage=float(np.mean(self.coverages)),
            coverage_sent=float(np.mean([passed.coverage for passed in self.passages])),
            bitstream_bytes=sum(passed.bitstream_bytes for passed in self.passages),
            mask_bytes=sum(passed.mask_bytes for passed in self.passages),
            roi_psnr_db=roi_psnr_db,
            roi_ssim=similarity,
            box_psnr_db=self.boxes.psnr_db,
            box_ssim=self.boxes.ssim,
            frame_psnr_db=frame_psnr_db,
            treat_ms=treat_ms,
            encode_ms=encode_ms,
            decode_ms=decode_ms,
            restore_ms=restore_ms,
        )


def box_pixels(truth: GroundTruth | None, height: int, width: int) -> npt.NDArray[np.bool_] | None:
    """Union of the boxes of visible objects, bool [height, width]; None where there are none."""
    if truth is None or not len(truth):
        return None
    boxes = truth.boxes_xyxy[visible_truth(truth)]
    pixels = np.zeros((height, width), np.bool_)
    for x_min, y_min, x_max, y_max in boxes:
        rows = slice(max(0, math.floor(y_min)), max(0, math.ceil(y_max)))
        pixels[rows, max(0, math.floor(x_min)) : max(0, math.ceil(x_max))] = True
    return pixels if pixels.any() else None
