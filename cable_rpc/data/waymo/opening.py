"""``waymo:`` specs to sources, and what a root holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cable_rpc.data.source import SourceOptions
from cable_rpc.data.waymo.camera import CameraName
from cable_rpc.data.waymo.segment import WEBSITE, Segment
from cable_rpc.data.waymo.segment_v1 import RecordSegment
from cable_rpc.data.waymo.segment_v2 import ComponentSegment
from cable_rpc.data.waymo.source import WaymoSource
from cable_rpc.errors import ConfigurationError, SourceError

LISTED_SEGMENTS = 10
OPTION_KEYS = ("camera", "undistort")
SWITCHES: Mapping[str, bool] = {"0": False, "1": True}
TABLE_SUFFIX, RECORD_SUFFIX = ".parquet", ".tfrecord"
RECORD_PREFIX = "segment-"
RECORD_ENDING = "_with_camera_labels"
COMPONENTS = ("camera_image", "camera_calibration", "camera_box", "vehicle_pose")


@dataclass(frozen=True, slots=True)
class WaymoSpec:
    """A spec taken apart: ``ROOT#SEGMENT?camera=NAME&undistort=1``."""

    spec: str
    """As written, for error texts."""
    root: Path
    segment: str | None
    camera: CameraName
    undistort: bool


def open_waymo(rest: str, options: SourceOptions) -> WaymoSource:
    """``waymo:ROOT#SEGMENT?camera=FRONT``.

    ROOT is a folder of version 2 (``ROOT/<component>/<segment>.parquet``) or of version 1 (``ROOT/*.tfrecord``),
    with or without a folder for the split between, or a file of either.

    Args:
        rest: what follows the scheme. A segment is called by its context name; it may be left out where there is but
            one. ``camera`` is FRONT, FRONT_LEFT, FRONT_RIGHT, SIDE_LEFT or SIDE_RIGHT; ``undistort=1`` takes the lens
            out of images and boxes.
        options: as for any source; ego_csv, intrinsics and mount make no sense here.

    Raises:
        ConfigurationError: an option can't be used, or the segment isn't told and there are several.
        SourceError: the data set can't be read.
    """
    spec = parse_spec(rest)
    return WaymoSource(open_segment(spec, options), options, undistort=spec.undistort)


def sequences(root: Path) -> list[str]:
    """The context names of the segments, which can follow ``#``.

    Raises:
        SourceError: there is no such root, or it holds no segment.
    """
    return sorted(segment_files(root))


def open_segment(spec: WaymoSpec, options: SourceOptions) -> Segment:
    """The segment that is asked for, of the version that lies there."""
    files = segment_files(spec.root)
    name = choose_segment(spec, sorted(files))
    path = files[name]
    if path.suffix == TABLE_SUFFIX:
        return ComponentSegment(path.parent.parent, name, spec.camera, options.bad_frames)
    return RecordSegment(path, name, spec.camera, options.bad_frames)


def parse_spec(rest: str) -> WaymoSpec:
    """Take a spec apart.

    Raises:
        ConfigurationError: an option is unknown, comes twice or can't be used.
    """
    spec = f"waymo:{rest}"
    head, _, query = rest.partition("?")
    root, _, segment = head.partition("#")
    values: dict[str, str] = {}
    for pair in query.split("&") if query else []:
        key, separator, value = pair.partition("=")
        if key not in OPTION_KEYS or not separator:
            raise ConfigurationError(
                f"'{spec}': write options as key=value, joined by &; known are {', '.join(OPTION_KEYS)}"
            )
        if key in values:
            raise ConfigurationError(f"'{spec}': give {key} once")
        values[key] = value
    camera = values.get("camera", CameraName.FRONT.name).upper()
    if camera not in CameraName.__members__:
        known = ", ".join(CameraName.__members__)
        raise ConfigurationError(f"'{spec}': there is no camera '{values['camera']}'; known are {known}")
    undistort = values.get("undistort", "0")
    if undistort not in SWITCHES:
        raise ConfigurationError(f"'{spec}': undistort is '{undistort}'; give 0 or 1")
    return WaymoSpec(
        spec, Path(root), segment_name(segment) if segment else None, CameraName[camera], SWITCHES[undistort]
    )


def segment_name(stem: str) -> str:
    """The context name within a file's name."""
    return stem.removesuffix(RECORD_SUFFIX).removeprefix(RECORD_PREFIX).removesuffix(RECORD_ENDING)


def segment_files(root: Path) -> dict[str, Path]:
    """Segments by context name: the TFRecord file, or the ``camera_image`` table of each.

    Raises:
        SourceError: there is no such root, or it holds no segment.
    """
    if root.is_file():
        return {segment_name(root.stem): root}
    if not root.is_dir():
        raise SourceError(f"no such file or folder: {root}; the Waymo Open Dataset is to be had at {WEBSITE}")
    patterns = ("camera_image/*.parquet", "*/camera_image/*.parquet", "*.tfrecord", "*/*.tfrecord")
    for pattern in patterns:
        files = {segment_name(path.stem): path for path in sorted(root.glob(pattern))}
        if files:
            return files
    others = sorted({path.name for name in COMPONENTS for path in [*root.glob(name), *root.glob(f"*/{name}")]})
    if others:
        raise SourceError(
            f"{root / 'camera_image'} is missing; there is {', '.join(others)} of version 2 only. "
            f"Fetch the component 'camera_image' from {WEBSITE}"
        )
    raise SourceError(
        f"{root} holds no Waymo segment: neither camera_image/*.parquet (version 2) nor *.tfrecord (version 1), also "
        f"not one folder deeper; the data set is to be had at {WEBSITE}"
    )


def choose_segment(spec: WaymoSpec, names: Sequence[str]) -> str:
    """The segment that is asked for, or the only one.

    Raises:
        ConfigurationError: it isn't there, or there are several.
    """
    some = ", ".join(f"'{name}'" for name in names[:LISTED_SEGMENTS])
    more = f" and {len(names) - LISTED_SEGMENTS} more" if len(names) > LISTED_SEGMENTS else ""
    if spec.segment is None and len(names) > 1:
        raise ConfigurationError(f"'{spec.spec}' has {len(names)} segments; add #SEGMENT, one of {some}{more}")
    if spec.segment is not None and spec.segment not in names:
        raise ConfigurationError(f"'{spec.spec}': there is no segment '{spec.segment}'; use one of {some}{more}")
    return names[0] if spec.segment is None else spec.segment
