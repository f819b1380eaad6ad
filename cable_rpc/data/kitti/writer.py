"""Writing small data sets in the layout of KITTI tracking from the rendered world."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.kitti.written_rows import (
    calibration_lines,
    drive_calibration,
    label_lines,
    oxts_line,
)
from cable_rpc.errors import SourceError

if TYPE_CHECKING:
    from cable_rpc.data.rendered_drive import DriveFrame

FloatArray = npt.NDArray[np.float64]
Spelling = Literal["object", "tracking"]


def write_kitti(
    root: Path,
    drives: Mapping[str, Iterable[DriveFrame]],
    *,
    spelling: Spelling = "tracking",
    split: str = "training",
    oxts: bool = True,
    least_height_px: float = 12.0,
    suffix: str = ".png",
) -> None:
    """Write sequences under ``root/SPLIT``: images, labels (not of ``testing``), calibration, GPS/IMU record.

    Args:
        root: the folder, made where it isn't there.
        drives: sequence name (``0000``) to its frames, which need a truth, intrinsics and ego-motion.
        spelling: of the calibration's names: that of the object benchmark (``R0_rect``, ``Tr_velo_to_cam``) or of the
            tracking benchmark (``R_rect``, ``Tr_velo_cam`` without colon).
        split: ``training`` or ``testing``.
        oxts: whether to write the GPS/IMU record.
        least_height_px: objects of less become DontCare regions, as KITTI's annotators left out what is far.
        suffix: ``.png`` or ``.jpg``.

    Raises:
        SourceError: a frame lacks what is written, or an image can't be written.
    """
    folder = root / split
    for name, drive in drives.items():
        images = folder / "image_02" / name
        images.mkdir(parents=True, exist_ok=True)
        labels: list[str] = []
        motions: list[str] = []
        for driven in drive:
            frame = driven.frame
            if frame.intrinsics is None or frame.ego is None or frame.truth is None:
                raise SourceError(f"sequence {name}, frame {frame.index} lacks camera, ego-motion or truth")
            if not cv2.imwrite(str(images / f"{frame.index:06d}{suffix}"), frame.image):
                raise SourceError(f"can't write {images / f'{frame.index:06d}{suffix}'}")
            calibration = drive_calibration(frame.intrinsics, driven.vehicle_from_camera)
            if frame.index == 0:
                write_lines(folder / "calib" / f"{name}.txt", calibration_lines(calibration, spelling))
            labels += label_lines(driven, calibration, least_height_px)
            motions.append(oxts_line(driven.world_from_vehicle, frame.ego))
        if split != "testing":
            write_lines(folder / "label_02" / f"{name}.txt", labels)
        if oxts:
            write_lines(folder / "oxts" / f"{name}.txt", motions)


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write a text file and the folder it is in."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
