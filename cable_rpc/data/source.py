"""Frame sources by name: ``SCHEME:REST`` to an iterable of frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import parse_qsl

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.errors import ConfigurationError
from cable_rpc.types import CameraIntrinsics, CameraMount, Frame

MAX_PITCH_RAD = 1.2
SYNTHETIC_KEYS = ("route", "traffic")


class FrameSource(Protocol):
    """A recording or camera. Each iteration starts from the beginning where the medium allows it."""

    @property
    def name(self) -> str:
        """Short name for logs, tables and file names."""
        ...

    @property
    def fps(self) -> float:
        """Nominal frame rate; true times are in the frames."""
        ...

    @property
    def size_wh(self) -> tuple[int, int]:
        """(width, height) of the frames in pixels."""
        ...

    @property
    def frame_count(self) -> int | None:
        """Number of frames, None where it can't be known beforehand."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Frames with index 0, 1, 2, ... and rising capture times."""
        ...


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """What a user may ask of any source; None leaves it to the source."""

    max_frames: int | None = None
    ego_csv: Path | None = None
    size: tuple[int, int] | None = None
    intrinsics: CameraIntrinsics | None = None
    fps: float | None = None
    mount: CameraMount | None = None
    bad_frames: BadFrames = field(default_factory=BadFrames)
    """What becomes of damaged frames and label rows of a data set."""

    def __post_init__(self) -> None:
        if self.max_frames is not None and self.max_frames < 1:
            raise ConfigurationError(f"max_frames is {self.max_frames}; give at least 1")
        if self.size is not None and min(self.size) < 1:
            raise ConfigurationError(f"size is {self.size[0]}x{self.size[1]}; give at least 1x1 pixels")
        if self.fps is not None and not 0 < self.fps < 1e6:
            raise ConfigurationError(f"fps is {self.fps}; give a positive frame rate")
        if self.mount is not None and not (self.mount.height_m > 0 and abs(self.mount.pitch_down_rad) < MAX_PITCH_RAD):
            raise ConfigurationError(
                f"mount has height {self.mount.height_m} m and pitch {self.mount.pitch_down_rad} rad; give a height "
                f"above 0 and a pitch of less than {MAX_PITCH_RAD} rad"
            )


SourceFactory = Callable[[str, SourceOptions], FrameSource]


def open_video(rest: str, options: SourceOptions) -> FrameSource:
    """``video:FILE``, or ``video:FOLDER`` for a folder of numbered images."""
    from cable_rpc.data.ego_csv import read_ego_csv
    from cable_rpc.data.image_folder import ImageFolderSource
    from cable_rpc.data.video import VideoSource

    path = Path(rest)
    ego = None if options.ego_csv is None else read_ego_csv(options.ego_csv)
    kind = ImageFolderSource if path.is_dir() else VideoSource
    return kind(
        path,
        max_frames=options.max_frames,
        ego=ego,
        size=options.size,
        intrinsics=options.intrinsics,
        fps=options.fps,
        mount=options.mount,
    )


def open_synthetic(rest: str, options: SourceOptions) -> FrameSource:
    """``synthetic:SEED``, or ``synthetic:SEED?route=turns&traffic=none``; the simulation knows its own camera."""
    from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource

    if options.ego_csv is not None or options.intrinsics is not None or options.mount is not None:
        raise ConfigurationError(
            "a synthetic source simulates its own ego-motion and camera; leave ego_csv, intrinsics and mount out"
        )
    number, _, query = rest.partition("?")
    try:
        seed = int(number)
    except ValueError:
        raise ConfigurationError(f"'synthetic:{rest}': the seed must be a whole number") from None
    if seed < 0:
        raise ConfigurationError(f"'synthetic:{rest}': the seed must be at least 0")
    settings: dict[str, Any] = {"seed": seed, **synthetic_options(rest, query)}
    if options.size is not None:
        settings["width"], settings["height"] = options.size
    if options.fps is not None:
        settings["fps"] = options.fps
    if options.max_frames is not None:
        settings["frame_count"] = options.max_frames
    return SyntheticSource(SyntheticConfig(**settings))


def synthetic_options(rest: str, query: str) -> dict[str, str]:
    """The ``key=value&...`` part of a synthetic source's name; the values are judged by `SyntheticConfig`."""
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError:
        raise ConfigurationError(f"'synthetic:{rest}': write options as key=value, joined by &") from None
    for key, _ in pairs:
        if key not in SYNTHETIC_KEYS:
            raise ConfigurationError(
                f"'synthetic:{rest}': unknown option '{key}'; known are {', '.join(SYNTHETIC_KEYS)}"
            )
    options = dict(pairs)
    if len(options) < len(pairs):
        raise ConfigurationError(f"'synthetic:{rest}': give each option once")
    return options


def data_set(package: str, opener: str) -> SourceFactory:
    """A data set's factory, whose package is imported when it is first used."""

    def open_sequence(rest: str, options: SourceOptions) -> FrameSource:
        factory: SourceFactory = getattr(import_module(package), opener)
        return factory(rest, options)

    return open_sequence


DATA_SETS: Mapping[str, SourceFactory] = {
    "nuscenes": data_set("cable_rpc.data.nuscenes", "open_nuscenes"),
    "waymo": data_set("cable_rpc.data.waymo", "open_waymo"),
    "kitti": data_set("cable_rpc.data.kitti", "open_kitti"),
    "cadc": data_set("cable_rpc.data.cadc", "open_cadc"),
    "wod_zb": data_set("cable_rpc.data.coco", "open_wod_zb"),
    "coco-video": data_set("cable_rpc.data.coco", "open_coco_video"),
}
"""Scheme of a data set to factory; docs/datasets.md describes them."""
SOURCES: Mapping[str, SourceFactory] = {"video": open_video, "synthetic": open_synthetic, **DATA_SETS}
"""Scheme to factory."""
SOURCE_FORMS = (
    "video:FILE, video:FOLDER of images, synthetic:SEED[?route=turns&traffic=none], or a sequence of a data set, "
    f"SCHEME:ROOT#SEQUENCE with {', '.join(DATA_SETS)} (see docs/datasets.md)"
)
"""What can be opened, for help texts."""


def open_source(
    spec: str,
    *,
    max_frames: int | None = None,
    ego_csv: Path | None = None,
    size: tuple[int, int] | None = None,
    intrinsics: CameraIntrinsics | None = None,
    fps: float | None = None,
    mount: CameraMount | None = None,
    bad_frames: BadFrames | None = None,
) -> FrameSource:
    """Open a frame source.

    Args:
        spec: ``video:FILE``, ``video:FOLDER`` of images, ``synthetic:SEED`` with options such as
            ``?route=turns&traffic=none`` (`SyntheticConfig`), or a sequence of a data set such as
            ``kitti:ROOT#0002`` (docs/datasets.md).
        max_frames: stop after that many frames.
        ego_csv: ego-motion log for a video (``cable_rpc.data.ego_csv``).
        size: (width, height) to resize to; intrinsics are scaled along.
        intrinsics: the camera, in pixels of the video's own size.
        fps: frame rate; a video of a higher rate is thinned, a folder of images is played at it.
        mount: where the camera of a video sits on its vehicle.
        bad_frames: takes note of damaged frames and label rows of a data set; None makes any an error.

    Raises:
        ConfigurationError: unknown scheme or unusable option.
        SourceError: the source can't be read.
    """
    scheme, separator, rest = spec.partition(":")
    factory = SOURCES.get(scheme)
    if factory is None or not separator or not rest:
        known = ", ".join(f"{name}:..." for name in sorted(SOURCES))
        hint = f"for a file write 'video:{spec}'; " if Path(spec).exists() else ""
        raise ConfigurationError(
            f"can't open source '{spec}': known are {known}; {hint}a data set's sequence is SCHEME:ROOT#SEQUENCE, see "
            "docs/datasets.md"
        )
    options = SourceOptions(max_frames, ego_csv, size, intrinsics, fps, mount, bad_frames or BadFrames())
    return factory(rest, options)
