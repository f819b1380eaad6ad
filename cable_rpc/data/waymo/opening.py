"""``waymo:`` specs to sources, and what a root holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from cable_rpc.data.sequence_spec import SequenceSpec, choose_sequence, parse_sequence_spec
from cable_rpc.data.source import SourceOptions
from cable_rpc.data.waymo.camera import CameraName
from cable_rpc.data.waymo.segment import WEBSITE, Segment
from cable_rpc.data.waymo.segment_v1 import RecordSegment
from cable_rpc.data.waymo.segment_v2 import ComponentSegment
from cable_rpc.data.waymo.source import WaymoSource
from cable_rpc.errors import ConfigurationError, SourceError

Value = TypeVar("Value")

OPTION_KEYS = ("camera", "undistort")
SWITCHES: Mapping[str, bool] = {"0": False, "1": True}
TABLE_SUFFIX, RECORD_SUFFIX = ".parquet", ".tfrecord"
RECORD_PREFIX = "segment-"
RECORD_ENDING = "_with_camera_labels"
COMPONENTS = ("camera_image", "camera_calibration", "camera_box", "vehicle_pose")


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
    spec = parse_sequence_spec("waymo", rest, OPTION_KEYS)
    undistort = chosen(spec, "undistort", SWITCHES, "0")
    return WaymoSource(open_segment(spec, options), options, undistort=undistort)


def sequences(root: Path) -> list[str]:
    """The context names of the segments, which can follow ``#``.

    Raises:
        SourceError: there is no such root, or it holds no segment.
    """
    return sorted(segment_files(root))


def open_segment(spec: SequenceSpec, options: SourceOptions) -> Segment:
    """The segment that is asked for, of the version that lies there.

    Raises:
        ConfigurationError: there is no such camera or segment, or the segment isn't told and there are several.
        SourceError: the segment can't be read.
    """
    camera = chosen(spec, "camera", CameraName.__members__, CameraName.FRONT.name)
    files = segment_files(spec.root)
    asked = None if spec.sequence is None else segment_name(spec.sequence)
    name = choose_sequence(replace(spec, sequence=asked), sorted(files))
    path = files[name]
    if path.suffix == TABLE_SUFFIX:
        return ComponentSegment(path.parent.parent, name, camera, options.bad_frames)
    return RecordSegment(path, name, camera, options.bad_frames)


def chosen(spec: SequenceSpec, key: str, known: Mapping[str, Value], default: str) -> Value:
    """What an option stands for, in capitals or not.

    Raises:
        ConfigurationError: it isn't known.
    """
    word = spec.values.get(key, default)
    if word.upper() not in known:
        raise ConfigurationError(f"'{spec.spec}': there is no {key} '{word}'; known are {', '.join(known)}")
    return known[word.upper()]


def segment_name(stem: str) -> str:
    """The context name within a file's name."""
    return stem.removesuffix(RECORD_SUFFIX).removeprefix(RECORD_PREFIX).removesuffix(RECORD_ENDING)


def segment_files(root: Path) -> dict[str, Path]:
    """Segments by context name: the TFRecord file, or the ``camera_image`` table of each.

    Raises:
        SourceError: there is no such root, or it is or holds no segment.
    """
    if root.is_file() and root.suffix in (TABLE_SUFFIX, RECORD_SUFFIX):
        return {segment_name(root.stem): root}
    if root.is_file():
        raise SourceError(f"{root} is no file of the Waymo Open Dataset, which are *{TABLE_SUFFIX} or *{RECORD_SUFFIX}")
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
