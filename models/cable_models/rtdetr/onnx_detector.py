"""RT-DETR and its descendants through ONNX Runtime."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnxruntime as ort

from cable_models.detection import DetectedBoxes, Image
from cable_models.errors import ModelError
from cable_models.rtdetr.labels import COCO80_NAMES, coco_index_table, parse_labels
from cable_models.rtdetr.postprocess import decode_logits, select_detections
from cable_models.rtdetr.preprocess import check_image, fill_input
from cable_models.rtdetr.signature import SignatureName, read_signature

ROAD_USER_CLASSES = (0, 1, 2, 3, 5, 7)
"""person, bicycle, car, motorcycle, bus and truck by contiguous COCO-80 index."""

RawDetections = tuple[npt.NDArray[np.int64], npt.NDArray[np.float32], npt.NDArray[np.float32]]


class OnnxDetector:
    """A detector graph in one of the two published RT-DETR layouts (see ``cable_models.rtdetr.signature``).

    Takes images of any size, each resized straight to the network's input. One instance serves one thread
    at a time: the input tensor is kept between calls.

    Example:
        >>> detector = OnnxDetector("rtdetr_r50vd.onnx", threads=4)  # doctest: +SKIP
        >>> detector.detect([image])[0].class_ids  # doctest: +SKIP
        array([2, 2, 0], dtype=int32)
    """

    def __init__(
        self,
        path: str | Path,
        *,
        providers: Sequence[str] | None = None,
        threads: int = 1,
        min_score: float = 0.4,
        class_ids: Sequence[int] = ROAD_USER_CLASSES,
    ) -> None:
        """Loads the graph and checks that it can be used.

        Args:
            path: ONNX file.
            providers: ONNX Runtime execution providers in order of preference; None takes CUDA where this
                build of ONNX Runtime offers it, else the CPU. ``provider`` says which one serves.
            threads: CPU threads inside one inference.
            min_score: Lowest score reported, 0..1.
            class_ids: COCO-80 classes to report.

        Raises:
            ModelError: no such file, not an ONNX model, an unknown layout, unknown classes or provider.
        """
        check_settings(threads, min_score, class_ids)
        self.path = Path(path)
        self.min_score = min_score
        self.session = open_session(self.path, choose_providers(providers), threads)
        self.provider: str = self.session.get_providers()[0]
        if providers is not None and self.provider != providers[0]:
            raise ModelError(f"provider {providers[0]} could not start for {self.path}; {self.provider} did instead")
        metadata: dict[str, str] = dict(self.session.get_modelmeta().custom_metadata_map)
        self.layout = read_signature(self.session.get_inputs(), self.session.get_outputs(), metadata)
        self.labels = labels_of(metadata, self.layout.class_count, self.path)
        self.coco_index = coco_index_table(self.labels)
        self.wanted = np.zeros(len(COCO80_NAMES), np.bool_)
        self.wanted[list(class_ids)] = True
        self.tensor = self.input_tensor(self.layout.fixed_batch or 1)

    @property
    def name(self) -> str:
        """File name without its ending."""
        return self.path.stem

    @property
    def input_size_wh(self) -> tuple[int, int]:
        """Width and height that images are resized to."""
        return self.layout.size_wh

    @property
    def signature(self) -> SignatureName:
        """``rtdetr`` or ``transformers``: the graph's layout."""
        return self.layout.name

    def detect(self, images: Sequence[Image]) -> list[DetectedBoxes]:
        """Finds the wanted objects in each image.

        Args:
            images: uint8 [height, width, 3] in BGR order; sizes may differ.

        Returns:
            One ``DetectedBoxes`` per image, in the same order.

        Raises:
            ModelError: an image has another dtype or shape, or the graph failed.
        """
        for position, image in enumerate(images):
            check_image(image, position)
        step = self.layout.fixed_batch or max(len(images), 1)
        found: list[DetectedBoxes] = []
        for start in range(0, len(images), step):
            found += self.detect_batch(images[start : start + step])
        return found

    def detect_batch(self, images: Sequence[Image]) -> list[DetectedBoxes]:
        """One run of the graph over images that fit its batch."""
        batch = self.layout.fixed_batch or len(images)
        if len(self.tensor) < batch:
            self.tensor = self.input_tensor(batch)
        fill_input(images, self.tensor)
        sizes_wh = [(image.shape[1], image.shape[0]) for image in images]
        raw = self.infer(self.tensor[:batch], sizes_wh)
        return [
            select_detections(
                *detections,
                coco_index=self.coco_index,
                wanted=self.wanted,
                min_score=self.min_score,
                size_wh=size_wh,
            )
            for detections, size_wh in zip(raw, sizes_wh, strict=True)
        ]

    def infer(self, tensor: npt.NDArray[np.floating[Any]], sizes_wh: list[tuple[int, int]]) -> list[RawDetections]:
        """Runs the graph; labels, boxes in pixels and scores of each image, unfiltered."""
        feed: dict[str, npt.NDArray[Any]] = {self.layout.image_input: tensor}
        count = len(sizes_wh)
        if self.layout.name == "rtdetr":
            # rows beyond the images only pad a fixed batch
            feed["orig_target_sizes"] = np.array(sizes_wh + [(1, 1)] * (len(tensor) - count), np.int64)
            labels, boxes, scores = self.run_graph(["labels", "boxes", "scores"], feed)
            self.check_class_range(int(labels.max(initial=0)) + 1)
            return [(labels[i], boxes[i].astype(np.float32), scores[i].astype(np.float32)) for i in range(count)]
        logits, boxes = self.run_graph(["logits", "pred_boxes"], feed)
        self.check_class_range(logits.shape[-1])
        return [decode_logits(logits[i], boxes[i], sizes_wh[i]) for i in range(count)]

    def run_graph(self, outputs: list[str], feed: dict[str, npt.NDArray[Any]]) -> list[npt.NDArray[Any]]:
        """The named outputs of one inference."""
        try:
            return list(self.session.run(outputs, feed))
        except Exception as error:  # ONNX Runtime's exceptions share no narrower base
            raise ModelError(f"{self.path} failed on input {self.tensor.shape}: {error}") from error

    def check_class_range(self, classes: int) -> None:
        """Refuses an answer with more classes than there are labels."""
        if classes > len(self.labels):
            raise ModelError(f"{self.path} answers {classes} classes but only {len(self.labels)} have a label")

    def input_tensor(self, batch: int) -> npt.NDArray[np.floating[Any]]:
        """A zeroed input of the network's size."""
        width, height = self.layout.size_wh
        return np.zeros((batch, 3, height, width), self.layout.image_dtype)


def check_settings(threads: int, min_score: float, class_ids: Sequence[int]) -> None:
    """Refuses settings that can't work.

    Raises:
        ModelError: which setting, and its range.
    """
    if threads < 1:
        raise ModelError(f"threads must be at least 1, got {threads}")
    if not 0 <= min_score <= 1:
        raise ModelError(f"min_score must lie in 0..1, got {min_score}")
    unknown = [index for index in class_ids if not 0 <= index < len(COCO80_NAMES)]
    if unknown:
        raise ModelError(f"class_ids must be COCO-80 indices 0..79, got {unknown}")


def choose_providers(providers: Sequence[str] | None) -> list[str]:
    """The execution providers to ask for.

    Raises:
        ModelError: a named provider is not part of this build of ONNX Runtime.
    """
    available = ort.get_available_providers()
    if providers is None:
        return [name for name in ("CUDAExecutionProvider", "CPUExecutionProvider") if name in available]
    missing = [name for name in providers if name not in available]
    if missing or not providers:
        raise ModelError(f"ONNX Runtime has no provider {missing or '(empty list)'}; available are {available}")
    return list(providers)


def open_session(path: Path, providers: list[str], threads: int) -> ort.InferenceSession:
    """Loads the graph.

    Raises:
        ModelError: no such file, or ONNX Runtime can't read it.
    """
    if not path.is_file():
        raise ModelError(f"no detector file {path}; give the path of an ONNX export of RT-DETR")
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return ort.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # ONNX Runtime's exceptions share no narrower base
        raise ModelError(f"{path} is not a usable ONNX model: {error}") from error


def labels_of(metadata: Mapping[str, str], class_count: int | None, path: Path) -> dict[int, str]:
    """Class names by model index: from metadata, else the COCO-80 list for an 80-class model.

    Raises:
        ModelError: the number of classes and of names differ.
    """
    labels = parse_labels(metadata["labels"]) if "labels" in metadata else dict(enumerate(COCO80_NAMES))
    if class_count is not None and class_count != len(labels):
        source = "its 'labels' metadata names" if "labels" in metadata else "COCO, assumed without metadata, has"
        raise ModelError(
            f"{path} has {class_count} classes but {source} {len(labels)}; add a metadata entry 'labels' "
            'with JSON {"0": "name", ...} for every class'
        )
    return labels
