"""Writing small data sets in CADC's layout from the rendered world."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.cadc.calibration import yaml_module
from cable_rpc.data.cadc.layout import CAMERA, RAW_TREE
from cable_rpc.data.cadc.written_rows import (
    SensorPoses,
    camera_fields,
    cuboid_rows,
    extrinsics_fields,
    novatel_line,
    sensor_poses,
)
from cable_rpc.data.time_stamps import stamp_ns, stamp_text
from cable_rpc.errors import SourceError
from cable_rpc.types import CameraIntrinsics, Image

if TYPE_CHECKING:
    from cable_rpc.data.rendered_drive import DriveFrame

CAMERAS = 8
START_NS = stamp_ns("2018-03-06 15:00:00") or 0
"""When the first frame of every drive is said to have been taken."""
LENS = (-0.2, 0.06, 0.0008, -0.0006, -0.008)
"""k1, k2, p1, p2, k3 of a lens with a slight barrel distortion."""


def write_cadc(
    root: Path,
    drives: Mapping[str, Iterable[DriveFrame]],
    *,
    tree: str = "labeled",
    lens: Sequence[float] = LENS,
    annotations: bool = True,
) -> None:
    """Write drives as ``root/DATE/NNNN/TREE/...`` with the calibration of their dates.

    Images of the raw tree are distorted as the lens would; the others come as rendered.

    Args:
        root: the folder, made where it isn't there.
        drives: ``DATE/NNNN`` to its frames, which need a truth, intrinsics and ego-motion.
        tree: ``labeled``, ``processed`` or ``raw``.
        lens: OpenCV's distortion coefficients, four or five.
        annotations: whether to write ``3d_ann.json``.

    Raises:
        ConfigurationError: PyYAML isn't installed.
        SourceError: a frame lacks what is written, or an image can't be written.
    """
    for name, drive in drives.items():
        folder = root / name / tree
        images, messages = folder / CAMERA / "data", folder / "novatel" / "data"
        images.mkdir(parents=True, exist_ok=True)
        messages.mkdir(parents=True, exist_ok=True)
        stamps: list[str] = []
        annotated: list[dict[str, Any]] = []
        for number, driven in enumerate(drive):
            frame = driven.frame
            if frame.intrinsics is None or frame.ego is None or frame.truth is None:
                raise SourceError(f"drive {name}, frame {frame.index} lacks camera, ego-motion or truth")
            poses = sensor_poses(driven.vehicle_from_camera)
            if number == 0:
                write_calibration((root / name).parent / "calib", frame.intrinsics, frame.size_hw, lens, poses)
            image = distorted(frame.image, frame.intrinsics, lens) if tree == RAW_TREE else frame.image
            if not cv2.imwrite(str(images / f"{number:010d}.png"), image):
                raise SourceError(f"can't write {images / f'{number:010d}.png'}")
            line = novatel_line(driven.world_from_vehicle, frame.ego, velocities=tree == RAW_TREE)
            (messages / f"{number:010d}.txt").write_text(line, encoding="utf-8")
            stamps.append(stamp_text(START_NS + frame.capture_time_ns) + "\n")
            annotated.append({"cuboids": cuboid_rows(driven.cuboids, poses)})
        for sensor in (CAMERA, "novatel"):
            (folder / sensor / "timestamps.txt").write_text("".join(stamps), encoding="utf-8")
        if annotations:
            (root / name / "3d_ann.json").write_text(json.dumps(annotated), encoding="utf-8")


def write_calibration(
    folder: Path, intrinsics: CameraIntrinsics, size_hw: tuple[int, int], lens: Sequence[float], poses: SensorPoses
) -> None:
    """Write ``00.yaml`` to ``07.yaml``, all the same camera, and ``extrinsics.yaml``."""
    folder.mkdir(parents=True, exist_ok=True)
    yaml = yaml_module()
    for camera in range(CAMERAS):
        fields = camera_fields(f"camera_{camera:02d}", intrinsics, size_hw, lens)
        (folder / f"{camera:02d}.yaml").write_text(yaml.safe_dump(fields), encoding="utf-8")
    extrinsics = extrinsics_fields(poses, CAMERAS)
    (folder / "extrinsics.yaml").write_text(yaml.safe_dump(extrinsics), encoding="utf-8")


def distorted(image: Image, intrinsics: CameraIntrinsics, lens: Sequence[float]) -> Image:
    """The image as a distorting lens would show it, uint8 [height, width, 3]; black where it sees farther."""
    height, width = image.shape[:2]
    matrix = np.array([[intrinsics.fx, 0.0, intrinsics.cx], [0.0, intrinsics.fy, intrinsics.cy], [0.0, 0.0, 1.0]])
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)[:, None]
    straight: npt.NDArray[np.float32] = cv2.undistortPoints(pixels, matrix, np.array(lens), P=matrix).astype(np.float32)
    seen = cv2.remap(image, straight.reshape(height, width, 2), None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
    return np.asarray(seen, np.uint8)
