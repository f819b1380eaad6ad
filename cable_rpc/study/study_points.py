"""The points of a codec study, and the CSV file that keeps them."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any, TextIO, get_type_hints

import cable_rpc
from cable_rpc.errors import ConfigurationError

POINTS_FILE = "codec_study.csv"
MASKS = ("corridor", "loop")
Key = tuple[str, str, str, str, str, int, str]


@dataclass(frozen=True, slots=True)
class ClipRequest:
    """Which frames, and which region of them.

    Raises:
        ConfigurationError: Unknown mask.
    """

    clip: str
    """As `open_source` takes it."""
    frame_limit: int
    mask: str
    """``corridor`` or ``loop``."""
    detector: str | None = None
    """Stands in for the cloud of the loop; None takes the clip's own true masks."""
    size: tuple[int, int] | None = None
    """(width, height) to resize to."""
    fps: float | None = None

    def __post_init__(self) -> None:
        if self.mask not in MASKS:
            raise ConfigurationError(f"mask '{self.mask}' is unknown; use {' or '.join(MASKS)}")

    @property
    def mask_label(self) -> str:
        """The mask, and where it came from."""
        return self.mask if self.mask == "corridor" else f"loop, {self.detector or 'truth'}"

    @property
    def selection(self) -> str:
        """Which of the clip's frames, and how large."""
        text = f"first {self.frame_limit} frames"
        if self.fps is not None:
            text += f" at {self.fps:g} fps"
        return text if self.size is None else f"{text} as {self.size[0]}x{self.size[1]}"


@dataclass(frozen=True, slots=True)
class Setting:
    """How a clip is coded."""

    treatment: str
    codec: str
    quality: int


@dataclass(frozen=True, slots=True)
class StudyPoint:
    """What one setting cost and gave, over a clip. Bytes are totals, times medians over the frames."""

    clip: str
    mask: str
    selection: str
    """Frames, rate and size asked for."""
    treatment: str
    codec: str
    quality: int
    version: str
    """Of this package."""
    width: int
    height: int
    fps: float
    frames: int
    """Frames coded."""
    whole_frames: int
    """Of them sent whole because the loop wanted it."""
    coverage: float
    """Mean share of the picture in the region, whole frames as 1."""
    coverage_sent: float
    """The same for what the treatment sent."""
    bitstream_bytes: int
    mask_bytes: int
    roi_psnr_db: float
    """Luma, inside the region before treatment: decibels of the mean over frames of each frame's squared error."""
    roi_ssim: float
    """Luma, likewise; mean over frames."""
    box_psnr_db: float | None
    """As ``roi_psnr_db``, inside the boxes of the truth's visible objects, sent or not; None without any."""
    box_ssim: float | None
    frame_psnr_db: float
    """As ``roi_psnr_db``, over the whole picture that the far end has: what became of the background."""
    treat_ms: float
    """Background and coded mask, at the edge."""
    encode_ms: float
    decode_ms: float
    restore_ms: float
    """What the far end undoes of the treatment."""

    @property
    def total_bytes(self) -> int:
        """Coded pictures and coded masks."""
        return self.bitstream_bytes + self.mask_bytes

    @property
    def kbps(self) -> float:
        """Kilobit per second of the clip, masks included."""
        return self.total_bytes * 8 * self.fps / self.frames / 1e3


FIELDS = tuple(field.name for field in fields(StudyPoint))


class PointStore:
    """The CSV file of a study: read when opened, appended to as points come.

    Raises:
        ConfigurationError: The file has other columns or can't be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.points: dict[Key, StudyPoint] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            whole = self.read(path.read_text(encoding="utf-8")) if path.exists() else False
            if not whole:
                self.rewrite()
            self.file: TextIO = path.open("a", encoding="utf-8", newline="")
        except OSError as error:
            raise ConfigurationError(f"can't write {path}: {error.strerror or error}") from error

    def __enter__(self) -> PointStore:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.file.close()

    def read(self, text: str) -> bool:
        """Take in a file; False where its end is missing, as after a crash."""
        rows = list(csv.reader(io.StringIO(text, newline="")))
        if not rows or rows[0] != list(FIELDS):
            raise ConfigurationError(
                f"{self.path} has other columns than this version writes; move it away or choose another --out"
            )
        for row in rows[1:]:
            point = parse_point(row)
            if point is None:
                return False
            self.points[key_of(point)] = point
        return text.endswith("\n")

    def rewrite(self) -> None:
        """Write all points anew, the whole file or none."""
        part = self.path.with_name(self.path.name + ".part")
        with part.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(FIELDS)
            writer.writerows(row_of(point) for point in self.points.values())
        os.replace(part, self.path)

    def add(self, points: Iterable[StudyPoint]) -> None:
        """Append points and see that they reach the file."""
        writer = csv.writer(self.file, lineterminator="\n")
        for point in points:
            self.points[key_of(point)] = point
            writer.writerow(row_of(point))
        self.file.flush()

    def find(self, request: ClipRequest, setting: Setting) -> StudyPoint | None:
        """The point of a setting, if it is there."""
        identity = (request.clip, request.mask_label, request.selection)
        return self.points.get((*identity, setting.treatment, setting.codec, setting.quality, cable_rpc.__version__))


def key_of(point: StudyPoint) -> Key:
    """What tells a point from all others."""
    identity = (point.clip, point.mask, point.selection)
    return (*identity, point.treatment, point.codec, point.quality, point.version)


def row_of(point: StudyPoint) -> list[str]:
    """A point as the cells of a row; None is empty."""
    return ["" if value is None else str(value) for value in astuple(point)]


def parse_point(row: Sequence[str]) -> StudyPoint | None:
    """Undo `row_of`; None where the row is cut."""
    if len(row) != len(FIELDS):
        return None
    try:
        return StudyPoint(**{name: PARSERS[name](cell) for name, cell in zip(FIELDS, row, strict=True)})
    except ValueError:
        return None


def number_or_none(text: str) -> float | None:
    """Undo the empty cell."""
    return float(text) if text else None


PARSERS: Mapping[str, Callable[[str], Any]] = {
    name: number_or_none if hint == float | None else hint for name, hint in get_type_hints(StudyPoint).items()
}
