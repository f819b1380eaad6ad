"""What one scene needs of the tables, and nothing else of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.json_fields import numbers, shown, side_px, text
from cable_rpc.data.nuscenes.annotations import Annotation, read_annotations
from cable_rpc.data.nuscenes.selection import rows_where
from cable_rpc.data.nuscenes.tables import TableRow, names_by_token, read_rows, time_of
from cable_rpc.data.poses import rigid, rotation_from_quaternion
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.types import CameraIntrinsics

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera on its vehicle."""

    vehicle_from_camera: FloatArray
    """float64 [4, 4]; vehicle x forward, y left, z up, origin on the road; camera in optical axes."""
    intrinsics: CameraIntrinsics


@dataclass(frozen=True, slots=True)
class CameraImage:
    """One row of sample_data with what it points to."""

    file_name: str
    """Relative to the data set's root."""
    time_ns: int
    is_key_frame: bool
    sample_token: str
    size_wh: tuple[int, int]
    calibration: Calibration
    world_from_vehicle: FloatArray
    """float64 [4, 4], the vehicle's pose when this image was taken."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A camera's recording of one scene with its annotations."""

    name: str
    images: Sequence[CameraImage]
    """In order of time, at least one."""
    sample_times_ns: Mapping[str, int]
    """Token to time of the samples, the instants that were annotated, in order of time."""
    annotations: Mapping[str, Sequence[Annotation]] | None
    """By sample token; None where the data set isn't annotated."""


def scene_names(tables: Path) -> list[str]:
    """Names of a version's scenes, sorted.

    Raises:
        SourceError: the table can't be read.
    """
    return sorted(names_by_token(tables / "scene.json", "name").values())


def read_scene(tables: Path, name: str, camera: str, bad_frames: BadFrames) -> Scene:
    """Read one scene.

    Every table is gone through once and reduced on the way, so memory holds a scene and never a whole table. The full
    release (v1.0-trainval: 2.6 million rows each of sample_data and ego_pose, 1.2 million annotations) takes 10 to 20
    seconds a scene that way, v1.0-mini about one.

    Args:
        tables: folder of the version.
        name: of the scene.
        camera: channel such as CAM_FRONT.
        bad_frames: what becomes of damaged rows of images, poses and annotations.

    Raises:
        ConfigurationError: no such camera.
        SourceError: a table is missing or damaged, or the scene has no image of the camera.
    """
    sensors = names_by_token(tables / "sensor.json", "channel")
    if camera not in sensors.values():
        cameras = sorted(channel for channel in sensors.values() if channel.startswith("CAM"))
        raise ConfigurationError(f"{tables} has no camera '{camera}'; it has {', '.join(cameras) or 'none'}")
    scenes = names_by_token(tables / "scene.json", "name")
    sample_times = read_samples(tables, {token for token, other in scenes.items() if other == name})
    images = read_images(tables, camera, sensors, sample_times, bad_frames)
    if not images:
        raise SourceError(f"{tables / 'sample_data.json'} has no image of {camera} in scene '{name}' that can be used")
    return Scene(name, images, sample_times, read_annotations(tables, sample_times, bad_frames))


def read_samples(tables: Path, scene_tokens: set[str]) -> dict[str, int]:
    """Token to time in ns of a scene's samples, in order of time.

    Raises:
        SourceError: the table can't be read, or a row has no time.
    """
    times = {
        text(row.values, "token", row.place): time_of(row)
        for row in rows_where(tables / "sample.json", "scene_token", scene_tokens)
    }
    return dict(sorted(times.items(), key=lambda item: item[1]))


def read_images(
    tables: Path, camera: str, sensors: Mapping[str, str], sample_times: Mapping[str, int], bad_frames: BadFrames
) -> list[CameraImage]:
    """A camera's images of the given samples and of the sweeps between them, in order of time.

    The order is that of the chain of ``next`` tokens, without needing one: cut-down sets have none.

    Raises:
        SourceError: a table or a row of calibration is missing; a row of an image or pose is damaged, unless that is
            to be skipped.
    """
    calibrated = {row.token(): row for row in read_rows(tables / "calibrated_sensor.json")}
    rows: list[TableRow] = []
    for row in rows_where(tables / "sample_data.json", "sample_token", sample_times):
        calibration = calibrated.get(row.token("calibrated_sensor_token"))
        if calibration is None:
            raise SourceError(
                f"{tables / 'calibrated_sensor.json'} has no row '{row.token('calibrated_sensor_token')}', "
                f"which {row.place} points to"
            )
        if sensors.get(calibration.token("sensor_token")) == camera:
            rows.append(row)
    used = {row.token("calibrated_sensor_token") for row in rows}
    calibrations = {token: calibration_of(calibrated[token]) for token in used}
    pose_tokens = {row.token("ego_pose_token") for row in rows}
    poses = {row.token(): row for row in rows_where(tables / "ego_pose.json", "token", pose_tokens)}
    images: dict[int, CameraImage] = {}
    for row in rows:
        try:
            pose = poses.get(row.token("ego_pose_token"))
            if pose is None:
                raise SourceError(
                    f"{tables / 'ego_pose.json'} has no row '{row.token('ego_pose_token')}', "
                    f"which {row.place} points to"
                )
            image = image_of(row, calibrations[row.token("calibrated_sensor_token")], pose_of(pose))
            if image.time_ns in images:
                raise SourceError(f"{row.place}: {image.file_name} has the time of {images[image.time_ns].file_name}")
        except SourceError as error:
            bad_frames.found(error)
            continue
        images[image.time_ns] = image
    return [images[time] for time in sorted(images)]


def image_of(row: TableRow, calibration: Calibration, world_from_vehicle: FloatArray) -> CameraImage:
    """A row of sample_data.

    Raises:
        SourceError: a value is missing or can't be used.
    """
    return CameraImage(
        text(row.values, "filename", row.place),
        time_of(row),
        row.values.get("is_key_frame") is True,
        row.token("sample_token"),
        (side_px(row.values, "width", row.place), side_px(row.values, "height", row.place)),
        calibration,
        world_from_vehicle,
    )


def calibration_of(row: TableRow) -> Calibration:
    """A camera's row of calibrated_sensor.

    Raises:
        SourceError: a value is missing or can't be used.
    """
    matrix = row.values.get("camera_intrinsic")
    if not isinstance(matrix, list) or len(matrix) != 3:
        raise SourceError(f"{row.place}: camera_intrinsic is {shown(matrix)}; a camera has 3 rows of 3 numbers")
    keyed = {f"camera_intrinsic[{index}]": line for index, line in enumerate(matrix)}
    first, second, _ = (numbers(keyed, key, 3, row.place) for key in keyed)
    return Calibration(pose_of(row), CameraIntrinsics(first[0], second[1], first[2], second[2]))


def pose_of(row: TableRow) -> FloatArray:
    """The rigid transform, float64 [4, 4], of a row with a translation in metres and a rotation w, x, y, z.

    Raises:
        SourceError: a value is missing or can't be used.
    """
    rotation = numbers(row.values, "rotation", 4, row.place)
    translation = numbers(row.values, "translation", 3, row.place)
    try:
        return rigid(rotation_from_quaternion(rotation), translation)
    except SourceError as error:
        raise SourceError(f"{row.place}: {error}") from error
