"""A codec study: many settings over several clips in parallel, each result kept the moment it is there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from pathlib import Path

from cable_codecs import available_codecs

from cable_rpc.errors import CableError, ConfigurationError
from cable_rpc.study.codec_compare import ANCHOR_CODEC
from cable_rpc.study.codec_measure import check_clip, measure_point, prepare_clip
from cable_rpc.study.study_points import POINTS_FILE, ClipRequest, PointStore, Setting, StudyPoint
from cable_rpc.study.study_treatments import TREATMENTS, WHOLE, applies, find_treatment
from cable_rpc.study.worker_pool import worker_pool

QUALITIES: Mapping[str, tuple[int, ...]] = {
    "h264": (18, 23, 28, 33, 38),
    "hevc": (18, 23, 28, 33, 38),
    "av1": (15, 25, 38, 50, 60),
    "vp9": (20, 30, 40, 50, 60),
    "jpeg": (10, 20, 35, 50, 70),
    "jpeg-ffmpeg": (14, 25, 40, 55, 72),
    "webp": (10, 30, 50, 75, 92),
}
"""Settings of each codec that bring road scenes to about the same luma PSNR, 34 to 45 dB, so that curves overlap."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One clip, treatment and codec at several qualities: what a worker is given at a time."""

    request: ClipRequest
    treatment: str
    codec: str
    qualities: tuple[int, ...]

    def setting(self, quality: int) -> Setting:
        """One of its settings."""
        return Setting(self.treatment, self.codec, quality)


@dataclass(frozen=True, slots=True)
class StudyPlan:
    """What to compare.

    Raises:
        ConfigurationError: Something is unknown here, missing or named twice.
    """

    requests: tuple[ClipRequest, ...]
    treatments: tuple[str, ...]
    codecs: tuple[str, ...]
    qualities: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Codec to its quality settings, the usual ones where it isn't named."""

    def __post_init__(self) -> None:
        if not self.requests:
            raise ConfigurationError("a codec study needs a clip; give video:FILE or synthetic:SEED")
        if len(set(self.requests)) < len(self.requests):
            raise ConfigurationError("a codec study has the same clip twice; name each once")
        for treatment in self.treatments:
            find_treatment(treatment)
        for codec in (*self.codecs, *self.qualities):
            check_codec(codec)

    def cells(self) -> list[Cell]:
        """All cells clip by clip, whole frames first; the anchor, whole frames in H.264, is always among them."""
        return [
            Cell(request, treatment, codec, self.qualities.get(codec) or default_qualities(codec))
            for request in self.requests
            for codec in dict.fromkeys((ANCHOR_CODEC, *self.codecs))
            for treatment in (WHOLE, *(self.treatments_for(codec) if codec in self.codecs else ()))
        ]

    def treatments_for(self, codec: str) -> list[str]:
        """The chosen treatments that a codec can carry, in the order of the table."""
        return [name for name, one in TREATMENTS.items() if name in self.treatments and applies(one, codec)]


Listener = Callable[[Cell, Sequence[StudyPoint]], None]
"""Told of each cell when all its points are there."""


def check_codec(codec: str) -> None:
    """Check that a codec can be used here.

    Raises:
        ConfigurationError: It can't.
    """
    if codec not in available_codecs():
        raise ConfigurationError(
            f"codec '{codec}' is unknown or can't be opened here; use {', '.join(available_codecs())}"
        )


def default_qualities(codec: str) -> tuple[int, ...]:
    """The quality settings to study a codec at.

    Raises:
        ConfigurationError: None are known.
    """
    if codec not in QUALITIES:
        raise ConfigurationError(f"no usual qualities are known for codec '{codec}'; give --quality {codec}=A,B,C,D,E")
    return QUALITIES[codec]


def run_study(
    plan: StudyPlan, folder: Path, *, workers: int = 2, again: bool = False, listener: Listener | None = None
) -> list[StudyPoint]:
    """Measure what the folder doesn't hold yet.

    Points are appended to ``codec_study.csv`` as each cell ends, so a run that is stopped goes on where it was. Rows
    of other plans stay in the file; rows of another version of this package are measured anew.

    Args:
        plan: What to compare.
        folder: Where the file lies; made where it is missing.
        workers: Processes; 1 measures in this one.
        again: Measure also what the folder holds; the new rows count.
        listener: Told of each cell, those found in the file first.

    Returns:
        The plan's points, in its order.

    Raises:
        ConfigurationError: The file can't be used, or a clip doesn't fit its request.
        CodecError: A codec failed.
        CableError: A worker died.
    """
    with PointStore(folder / POINTS_FILE) as store:
        missing: list[Cell] = []
        for cell in plan.cells():
            left = [q for q in cell.qualities if again or store.find(cell.request, cell.setting(q)) is None]
            if left:
                missing.append(replace(cell, qualities=tuple(left)))
            elif listener is not None:
                listener(cell, found(cell, store))
        for request in dict.fromkeys(cell.request for cell in missing):
            check_clip(request)
        for cell, points in measured(missing, workers):
            store.add(points)
            if listener is not None:
                listener(cell, points)
        return [point for cell in plan.cells() for point in found(cell, store)]


def found(cell: Cell, store: PointStore) -> list[StudyPoint]:
    """A cell's points that are there."""
    points = (store.find(cell.request, cell.setting(quality)) for quality in cell.qualities)
    return [point for point in points if point is not None]


def measured(cells: Sequence[Cell], workers: int) -> Iterator[tuple[Cell, list[StudyPoint]]]:
    """Each cell with its points, as they become ready."""
    if workers <= 1 or len(cells) <= 1:
        for cell in cells:
            yield cell, measure_cell(cell)
        return
    with worker_pool(workers) as pool:
        futures: dict[Future[list[StudyPoint]], Cell] = {pool.submit(measure_cell, cell): cell for cell in cells}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool as error:
            raise CableError(
                "a worker of the codec study died, probably for want of memory; give --workers 1 or fewer --frames"
            ) from error


def measure_cell(cell: Cell) -> list[StudyPoint]:
    """All points of a cell."""
    clip = prepare_clip(cell.request)
    return [measure_point(clip, cell.setting(quality)) for quality in cell.qualities]
