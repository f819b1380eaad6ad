"""Detector back ends: an ONNX file, an RT-DETR checkpoint, or the one that ships with the package.

Each takes options after a question mark, as in ``onnx:FILE?threads=2&provider=cpu&crop=roi``.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cable_models import ModelError as DetectorLoadError
from cable_models import embedded_detector_path
from cable_models.rtdetr import CropConfig, DetectorSettings, SessionSettings
from cable_models.rtdetr import OnnxDetector as OnnxSession
from cable_models.rtdetr.detector_cache import cached_file, default_cache
from cable_models.rtdetr.file_plan import OPSET, FilePlan, GraphOptions
from cable_models.rtdetr.onnx_detector import ROAD_USER_CLASSES

from cable_rpc.cloud.backends import BackendOptions
from cable_rpc.cloud.spec_options import meaning, options_text, read_options
from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.errors import ConfigurationError, ModelError
from cable_rpc.types import BoolMask, Detections, Image

log = logging.getLogger(__name__)

VERIFIED_SEED, VERIFIED_FRAMES = 7, 2


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of every detector."""

    provider: Literal["device", "auto", "cpu", "cuda", "tensorrt", "openvino"] = meaning("device: --device", "device")
    threads: int | None = meaning("CPU threads, in place of --threads")
    spin: bool = meaning("idle threads spin: faster alone, wasteful on a shared machine", True)
    io_binding: bool | None = meaning("bound inputs and outputs; where the provider isn't the CPU by default")
    gpu: int = meaning("number of the GPU", 0)
    min_score: float | None = meaning("in place of --min-score")
    classes: tuple[int, ...] = meaning("COCO-80 numbers to report", ROAD_USER_CLASSES)
    duplicates: Literal["drop", "keep"] = meaning("second labels of one object, such as car and truck", "drop")
    resize: Literal["file", "antialias", "linear"] = meaning("linear: faster, skips pixels; file: as it says", "file")
    crop: Literal["none", "roi"] = meaning("roi: show the network only a window around the region", "none")
    crop_margin: float = meaning("context around the region, share of the frame", CropConfig().margin)
    crop_min: float = meaning("smallest window, share of the frame's side", CropConfig().min_share)
    batch: int | None = meaning("most images in one run; no limit by default")

    def session(self, options: BackendOptions, *, fp16: bool = False) -> SessionSettings:
        """How the graph is run."""
        return SessionSettings(
            provider=options.device if self.provider == "device" else self.provider,
            threads=options.threads if self.threads is None else self.threads,
            spin=self.spin,
            io_binding=self.io_binding,
            device_id=self.gpu,
            engine_cache=default_cache() / "engines",
            fp16=fp16,
        )

    def reported(self, options: BackendOptions) -> DetectorSettings:
        """What is reported, and from which pixels."""
        return DetectorSettings(
            min_score=options.min_score if self.min_score is None else self.min_score,
            class_ids=self.classes,
            deduplicate=self.duplicates == "drop",
            resample=None if self.resize == "file" else self.resize,
            crop=CropConfig(self.crop_margin, self.crop_min) if self.crop == "roi" else None,
            max_batch=self.batch,
        )


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """Further options of ``rtdetr:``."""

    revision: str | None = meaning("commit, tag or branch on the hub")
    precision: Literal["fp32", "fp16"] = meaning("fp16 for GPUs; int8 is made by `export rtdetr --int8`", "fp32")
    size: str | None = meaning("input as WIDTHxHEIGHT, multiples of 32; the checkpoint's own by default")
    postprocess: bool = meaning("post-processing inside the graph", False)
    opset: int = meaning("ONNX operator set, 16 to 20", OPSET)

    def plan(self) -> FilePlan:
        """Which file to make.

        Raises:
            ConfigurationError: the size is no WIDTHxHEIGHT.
        """
        size_wh = None
        if self.size is not None:
            width, _, height = self.size.lower().partition("x")
            if not (width.isdigit() and height.isdigit()):
                raise ConfigurationError(f"detector option size={self.size}: write WIDTHxHEIGHT, e.g. 640x384")
            size_wh = int(width), int(height)
        return FilePlan(GraphOptions(self.postprocess, opset=self.opset), self.precision, size_wh)


class OnnxDetector:
    """An RT-DETR style detector in ONNX Runtime; both export signatures (see `cable_models.rtdetr`)."""

    def __init__(self, path: Path, session: SessionSettings, settings: DetectorSettings) -> None:
        """Loads the file.

        Raises:
            cable_models.ModelError: the file can't be used, or the provider does not start.
        """
        self._model = OnnxSession(path, session, settings)
        self.name = f"onnx:{path.stem}"
        self.revision = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
        self.device = self._model.provider

    def detect(self, images: Sequence[Image]) -> list[Detections]:
        """Boxes for each BGR image, best score first."""
        return self.detect_regions(images, [None] * len(images))

    def detect_regions(self, images: Sequence[Image], regions: Sequence[BoolMask | None]) -> list[Detections]:
        """The same, cut to a window around each region first where the detector was opened with ``crop=roi``.

        Args:
            images: uint8 [H, W, 3] BGR each, sizes may differ.
            regions: bool [H, W] each; None = the whole image.

        Raises:
            ModelError: an image or region can't be used, or the graph failed.
        """
        with as_cable_errors():
            found = self._model.detect(images, regions)
        return [Detections(boxes.boxes_xyxy, boxes.class_ids, boxes.scores) for boxes in found]


def load_onnx(argument: str, options: BackendOptions) -> OnnxDetector:
    """Entry point ``onnx:FILE[?key=value&...]``.

    Raises:
        ConfigurationError: no file named, or an unusable option.
        ModelError: the file can't be used.
    """
    path, _, query = argument.partition("?")
    (given,) = read_options(f"onnx:{argument}", query, RunOptions)
    if not path:
        raise ConfigurationError(
            f"the onnx detector needs a file: --detector onnx:FILE.onnx?key=value&...\n{options_text(RunOptions)}"
        )
    run = RunOptions(**given)
    with as_cable_errors():
        return OnnxDetector(Path(path).expanduser(), run.session(options), run.reported(options))


def load_embedded(argument: str, options: BackendOptions) -> OnnxDetector:
    """Entry point ``embedded[?key=value&...]``: the compact RT-DETR trained on the rendered world.

    Raises:
        ConfigurationError: an unusable option.
        ModelError: the weights are missing from this installation.
    """
    rest, _, query = argument.partition("?")
    if rest:
        raise ConfigurationError(f"the embedded detector takes options but no argument, got '{rest}'")
    (given,) = read_options(f"embedded{argument}", query, RunOptions)
    run = RunOptions(**given)
    with as_cable_errors():
        return OnnxDetector(embedded_detector_path(), run.session(options), run.reported(options))


def load_rtdetr(argument: str, options: BackendOptions) -> OnnxDetector:
    """Entry point ``rtdetr:CHECKPOINT[?key=value&...]``: exports once into the cache, then serves the export.

    The checkpoint is a hub id (``PekingU/rtdetr_r50vd``), a folder of ``save_pretrained``, or a compact one.

    Raises:
        ConfigurationError: no checkpoint named, or an unusable option.
        ModelError: the checkpoint can't be had, or its export can't be used.
    """
    checkpoint, _, query = argument.partition("?")
    given, exported = read_options(f"rtdetr:{argument}", query, RunOptions, ExportOptions)
    if not checkpoint:
        raise ConfigurationError(
            "the rtdetr detector needs a checkpoint: --detector rtdetr:PekingU/rtdetr_r50vd?key=value&...\n"
            f"{options_text(RunOptions, ExportOptions)}"
        )
    run, export = RunOptions(**given), ExportOptions(**exported)
    with as_cable_errors():
        path = cached_file(checkpoint, export.revision, export.plan(), rendered_frames, say=announce)
        fp16 = export.precision == "fp16"
        detector = OnnxDetector(path, run.session(options, fp16=fp16), run.reported(options))
    detector.name = f"rtdetr:{checkpoint}"
    return detector


def rendered_frames() -> list[Image]:
    """Street scenes on which a new export is compared with torch."""
    source = SyntheticSource(SyntheticConfig(seed=VERIFIED_SEED, width=960, height=540, frame_count=VERIFIED_FRAMES))
    return [frame.image for frame in source]


def announce(step: str) -> None:
    """Tells of a first start's steps, which take up to a minute, where a user sees them."""
    log.warning("%s", step)


@contextmanager
def as_cable_errors() -> Iterator[None]:
    """Errors of the models' package as errors of this one."""
    try:
        yield
    except DetectorLoadError as error:
        raise ModelError(str(error)) from error
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            f"{error.name} is not installed; this detector needs the cloud extra: pip install 'cable-rpc[cloud]'"
        ) from error
