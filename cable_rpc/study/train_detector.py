"""Makes the embedded detector: trains the compact RT-DETR on rendered frames, exports it and proves the export."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cable_models.embedded import EMBEDDED_DETECTOR
from cable_models.rtdetr.compact import CompactRtDetrConfig, for_inference
from cable_models.rtdetr.export import export_onnx, verify_export
from cable_models.rtdetr.labels import coco_index_table
from cable_models.rtdetr.onnx_detector import DetectorSettings, OnnxDetector
from cable_models.rtdetr.providers import SessionSettings
from cable_models.training.detector_evaluation import LOWEST_SCORE, Counted, Evaluation, judge_all
from cable_models.training.detector_state import Progress
from cable_models.training.samples import LabelledImage, read_entries
from cable_models.training.train_rtdetr import StepReport, TrainConfig, TrainingFiles, load_weights, train

from cable_rpc.study.region_fills import FILLS

VERIFIED_IMAGES = 24
NETWORK = CompactRtDetrConfig()


@dataclass(frozen=True, slots=True)
class DetectorFiles:
    """Where things lie in a work folder."""

    work: Path

    @property
    def train_frames(self) -> Path:
        """Rendered frames to learn from."""
        return self.work / "train"

    @property
    def held_out_frames(self) -> Path:
        """Rendered frames of other scenes, to judge by."""
        return self.work / "held_out"

    @property
    def training(self) -> TrainingFiles:
        """Best weights, and the state of an unfinished training."""
        return TrainingFiles(self.work / "rtdetr_compact.safetensors", self.work / "rtdetr_compact.state.safetensors")

    @property
    def onnx(self) -> Path:
        """The exported detector."""
        return self.work / EMBEDDED_DETECTOR

    def held_out(self) -> list[LabelledImage]:
        """The frames to judge by.

        Raises:
            cable_models.ModelError: they are missing or damaged.
        """
        return [entry.load() for entry in read_entries(self.held_out_frames)]


@dataclass(frozen=True, slots=True)
class ExportReport:
    """What came of an export."""

    path: Path
    bytes: int
    worst_box_px: float
    worst_score: float
    """Largest differences between ONNX Runtime and torch."""


def train_detector(
    files: DetectorFiles,
    config: TrainConfig,
    *,
    device: str,
    initial: Path | None,
    listener: Callable[[StepReport], None],
    should_stop: Callable[[], bool],
) -> Progress:
    """Trains on the rendered frames of a work folder, or goes on; arguments as for `train`.

    Raises:
        cable_models.ModelError: frames are missing, or a stored state doesn't fit.
    """
    return train(
        files.train_frames,
        files.held_out(),
        NETWORK,
        config,
        files.training,
        device=device,
        initial=initial,
        fills=FILLS,
        listener=listener,
        should_stop=should_stop,
    )


def export_detector(files: DetectorFiles, target: Path) -> ExportReport:
    """Exports the best weights, checks the file against torch.

    Raises:
        cable_models.ModelError: there are no weights, or the export differs from torch.
    """
    model = load_weights(NETWORK, files.training.weights)
    notes = {
        "source": "trained from scratch on rendered scenes by `cable-rpc train detector`",
        "licence": "Apache-2.0",
        "operating_score": "0.4",
    }
    export_onnx(for_inference(model, NETWORK.input_size_wh), NETWORK, target, notes)
    images = [sample.image for sample in files.held_out()[:VERIFIED_IMAGES]]
    box_px, score = verify_export(model, NETWORK, target, images)
    return ExportReport(target, target.stat().st_size, box_px, score)


def onnx_figures(path: Path, held_out: list[LabelledImage], rules: tuple[Counted, ...]) -> list[Evaluation]:
    """Figures of a detector file on labelled images, once for each rule of what counts.

    Raises:
        cable_models.ModelError: the file is no detector.
    """
    detector = OnnxDetector(path, SessionSettings(provider="cpu"), DetectorSettings(min_score=LOWEST_SCORE))
    found = [detector.detect([sample.image])[0] for sample in held_out]
    classes = [int(index) for index in coco_index_table(dict(enumerate(NETWORK.labels)))]
    return [judge_all(found, held_out, classes, rule) for rule in rules]
