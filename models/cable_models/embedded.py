"""The weights that ship with the package, so that a fresh install detects and segments without a download."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from cable_models.errors import ModelError

EMBEDDED_DETECTOR = "rtdetr_compact_rendered.onnx"
EMBEDDED_SEGMENTER = "lisa_compact"


def embedded_detector_path() -> Path:
    """Path of the compact RT-DETR trained on the rendered world.

    Raises:
        ModelError: the file is not part of this installation.
    """
    path = Path(str(files("cable_models").joinpath("weights", EMBEDDED_DETECTOR)))
    if not path.is_file():
        raise ModelError(
            f"the embedded detector {path} is missing from this installation; reinstall the package, "
            "train it with `cable-rpc train detector`, or name an ONNX file of your own"
        )
    return path


def embedded_segmenter_path() -> Path:
    """Folder of the compact LISA trained on the rendered world, in LISA++'s own layout.

    Raises:
        ModelError: the folder is not part of this installation.
    """
    path = Path(str(files("cable_models").joinpath("weights", EMBEDDED_SEGMENTER)))
    if not path.is_dir():
        raise ModelError(
            f"the embedded segmenter {path} is missing from this installation; reinstall the package, "
            "train it with `cable-rpc train segmenter`, or name a checkpoint of your own"
        )
    return path
