"""RT-DETR and its descendants through ONNX Runtime."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cable_models.detection import DetectedBoxes, Image
from cable_models.errors import ModelError
from cable_models.rtdetr.crop import BoolMask, CropConfig, Window, crop_window
from cable_models.rtdetr.file_facts import labels_of, recipe_of
from cable_models.rtdetr.graph_runner import GraphRunner
from cable_models.rtdetr.labels import COCO80_NAMES, coco_index_table
from cable_models.rtdetr.postprocess import decode_logits, select_detections
from cable_models.rtdetr.preprocess import Resample, check_image, fill_input
from cable_models.rtdetr.providers import ProviderChoice, SessionSettings
from cable_models.rtdetr.signature import SignatureName, read_signature

ROAD_USER_CLASSES = (0, 1, 2, 3, 5, 7)
"""person, bicycle, car, motorcycle, bus and truck by contiguous COCO-80 index."""

RawDetections = tuple[npt.NDArray[np.int64], npt.NDArray[np.float32], npt.NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """What is reported, and from which pixels."""

    min_score: float = 0.4
    """Lowest score reported, 0..1."""
    class_ids: tuple[int, ...] = ROAD_USER_CLASSES
    """COCO-80 classes to report."""
    deduplicate: bool = True
    """Report an object once where the network gives it two labels of one group, such as car and truck."""
    resample: Resample | None = None
    """Resize filter instead of the file's own."""
    crop: CropConfig | None = None
    """Cut images to a window around their region of interest first, where `OnnxDetector.detect` is given one."""
    max_batch: int | None = None
    """Most images in one run of a graph whose batch is free; None = all that a call brings."""

    def __post_init__(self) -> None:
        """Refuses settings that can't work.

        Raises:
            ModelError: which one, and its range.
        """
        if not 0 <= self.min_score <= 1:
            raise ModelError(f"min_score must lie in 0..1, got {self.min_score}")
        unknown = [index for index in self.class_ids if not 0 <= index < len(COCO80_NAMES)]
        if unknown:
            raise ModelError(f"class_ids must be COCO-80 indices 0..79, got {unknown}")
        if self.max_batch is not None and self.max_batch < 1:
            raise ModelError(f"max_batch must be at least 1, got {self.max_batch}")


class OnnxDetector:
    """A detector graph in one of the two published RT-DETR layouts (see ``cable_models.rtdetr.signature``).

    Takes images of any size, each resized straight to the network's input. One instance serves one thread
    at a time: the input tensor is kept between calls.

    Example:
        >>> detector = OnnxDetector("rtdetr_r50vd.onnx", SessionSettings(threads=4))  # doctest: +SKIP
        >>> detector.detect([image])[0].class_ids  # doctest: +SKIP
        array([2, 2, 0], dtype=int32)
    """

    def __init__(
        self,
        path: str | Path,
        session: SessionSettings | None = None,
        settings: DetectorSettings | None = None,
    ) -> None:
        """Loads the graph and checks that it can be used.

        Args:
            path: ONNX file.
            session: How it is run.
            settings: What it reports.

        Raises:
            ModelError: no such file, not an ONNX model, an unknown layout, labels that don't fit, a provider
                that is unknown or does not start.
        """
        self.path = Path(path)
        self.settings = settings or DetectorSettings()
        session = session or SessionSettings()
        self.runner = GraphRunner(self.path, session)
        self.workers = ThreadPoolExecutor(session.threads, "prepare") if session.threads > 1 else None
        self.metadata = self.runner.metadata
        graph = self.runner.session
        self.layout = read_signature(graph.get_inputs(), graph.get_outputs(), self.metadata)
        self.labels = labels_of(self.metadata, self.layout.class_count, self.path)
        self.recipe = recipe_of(self.metadata, self.layout.size_wh, self.settings.resample)
        self.coco_index = coco_index_table(self.labels)
        self.wanted = np.zeros(len(COCO80_NAMES), np.bool_)
        self.wanted[list(self.settings.class_ids)] = True
        self.tensor = self.input_tensor(self.layout.fixed_batch or 1)

    @property
    def name(self) -> str:
        """File name without its ending."""
        return self.path.stem

    @property
    def provider(self) -> str:
        """The execution provider that runs the graph, by ONNX Runtime's name."""
        return self.provider_choice.serving

    @property
    def provider_choice(self) -> ProviderChoice:
        """What was asked for, what runs, and why they differ if they do."""
        return self.runner.choice

    @property
    def input_size_wh(self) -> tuple[int, int]:
        """Width and height that images are resized to."""
        return self.layout.size_wh

    @property
    def signature(self) -> SignatureName:
        """``rtdetr`` or ``transformers``: the graph's layout."""
        return self.layout.name

    def detect(self, images: Sequence[Image], regions: Sequence[BoolMask | None] | None = None) -> list[DetectedBoxes]:
        """Finds the wanted objects in each image.

        Args:
            images: uint8 [height, width, 3] in BGR order; sizes may differ.
            regions: bool [height, width] or None for each image: where objects can be. Used where the settings
                ask for a crop, ignored otherwise.

        Returns:
            One ``DetectedBoxes`` per image, in the same order, in pixels of the whole image.

        Raises:
            ModelError: an image or region has another dtype or shape, or the graph failed.
        """
        for position, image in enumerate(images):
            check_image(image, position)
        windows = self.windows(images, regions)
        views = [
            image if window is None else image[window.slices] for image, window in zip(images, windows, strict=True)
        ]
        step = self.layout.fixed_batch or self.settings.max_batch or max(len(images), 1)
        found: list[DetectedBoxes] = []
        for start in range(0, len(views), step):
            found += self.detect_batch(views[start : start + step])
        return [
            boxes
            if window is None
            else DetectedBoxes(boxes.boxes_xyxy + window.offset_xyxy, boxes.class_ids, boxes.scores)
            for boxes, window in zip(found, windows, strict=True)
        ]

    def windows(self, images: Sequence[Image], regions: Sequence[BoolMask | None] | None) -> Sequence[Window | None]:
        """The window of each image that the network is shown; None = all of it."""
        if self.settings.crop is None or regions is None:
            return [None] * len(images)
        if len(regions) != len(images):
            raise ModelError(f"{len(images)} images came with {len(regions)} regions; give one for each, or None")
        windows: list[Window | None] = []
        for position, (image, region) in enumerate(zip(images, regions, strict=True)):
            if region is not None and (region.shape != image.shape[:2] or region.dtype != np.bool_):
                raise ModelError(
                    f"region {position} must be bool {list(image.shape[:2])}, got {region.dtype} {list(region.shape)}"
                )
            windows.append(None if region is None else crop_window(region, self.settings.crop))
        return windows

    def detect_batch(self, images: Sequence[Image]) -> list[DetectedBoxes]:
        """One run of the graph over images that fit its batch."""
        batch = self.layout.fixed_batch or len(images)
        if len(self.tensor) < batch:
            self.tensor = self.input_tensor(batch)
        fill_input(images, self.tensor, self.recipe, self.workers)
        sizes_wh = [(image.shape[1], image.shape[0]) for image in images]
        raw = self.infer(self.tensor[:batch], sizes_wh)
        return [
            select_detections(
                *detections,
                coco_index=self.coco_index,
                wanted=self.wanted,
                min_score=self.settings.min_score,
                size_wh=size_wh,
                deduplicate=self.settings.deduplicate,
            )
            for detections, size_wh in zip(raw, sizes_wh, strict=True)
        ]

    def infer(self, tensor: npt.NDArray[np.floating[Any]], sizes_wh: list[tuple[int, int]]) -> list[RawDetections]:
        """Runs the graph; labels, boxes in pixels and scores of each image, unfiltered.

        Args:
            tensor: [N, 3, H, W], N at least the number of sizes: rows beyond only pad a fixed batch.
            sizes_wh: Width and height of each image before resizing.
        """
        feed: dict[str, npt.NDArray[Any]] = {self.layout.image_input: tensor}
        count = len(sizes_wh)
        if self.layout.name == "rtdetr":
            feed["orig_target_sizes"] = np.array(sizes_wh + [(1, 1)] * (len(tensor) - count), np.int64)
            labels, boxes, scores = self.runner.run(("labels", "boxes", "scores"), feed)
            self.check_class_range(int(labels.max(initial=0)) + 1)
            return [(labels[i], boxes[i].astype(np.float32), scores[i].astype(np.float32)) for i in range(count)]
        logits, boxes = self.runner.run(("logits", "pred_boxes"), feed)
        self.check_class_range(logits.shape[-1])
        return [decode_logits(logits[i], boxes[i], sizes_wh[i]) for i in range(count)]

    def check_class_range(self, classes: int) -> None:
        """Refuses an answer with more classes than there are labels."""
        if classes > len(self.labels):
            raise ModelError(f"{self.path} answers {classes} classes but only {len(self.labels)} have a label")

    def input_tensor(self, batch: int) -> npt.NDArray[np.floating[Any]]:
        """A zeroed input of the network's size."""
        width, height = self.layout.size_wh
        return np.zeros((batch, 3, height, width), self.layout.image_dtype)
