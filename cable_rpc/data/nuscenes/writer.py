"""Writing small data sets in nuScenes' format from the rendered world."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cable_rpc.data.nuscenes.written_rows import (
    LEVELS,
    Row,
    calibration_row,
    can_message,
    chain,
    made,
    messages_at_50_hz,
    pose,
    token,
    visibility_token,
    world_pose,
    write_json,
)
from cable_rpc.errors import SourceError

if TYPE_CHECKING:
    from cable_rpc.data.rendered_drive import DriveFrame

TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample", "sample_annotation",
    "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip
CAMERA = "CAM_FRONT"
START_US = 1_532_402_927_612_460
"""Time of the first frame: that of the first image of scene-0061."""
SCENE_GAP_US = 60_000_000
CATEGORIES = {
    0: "human.pedestrian.adult",
    1: "vehicle.bicycle",
    2: "vehicle.car",
    3: "vehicle.motorcycle",
    5: "vehicle.bus.rigid",
    7: "vehicle.truck",
}
JPEG_QUALITY = 95
POINTS = 20
"""Lidar points stated of every box."""


@dataclass(slots=True)
class SceneWriter:
    """One scene on its way into the tables."""

    root: Path
    name: str
    start_us: int
    keyframe_every: int
    tables: dict[str, list[Row]]
    samples: list[Row] = field(default_factory=list)
    images: list[Row] = field(default_factory=list)
    tracks: dict[int, list[Row]] = field(default_factory=dict)
    classes: dict[int, int] = field(default_factory=dict)

    @property
    def token(self) -> str:
        """The scene's own token."""
        return token("scene", self.name)

    def add(self, driven: DriveFrame) -> None:
        """Write a frame: its image, its pose, and on a keyframe its sample with annotations."""
        frame = driven.frame
        time_us = self.start_us + round(frame.capture_time_ns / 1000)
        key_frame = frame.index % self.keyframe_every == 0
        if key_frame:
            sample_token = token("sample", self.name, time_us)
            self.samples.append({"token": sample_token, "timestamp": time_us, "scene_token": self.token})
            self.annotate(driven, sample_token)
        folder = "samples" if key_frame else "sweeps"
        file_name = f"{folder}/{CAMERA}/{self.name}__{CAMERA}__{time_us}.jpg"
        path = self.root / file_name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not cv2.imwrite(str(path), frame.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]):
            raise SourceError(f"can't write {path}")
        pose_token = token("ego_pose", self.name, time_us)
        self.tables["ego_pose"].append({"token": pose_token, "timestamp": time_us, **pose(driven.world_from_vehicle)})
        height, width = frame.size_hw
        self.images.append(
            {
                "token": token("sample_data", self.name, time_us),
                "sample_token": self.samples[-1]["token"] if key_frame else "",
                "ego_pose_token": pose_token,
                "calibrated_sensor_token": token("calibrated_sensor", self.name),
                "timestamp": time_us,
                "fileformat": "jpg",
                "is_key_frame": key_frame,
                "height": height,
                "width": width,
                "filename": file_name,
            }
        )

    def annotate(self, driven: DriveFrame, sample_token: str) -> None:
        """Add the annotations of a keyframe."""
        truth = driven.frame.truth
        shares = [] if truth is None else truth.visibility.tolist()
        for cuboid, share in zip(driven.cuboids, shares, strict=True):
            length, width, height = cuboid.size_lwh_m
            row = {
                "token": token("annotation", sample_token, cuboid.track_id),
                "sample_token": sample_token,
                "instance_token": token("instance", self.name, cuboid.track_id),
                "visibility_token": visibility_token(share),
                "attribute_tokens": [],
                "size": [width, length, height],
                "num_lidar_pts": POINTS,
                "num_radar_pts": 0,
                **world_pose(cuboid, driven),
            }
            self.tables["sample_annotation"].append(row)
            self.tracks.setdefault(cuboid.track_id, []).append(row)
            self.classes[cuboid.track_id] = cuboid.class_id

    def finish(self, calibration: Row) -> None:
        """Chain the rows and put them into the tables."""
        following = self.samples[-1]["token"]
        for row in reversed(self.images):
            following = row["sample_token"] or following
            row["sample_token"] = following
        chain(self.samples)
        chain(self.images)
        self.tables["sample"] += self.samples
        self.tables["sample_data"] += self.images
        self.tables["calibrated_sensor"].append({"token": token("calibrated_sensor", self.name), **calibration})
        for track_id, rows in self.tracks.items():
            chain(rows)
            self.tables["instance"].append(
                {
                    "token": rows[0]["instance_token"],
                    "category_token": token("category", CATEGORIES[self.classes[track_id]]),
                    "nbr_annotations": len(rows),
                    "first_annotation_token": rows[0]["token"],
                    "last_annotation_token": rows[-1]["token"],
                }
            )
        self.tables["scene"].append(
            {
                "token": self.token,
                "log_token": token("log"),
                "nbr_samples": len(self.samples),
                "first_sample_token": self.samples[0]["token"],
                "last_sample_token": self.samples[-1]["token"],
                "name": self.name,
                "description": "Rendered",
            }
        )


def write_nuscenes(
    root: Path,
    drives: Mapping[str, Iterable[DriveFrame]],
    *,
    version: str = "v1.0-mini",
    keyframe_every: int = 6,
    can_bus: bool = True,
) -> None:
    """Write scenes with one camera, CAM_FRONT: all 13 tables, images as JPEG, CAN poses at 50 Hz.

    Args:
        root: the folder, made where it isn't there.
        drives: scene name, ``scene-0001`` in the original, to its frames: 12 per second in the original.
        version: name of the folder of tables.
        keyframe_every: one in so many frames is a keyframe with annotations.
        can_bus: whether to write the CAN bus expansion's pose messages.

    Raises:
        SourceError: a drive has no frames, or a file can't be written.
    """
    tables = fixed_tables()
    for number, (name, drive) in enumerate(drives.items()):
        writer = SceneWriter(root, name, START_US + number * SCENE_GAP_US, keyframe_every, tables)
        calibration: Row = {}
        messages: list[Row] = []
        for driven in drive:
            writer.add(driven)
            calibration = calibration_row(driven)
            messages.append(can_message(driven, writer.images[-1]["timestamp"]))
        if not messages:
            raise SourceError(f"drive '{name}' has no frames to write")
        writer.finish(calibration)
        if can_bus:
            write_json(root / "can_bus" / f"{name}_pose.json", messages_at_50_hz(messages))
    cv2.imwrite(str(made(root / "maps" / "rendered.png")), np.zeros((8, 8), np.uint8))
    for table in TABLES:
        write_json(root / version / f"{table}.json", tables[table])


def fixed_tables() -> dict[str, list[Row]]:
    """All tables, with the rows that no scene adds to."""
    tables: dict[str, list[Row]] = {table: [] for table in TABLES}
    tables["sensor"] = [{"token": token("sensor"), "channel": CAMERA, "modality": "camera"}]
    tables["category"] = [
        {"token": token("category", name), "name": name, "description": ""} for name in CATEGORIES.values()
    ]
    tables["visibility"] = [
        {"token": str(place), "level": level, "description": f"visible share up to {bound}"}
        for place, (bound, level) in enumerate(LEVELS, 1)
    ]
    log = {"logfile": "rendered", "vehicle": "rendered", "date_captured": "2018-07-24", "location": "rendered"}
    tables["log"] = [{"token": token("log"), **log}]
    tables["map"] = [
        {
            "token": token("map"),
            "log_tokens": [token("log")],
            "category": "semantic_prior",
            "filename": "maps/rendered.png",
        }
    ]
    return tables
