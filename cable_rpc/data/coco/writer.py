"""Writing small data sets in COCO's format from the rendered world."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2

from cable_rpc.errors import SourceError
from cable_rpc.types import COCO_ROAD_USERS, Frame

if TYPE_CHECKING:
    from cable_rpc.data.rendered_drive import DriveFrame

ANNOTATION_FILE = "annotations/instances.json"
PAPER_CATEGORY_IDS = {0: 1, 1: 2, 2: 3, 3: 4, 5: 6, 7: 8}
"""COCO-80 index to the id that the original annotation files use."""


def write_coco(
    root: Path, drives: Mapping[str, Iterable[DriveFrame]], *, fps: float = 10.0, suffix: str = ".jpg"
) -> None:
    """Write sequences as ``annotations/instances.json`` and ``images/SEQUENCE/000000.jpg``.

    Rows hold what COCO-VID's do (``video_id``, ``frame_id``, ``instance_id``) and our extensions: capture time,
    ego-motion, camera and mount of an image, visible share of an object.

    Args:
        root: the folder, made where it isn't there.
        drives: sequence name to its frames, which need a truth; names are also folders.
        fps: the rate of the frames.
        suffix: ``.jpg`` or ``.png``.

    Raises:
        SourceError: a frame has no truth, or an image can't be written.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    videos: list[dict[str, Any]] = []
    for video_id, (name, drive) in enumerate(drives.items(), 1):
        videos.append({"id": video_id, "name": name, "fps": fps})
        (root / "images" / name).mkdir(parents=True, exist_ok=True)
        for driven in drive:
            image_id = len(images) + 1
            file_name = f"{name}/{driven.frame.index:06d}{suffix}"
            if not cv2.imwrite(str(root / "images" / file_name), driven.frame.image):
                raise SourceError(f"can't write {root / 'images' / file_name}")
            images.append({"id": image_id, "video_id": video_id, "file_name": file_name, **image_fields(driven.frame)})
            for fields in annotation_fields(driven.frame):
                annotations.append({"id": len(annotations) + 1, "image_id": image_id, "video_id": video_id, **fields})
    categories = [{"id": number, "name": COCO_ROAD_USERS[index]} for index, number in PAPER_CATEGORY_IDS.items()]
    document = {"videos": videos, "images": images, "annotations": annotations, "categories": categories}
    path = root / ANNOTATION_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document), encoding="utf-8")


def image_fields(frame: Frame) -> dict[str, Any]:
    """What an image's row tells of its frame."""
    height, width = frame.size_hw
    fields: dict[str, Any] = {
        "width": width,
        "height": height,
        "frame_id": frame.index,
        "timestamp_ns": frame.capture_time_ns,
    }
    if frame.ego is not None:
        fields["speed_mps"] = frame.ego.speed_mps
        fields["lateral_mps"] = frame.ego.lateral_mps
        fields["yaw_rate_radps"] = frame.ego.yaw_rate_radps
    if frame.intrinsics is not None:
        camera = frame.intrinsics
        fields |= {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    if frame.mount is not None:
        fields["mount"] = [frame.mount.height_m, frame.mount.pitch_down_rad, frame.mount.forward_m]
    return fields


def annotation_fields(frame: Frame) -> list[dict[str, Any]]:
    """The annotations of a frame, without their ids.

    Raises:
        SourceError: the frame has no truth.
    """
    truth = frame.truth
    if truth is None:
        raise SourceError(f"frame {frame.index} has no truth to write as annotations")
    rows = zip(
        truth.boxes_xyxy.tolist(),
        truth.class_ids.tolist(),
        truth.track_ids.tolist(),
        truth.visibility.tolist(),
        strict=True,
    )
    return [
        {
            "category_id": PAPER_CATEGORY_IDS[class_id],
            "instance_id": track_id,
            "bbox": [left, top, right - left, bottom - top],
            "area": (right - left) * (bottom - top),
            "iscrowd": 0,
            "segmentation": [],
            "visibility": share,
        }
        for (left, top, right, bottom), class_id, track_id, share in rows
    ]
