"""Half precision and 8 bits for an exported detector."""

from __future__ import annotations

import contextlib
import logging
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process
from onnxruntime.transformers.float16 import convert_float_to_float16
from onnxruntime.transformers.onnx_model import OnnxModel

from cable_models.detection import Image
from cable_models.errors import ModelError
from cable_models.rtdetr.export import add_metadata
from cable_models.rtdetr.onnx_detector import OnnxDetector
from cable_models.rtdetr.preprocess import fill_input
from cable_models.rtdetr.providers import SessionSettings

FEWEST_CALIBRATION_IMAGES = 8
INT8_OPERATORS = ("Conv",)
"""The convolutions hold nearly all of the arithmetic. Quantising attention, the box arithmetic and the additions as
well took the embedded detector from 0.26 to 0.01 mAP50, attention's products alone to 0.257."""


def to_fp16(source: Path, target: Path) -> None:
    """Weights and arithmetic in half precision; inputs and outputs stay float32, so that callers see no difference.

    Boxes come out on a grid of up to 1/2048 of the image's side, about a pixel of 1920.

    Args:
        source: ONNX file in fp32.
        target: ONNX file to write.

    Raises:
        ModelError: the conversion failed.
    """
    try:
        converted = OnnxModel(convert_float_to_float16(onnx.load(str(source)), keep_io_types=True))
        # the converter appends its casts at the end
        converted.topological_sort()
        onnx.save(converted.model, str(target))
    except Exception as error:  # the converter raises whatever its passes do
        raise ModelError(f"{source} can't be converted to half precision: {error}") from error
    add_metadata(target, {"precision": "fp16"})


class FrameReader(CalibrationDataReader):  # type: ignore[misc]  # the base class carries no types
    """Prepared images, one at a time, as the calibrator asks for them."""

    def __init__(self, detector: OnnxDetector, images: Sequence[Image]) -> None:
        self.detector = detector
        self.images = iter(images)

    def get_next(self) -> dict[str, Any] | None:
        """The next input of the graph, None at the end."""
        image = next(self.images, None)
        if image is None:
            return None
        layout = self.detector.layout
        tensor = self.detector.input_tensor(layout.fixed_batch or 1)
        fill_input([image] * len(tensor), tensor, self.detector.recipe)
        feed: dict[str, Any] = {layout.image_input: tensor}
        if layout.name == "rtdetr":
            feed["orig_target_sizes"] = np.array([(image.shape[1], image.shape[0])] * len(tensor), np.int64)
        return feed


def to_int8(source: Path, target: Path, images: Sequence[Image]) -> None:
    """Static quantisation of the convolutions: ranges of the activations are those seen on ``images``.

    Args:
        source: ONNX file in fp32.
        target: ONNX file to write.
        images: uint8 [height, width, 3] BGR, of the camera and the roads that the detector will see.

    Raises:
        ModelError: too few images, or the quantiser failed.
    """
    if len(images) < FEWEST_CALIBRATION_IMAGES:
        raise ModelError(
            f"8 bits are calibrated on at least {FEWEST_CALIBRATION_IMAGES} frames, got {len(images)}; some hundred "
            "from different drives are better"
        )
    detector = OnnxDetector(source, SessionSettings(provider="cpu"))
    reader = FrameReader(detector, images)
    with tempfile.TemporaryDirectory() as folder, quiet():
        prepared = Path(folder) / "prepared.onnx"
        try:
            quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
            quantize_static(
                str(prepared),
                str(target),
                reader,
                quant_format=QuantFormat.QDQ,
                op_types_to_quantize=list(INT8_OPERATORS),
                per_channel=True,
                # 7 bits for weights: processors without VNNI add pairs of products in 16 bits, which overflow otherwise
                reduce_range=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                calibrate_method=CalibrationMethod.MinMax,
            )
        except Exception as error:  # the quantiser raises whatever its passes do
            raise ModelError(f"{source} can't be quantised: {error}") from error
    add_metadata(target, {**detector.metadata, "precision": "int8", "calibration_images": str(len(images))})


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silences the quantiser, which logs advice on the root logger."""
    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)
    try:
        yield
    finally:
        root.setLevel(level)
