"""``kitti:`` specs to sources."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.ego_csv import EgoLog, read_ego_csv
from cable_rpc.data.kitti.calibration import read_calibration
from cable_rpc.data.kitti.labels import LabelRow, read_labels
from cable_rpc.data.kitti.layout import SequencePaths, find_sequences
from cable_rpc.data.kitti.oxts import read_oxts
from cable_rpc.data.kitti.source import KittiSequence, KittiSource
from cable_rpc.data.names import safe_name
from cable_rpc.data.numbered_images import NumberedImage, list_images
from cable_rpc.data.sequence_spec import choose_sequence, parse_sequence_spec
from cable_rpc.data.source import SourceOptions
from cable_rpc.data.time_stamps import read_stamps_by_number
from cable_rpc.errors import ConfigurationError
from cable_rpc.types import EgoMotion

log = logging.getLogger(__name__)

FRAME_PERIOD_NS = 100_000_000
"""KITTI's cameras run at 10 Hz, triggered by the turning lidar; the tracking download has no time stamps."""


def open_kitti(rest: str, options: SourceOptions) -> KittiSource:
    """``kitti:ROOT#0002``, where ROOT holds ``training`` and ``testing`` or is one of them; ``#testing/0002``.

    An ego-motion log given by the user takes the place of the oxts record.

    Raises:
        ConfigurationError: an option can't be used, or the sequence isn't told and there are several.
        SourceError: images, calibration or labels can't be read.
    """
    spec = parse_sequence_spec("kitti", rest)
    if options.intrinsics is not None or options.mount is not None:
        raise ConfigurationError(f"'{spec.spec}': KITTI is calibrated; leave intrinsics and mount out")
    found = find_sequences(spec.root)
    paths = found[choose_sequence(spec, list(found))]
    images = list_images(paths.images, capture_times(paths))
    if options.ego_csv is not None:
        motions: Mapping[int, EgoMotion] | EgoLog = read_ego_csv(options.ego_csv)
    else:
        motions = recorded_motion(paths, images, options.bad_frames)
    split = "" if paths.split.name == "training" else f"{paths.split.name}-"
    sequence = KittiSequence(
        safe_name(f"kitti-{split}{paths.sequence}"),
        images,
        read_calibration(paths.calibration),
        labels_of(paths, options.bad_frames),
        motions,
    )
    return KittiSource(sequence, options)


def sequences(root: Path) -> list[str]:
    """What can follow ``#``.

    Raises:
        SourceError: the folder isn't KITTI tracking's.
    """
    return list(find_sequences(root))


def capture_times(paths: SequencePaths) -> Callable[[int], int]:
    """Frame number to capture time in ns, by the sequence's time stamps or at 10 frames per second.

    Raises:
        SourceError: there are time stamps, but they can't be read.
    """
    if not paths.stamps.exists():
        return lambda number: number * FRAME_PERIOD_NS
    return read_stamps_by_number(paths.stamps)


def labels_of(paths: SequencePaths, bad_frames: BadFrames) -> Mapping[int, Sequence[LabelRow]] | None:
    """The labels of a sequence; None where its split comes without.

    Raises:
        SourceError: they can't be read, or those of this sequence are missing.
    """
    if paths.labels.parent.is_dir():
        return read_labels(paths.labels, bad_frames)
    if paths.split.name != "testing":
        log.warning("%s is not there; frames come without truth", paths.labels.parent)
    return None


def recorded_motion(
    paths: SequencePaths, images: Sequence[NumberedImage], bad_frames: BadFrames
) -> Mapping[int, EgoMotion]:
    """The oxts record of a sequence; what it lacks is said once.

    Raises:
        SourceError: it is there but can't be read.
    """
    if not paths.oxts.exists():
        log.warning("%s is not there; frames come without ego-motion", paths.oxts)
        return {}
    motions = read_oxts(paths.oxts, bad_frames)
    missing = [image.number for image in images if image.number not in motions]
    if missing:
        log.warning("%s has no line for %d frames, the first is %d", paths.oxts, len(missing), missing[0])
    return motions
