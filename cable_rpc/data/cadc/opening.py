"""``cadc:`` specs to sources."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.cadc.annotations import camera_height_m, read_annotations
from cable_rpc.data.cadc.calibration import read_calibration
from cable_rpc.data.cadc.layout import LABELLED_TREES, TREES, DrivePaths, drive_paths, find_drives
from cable_rpc.data.cadc.novatel import read_novatel
from cable_rpc.data.cadc.source import CadcDrive, CadcSource
from cable_rpc.data.cuboids import Cuboid
from cable_rpc.data.names import safe_name
from cable_rpc.data.numbered_images import NumberedImage, list_images
from cable_rpc.data.sequence_spec import choose_sequence, parse_sequence_spec
from cable_rpc.data.source import SourceOptions
from cable_rpc.data.time_stamps import read_stamps, read_stamps_by_number
from cable_rpc.errors import ConfigurationError
from cable_rpc.types import CameraMount

log = logging.getLogger(__name__)

NS_PER_S = 1_000_000_000
LABELLED_FPS = 3.0
RAW_FPS = 10.0
"""Nominal rates, for drives without the time stamps that the download comes with."""
SAME_INSTANT_NS = 50_000_000
"""Half a period of the raw images."""


def open_cadc(rest: str, options: SourceOptions) -> CadcSource:
    """``cadc:ROOT#2018_03_06/0001?tree=labeled``; trees are ``labeled`` or ``processed`` (undistorted) and ``raw``.

    Raises:
        ConfigurationError: an option can't be used, or the drive isn't told and there are several.
        SourceError: images, calibration or annotations can't be read.
    """
    spec = parse_sequence_spec("cadc", rest, ("tree",))
    tree = spec.values.get("tree")
    if tree is not None and tree not in TREES:
        raise ConfigurationError(f"'{spec.spec}': tree is '{tree}'; known are {', '.join(TREES)}")
    if options.ego_csv is not None or options.intrinsics is not None or options.mount is not None:
        raise ConfigurationError(
            f"'{spec.spec}': CADC has its own ego-motion and camera; leave ego_csv, intrinsics and mount out"
        )
    drives = find_drives(spec.root)
    name = choose_sequence(spec, list(drives))
    paths = drive_paths(drives[name], tree)
    calibration = read_calibration(paths.calibration)
    annotations = annotations_of(paths, options.bad_frames)
    time_of = capture_times(paths)
    images = list_images(paths.images, time_of)
    motion = read_novatel(paths.novatel, {image.number: image.time_ns for image in images}, options.bad_frames)
    if motion is None:
        log.warning("%s has no GNSS record; frames come without ego-motion", paths.novatel)
    height_m = camera_height_m(annotations, calibration)
    drive = CadcDrive(
        safe_name(f"cadc-{name}" + ("-raw" if paths.distorted else "")),
        images if paths.distorted else with_missing(images, len(annotations), time_of),
        paths.distorted,
        calibration,
        annotated_images(paths, images, annotations),
        motion,
        None if height_m is None else CameraMount(height_m, calibration.pitch_down_rad, calibration.forward_m),
    )
    return CadcSource(drive, options)


def sequences(root: Path) -> list[str]:
    """What can follow ``#``.

    Raises:
        SourceError: the folder isn't CADC's.
    """
    return list(find_drives(root))


def capture_times(paths: DrivePaths) -> Callable[[int], int]:
    """Image number to capture time in ns, by the camera's time stamps or at the tree's nominal rate.

    Raises:
        SourceError: there are time stamps, but they can't be read.
    """
    if not paths.stamps.exists():
        fps = RAW_FPS if paths.distorted else LABELLED_FPS
        log.warning("%s is not there; frames are taken to come at %.3g per second", paths.stamps, fps)
        return lambda number: round(number * NS_PER_S / fps)
    return read_stamps_by_number(paths.stamps)


def annotations_of(paths: DrivePaths, bad_frames: BadFrames) -> list[list[Cuboid]]:
    """The cuboids of a drive by annotated instant; none for a raw tree that came alone, as the download does.

    Raises:
        SourceError: they can't be read, or a labelled tree's are missing.
    """
    if paths.distorted and not paths.annotations.exists():
        log.warning("%s is not there; frames come without truth", paths.annotations)
        return []
    return read_annotations(paths.annotations, bad_frames)


def with_missing(images: Sequence[NumberedImage], annotated: int, time_of: Callable[[int], int]) -> list[NumberedImage]:
    """Images of the labelled tree, with those after the first that have annotations but no file.

    Reading then finds them missing.
    """
    there = {image.number: image for image in images}
    sample = images[0].path
    for number in range(images[0].number, annotated):
        if number not in there:
            there[number] = NumberedImage(number, sample.with_stem(f"{number:010d}"), time_of(number))
    return [there[number] for number in sorted(there)]


def annotated_images(
    paths: DrivePaths, images: Sequence[NumberedImage], annotations: Sequence[Sequence[Cuboid]]
) -> Mapping[int, Sequence[Cuboid]]:
    """Cuboids by image number.

    Annotation ``n`` is that of image ``n`` of the labelled tree. Raw images are numbered on their own: the one of the
    same instant is looked for, or the same number taken where both are as many.
    """
    if not paths.distorted:
        return dict(enumerate(annotations))
    if not annotations:
        return {}
    stamp_files = (paths.camera_of(tree) / "timestamps.txt" for tree in LABELLED_TREES)
    stamps = next((read_stamps(file) for file in stamp_files if file.exists()), None)
    if stamps is None or not paths.stamps.exists():
        if len(images) == len(annotations):
            return {image.number: cuboids for image, cuboids in zip(images, annotations, strict=True)}
        log.warning(
            "%s: %d raw images for %d annotations and no time stamps of both trees; frames come without truth",
            paths.drive,
            len(images),
            len(annotations),
        )
        return {}
    times = np.array([image.time_ns for image in images], np.int64)
    found: dict[int, Sequence[Cuboid]] = {}
    for stamp, cuboids in zip(stamps, annotations, strict=False):
        nearest = int(np.abs(times - stamp).argmin())
        if abs(int(times[nearest]) - stamp) < SAME_INSTANT_NS:
            found[images[nearest].number] = cuboids
    return found
