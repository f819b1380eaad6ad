"""The weights that ship with the package, so that a fresh install detects without a download."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from cable_models.errors import ModelError

EMBEDDED_DETECTOR = "rtdetr_compact_rendered.onnx"


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
