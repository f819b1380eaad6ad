"""Annotations of nuScenes: 3-D boxes in the map's axes, at the instants of the samples."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.cuboids import Cuboid
from cable_rpc.data.json_fields import numbers, shown
from cable_rpc.data.nuscenes.categories import class_of_category, is_ignored
from cable_rpc.data.nuscenes.selection import rows_where
from cable_rpc.data.nuscenes.tables import TableRow, names_by_token, read_rows
from cable_rpc.data.poses import rotation_from_quaternion, yaw_of
from cable_rpc.errors import SourceError

VISIBLE_SHARES: Mapping[str, float] = {"v0-40": 0.2, "v40-60": 0.5, "v60-80": 0.7, "v80-100": 0.9}
"""Level, the visible share over all six cameras in percent, to the middle of its range."""
NO_CLASS = -1


@dataclass(frozen=True, slots=True)
class Annotation:
    """One annotated object."""

    cuboid: Cuboid
    """In the map's axes, x east, y north, z up, metres. Only the yaw of the rotation is kept: boxes are upright."""
    visibility: float
    """0..1; 1 where the level isn't told."""
    ignored: bool
    """Neither right nor wrong to detect: a class that isn't told, or not a single lidar or radar point in the box,
    which the data set's own evaluation leaves out too (nuscenes-devkit, eval/common/loaders.py)."""


def read_annotations(
    tables: Path, sample_times: Mapping[str, int], bad_frames: BadFrames
) -> dict[str, list[Annotation]] | None:
    """Annotations of the six classes and ignored ones by sample token; tracks count from 1 in order of time.

    Args:
        tables: folder of the version.
        sample_times: tokens of the samples, in order of time.
        bad_frames: what becomes of damaged rows.

    Returns:
        None for a test set, whose table of annotations is empty or missing.

    Raises:
        SourceError: a table is missing or damaged; a row is damaged, unless that is to be skipped.
    """
    path = tables / "sample_annotation.json"
    if tables.name.endswith("test") and not path.exists():
        return None
    if next(read_rows(path), None) is None:
        return None
    found: dict[str, list[TableRow]] = {token: [] for token in sample_times}
    for row in rows_where(path, "sample_token", sample_times):
        found[row.token("sample_token")].append(row)
    names = category_names(tables, {row.token("instance_token") for rows in found.values() for row in rows})
    levels = names_by_token(tables / "visibility.json", "level")
    tracks: dict[str, int] = {}
    annotations: dict[str, list[Annotation]] = {token: [] for token in sample_times}
    for sample_token, rows in found.items():
        for row in rows:
            try:
                name = names.get(row.token("instance_token"))
                if name is None:
                    raise SourceError(f"{row.place}: no instance '{row.token('instance_token')}' with a known category")
                if class_of_category(name) is None and not is_ignored(name):
                    continue
                track = tracks.setdefault(row.token("instance_token"), len(tracks) + 1)
                annotations[sample_token].append(annotation_of(row, name, track, levels))
            except SourceError as error:
                bad_frames.found(error)
    return annotations


def category_names(tables: Path, instance_tokens: set[str]) -> dict[str, str]:
    """Instance token to the name of its category."""
    categories = names_by_token(tables / "category.json", "name")
    instances = rows_where(tables / "instance.json", "token", instance_tokens)
    named = {row.token(): categories.get(row.token("category_token")) for row in instances}
    return {token: name for token, name in named.items() if name is not None}


def annotation_of(row: TableRow, category: str, track: int, levels: Mapping[str, str]) -> Annotation:
    """A row of sample_annotation.

    Raises:
        SourceError: a value is missing or can't be used.
    """
    x, y, z = numbers(row.values, "translation", 3, row.place)
    width, length, height = numbers(row.values, "size", 3, row.place)
    if min(width, length, height) <= 0:
        raise SourceError(f"{row.place}: size is {shown(row.values['size'])}; width, length and height are above 0")
    try:
        rotation = rotation_from_quaternion(numbers(row.values, "rotation", 4, row.place))
    except SourceError as error:
        raise SourceError(f"{row.place}: {error}") from error
    token = row.token("visibility_token")
    share = VISIBLE_SHARES.get(levels.get(token, "")) if token else 1.0
    if share is None:
        raise SourceError(
            f"{row.place}: visibility_token '{token}' is none of {', '.join(VISIBLE_SHARES)} in visibility.json"
        )
    class_id = class_of_category(category)
    unseen = row.values.get("num_lidar_pts") == 0 and row.values.get("num_radar_pts") == 0
    cuboid = Cuboid(
        (x, y, z),
        (length, width, height),
        float(yaw_of(rotation)),
        NO_CLASS if class_id is None else class_id,
        track,
    )
    return Annotation(cuboid, share, unseen or class_id is None)


def annotations_between(
    annotations: Mapping[str, Sequence[Annotation]], sample_times: Mapping[str, int], time_ns: int
) -> list[Annotation] | None:
    """Where the objects were at a time between two samples.

    Objects of both samples are moved in a straight line at constant speed and turned the short way, as the nuScenes
    devkit does it. Where an object of one sample only was is unknown; it is told as ignored, at its known place.

    Args:
        annotations: by sample token.
        sample_times: token to time of the samples, in order of time.
        time_ns: the time.

    Returns:
        None before the first and after the last sample.
    """
    tokens, times = list(sample_times), list(sample_times.values())
    later = bisect_right(times, time_ns)
    if later == 0 or (later == len(times) and time_ns > times[-1]):
        return None
    if later == len(times):
        return list(annotations[tokens[-1]])
    share = (time_ns - times[later - 1]) / (times[later] - times[later - 1])
    before = {one.cuboid.track_id: one for one in annotations[tokens[later - 1]]}
    after = {one.cuboid.track_id: one for one in annotations[tokens[later]]}
    both = [between(before[track], after[track], share) for track in before if track in after]
    once = [one for track, one in (before | after).items() if track not in before or track not in after]
    return both + [replace(one, ignored=True) for one in once]


def between(before: Annotation, after: Annotation, share: float) -> Annotation:
    """The annotation at a share 0..1 of the way from one to the other."""

    def mixed(a: float, b: float) -> float:
        return a + share * (b - a)

    one, two = before.cuboid, after.cuboid
    centre = tuple(mixed(a, b) for a, b in zip(one.centre_m, two.centre_m, strict=True))
    size = tuple(mixed(a, b) for a, b in zip(one.size_lwh_m, two.size_lwh_m, strict=True))
    yaw = one.yaw_rad + share * math.remainder(two.yaw_rad - one.yaw_rad, 2 * math.pi)
    cuboid = replace(
        one,
        centre_m=(centre[0], centre[1], centre[2]),
        size_lwh_m=(size[0], size[1], size[2]),
        yaw_rad=math.remainder(yaw, 2 * math.pi),
    )
    return Annotation(cuboid, mixed(before.visibility, after.visibility), before.ignored or after.ignored)
