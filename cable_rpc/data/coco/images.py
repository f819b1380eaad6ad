"""Image rows of an annotation file: what they tell, and which sequence they belong to."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

from cable_rpc.data.coco.tables import CocoTables
from cable_rpc.data.json_fields import Identifier, JsonRow, identifier, is_finite, number, numbers, shown, side_px, text
from cable_rpc.errors import SourceError
from cable_rpc.types import CameraIntrinsics, CameraMount, EgoMotion

SEQUENCE_KEYS = ("sequence", "sequence_name", "video", "video_name")
ORDER_KEYS = ("frame_id", "frame_index")
TIME_UNITS_NS = {"timestamp_ns": 1, "timestamp_us": 1_000, "timestamp_micros": 1_000, "timestamp_ms": 1_000_000}
"""Nanoseconds in a unit of the fields whose names tell it."""
NS_PER_S = 1_000_000_000
EPOCH_UNITS_NS = ((1e17, 1), (1e14, 1_000), (1e11, 1_000_000))
"""Of a plain ``timestamp``: from this value on it counts so many ns (since 1970), below the last it is seconds."""


@dataclass(frozen=True, slots=True)
class ImageRow:
    """One image of a sequence."""

    place: str
    """Where the row stands, for error texts."""
    image_id: Identifier
    file_name: str
    size_wh: tuple[int, int] | None
    number: int | None
    """Its number in the sequence, where the row has one."""
    time_ns: int | None
    ego: EgoMotion | None
    intrinsics: CameraIntrinsics | None
    mount: CameraMount | None


def sequence_names(tables: CocoTables) -> list[str]:
    """The sequences of a file, in natural order.

    Rows whose sequence can't be told are left to the reading of that sequence.
    """
    return sorted({sequence_of(tables, row) for row in tables.images}, key=natural_key)


def sequence_of(tables: CocoTables, row: JsonRow) -> str:
    """The sequence of an image: its video's name, its own field, or the folder of its file; else the file's stem."""
    video_id = row.get("video_id")
    if isinstance(video_id, str | int):
        name = tables.videos.get(video_id, {}).get("name")
        return name if isinstance(name, str) and name else str(video_id)
    for key in SEQUENCE_KEYS:
        if isinstance(row.get(key), str | int):
            return str(row[key])
    folder = str(PurePosixPath(str(row.get("file_name", ""))).parent)
    return tables.path.stem if folder == "." else folder


def image_row(row: JsonRow, place: str) -> ImageRow:
    """Read one row.

    Raises:
        SourceError: a value can't be used.
    """
    sized = "width" in row or "height" in row
    return ImageRow(
        place=place,
        image_id=identifier(row, "id", place),
        file_name=text(row, "file_name", place),
        size_wh=(side_px(row, "width", place), side_px(row, "height", place)) if sized else None,
        number=frame_number(row, place),
        time_ns=time_ns(row, place),
        ego=ego_motion(row, place),
        intrinsics=camera(row, place),
        mount=camera_mount(row, place),
    )


def frame_number(row: JsonRow, place: str) -> int | None:
    """The image's number in its video, where it has one.

    Raises:
        SourceError: it is no whole number.
    """
    for key in ORDER_KEYS:
        if key in row:
            value = number(row, key, place)
            if value != int(value):
                raise SourceError(f"{place}: {key} is {shown(row[key])}; it must be a whole number")
            return int(value)
    return None


def time_ns(row: JsonRow, place: str) -> int | None:
    """The capture time in ns, where the row has one: of a field that tells its unit, or of ``timestamp``.

    Raises:
        SourceError: it is no finite number.
    """
    for key, unit_ns in TIME_UNITS_NS.items():
        if key in row:
            number(row, key, place)
            return in_ns(row[key], unit_ns)
    if "timestamp" not in row:
        return None
    stamp = number(row, "timestamp", place)
    unit = next((unit_ns for least, unit_ns in EPOCH_UNITS_NS if stamp >= least), NS_PER_S)
    return in_ns(row["timestamp"], unit)


def in_ns(value: int | float, unit_ns: int) -> int:
    """A time in ns; whole numbers stay exact, which 64-bit floats of ns since 1970 would not."""
    return value * unit_ns if isinstance(value, int) else round(value * unit_ns)


def ego_motion(row: JsonRow, place: str) -> EgoMotion | None:
    """Our extension of the format: ``speed_mps``, ``yaw_rate_radps`` (left), and ``lateral_mps`` (right) if known.

    Raises:
        SourceError: one of the first two is missing, or a value is no finite number.
    """
    if "speed_mps" not in row and "yaw_rate_radps" not in row:
        return None
    lateral_mps = number(row, "lateral_mps", place) if "lateral_mps" in row else 0.0
    return EgoMotion(number(row, "speed_mps", place), lateral_mps, number(row, "yaw_rate_radps", place))


def camera(row: JsonRow, place: str) -> CameraIntrinsics | None:
    """Pinhole parameters: ``fx, fy, cx, cy`` in pixels of the file, or MMDetection3D's ``cam_intrinsic`` matrix.

    Raises:
        SourceError: a value is missing or unusable.
    """
    if "fx" in row:
        fx, fy, cx, cy = (number(row, key, place) for key in ("fx", "fy", "cx", "cy"))
        return CameraIntrinsics(fx, fy, cx, cy)
    matrix = row.get("cam_intrinsic")
    if matrix is None:
        return None
    usable = isinstance(matrix, list) and len(matrix) >= 2 and all(isinstance(line, list) for line in matrix[:2])
    if not usable or not all(len(line) >= 3 and all(map(is_finite, line[:3])) for line in matrix[:2]):
        raise SourceError(f"{place}: cam_intrinsic is {shown(matrix)}; it must be a 3x3 matrix of finite numbers")
    return CameraIntrinsics(float(matrix[0][0]), float(matrix[1][1]), float(matrix[0][2]), float(matrix[1][2]))


def camera_mount(row: JsonRow, place: str) -> CameraMount | None:
    """Our extension: ``mount`` is height (m), pitch below the horizontal (rad) and distance ahead (m).

    Raises:
        SourceError: it isn't three finite numbers.
    """
    return CameraMount(*numbers(row, "mount", 3, place)) if "mount" in row else None


def natural_key(name: str) -> list[str | int]:
    """Sorts ``img10`` after ``img9``."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]
