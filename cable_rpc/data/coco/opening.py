"""``coco-video:`` and ``wod_zb:`` specs to sources."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cable_rpc.data.coco.images import natural_key, sequence_names
from cable_rpc.data.coco.source import CocoSource, CocoView, read_sequence
from cable_rpc.data.coco.tables import CocoTables, read_tables
from cable_rpc.data.ego_csv import read_ego_csv
from cable_rpc.data.names import listed
from cable_rpc.data.sequence_spec import SequenceSpec, parse_sequence_spec
from cable_rpc.data.source import SourceOptions
from cable_rpc.errors import ConfigurationError, SourceError

DEFAULT_FPS = 10.0
OPTION_KEYS = ("images", "sequence", "fps")


@dataclass(frozen=True, slots=True)
class Found:
    """A sequence and the file that holds it."""

    tables: CocoTables
    name: str


def open_coco_video(rest: str, options: SourceOptions) -> CocoSource:
    """``coco-video:FILE.json#SEQUENCE?images=FOLDER&fps=10``; the sequence may stand as ``sequence=NAME`` too.

    Raises:
        ConfigurationError: an option can't be used, or the sequence isn't told and there are several.
        SourceError: the file or the images can't be read.
    """
    return open_spec(parse_spec("coco-video", rest), options)


def open_wod_zb(rest: str, options: SourceOptions) -> CocoSource:
    """``wod_zb:ROOT#SEQUENCE``: panoramas with annotation files in COCO's format in ROOT or ``ROOT/annotations``.

    Raises:
        ConfigurationError: an option can't be used, or the sequence isn't told and there are several.
        SourceError: a file or the images can't be read.
    """
    return open_spec(parse_spec("wod_zb", rest), options)


def sequences(root: Path) -> list[str]:
    """What can follow ``#``: the sequences of an annotation file, or of all annotation files of a folder.

    Raises:
        SourceError: there is no such file or folder, or one of the files can't be read.
    """
    names = (name for file in annotation_files(root) for name in sequence_names(read_tables(file)))
    return sorted(names, key=natural_key)


def open_spec(spec: SequenceSpec, options: SourceOptions) -> CocoSource:
    """Find the sequence and open it."""
    number_fps = stated_number_fps(spec)
    found = find_sequence(spec)
    sequence = read_sequence(
        found.tables, found.name, number_fps or stated_fps(found) or DEFAULT_FPS, options.bad_frames
    )
    folder = image_folder(spec.values.get("images"), found.tables.path, sequence.images[0].file_name)
    ego = None if options.ego_csv is None else read_ego_csv(options.ego_csv)
    view = CocoView(
        options.size, options.fps, options.max_frames, ego, options.intrinsics, options.mount, options.bad_frames
    )
    return CocoSource(sequence, folder, view)


def parse_spec(scheme: str, rest: str) -> SequenceSpec:
    """Take a spec apart; the sequence may stand among the options.

    Raises:
        ConfigurationError: an option is unknown, comes twice or has no value.
    """
    spec = parse_sequence_spec(scheme, rest, OPTION_KEYS)
    if spec.sequence is not None and "sequence" in spec.values:
        raise ConfigurationError(f"'{spec.spec}': give sequence once")
    return replace(spec, sequence=spec.sequence or spec.values.get("sequence"))


def stated_number_fps(spec: SequenceSpec) -> float | None:
    """The rate of the frame numbers that a spec states, where it does.

    Raises:
        ConfigurationError: it is none.
    """
    if "fps" not in spec.values:
        return None
    try:
        fps = float(spec.values["fps"])
    except ValueError:
        fps = 0.0
    if not 0 < fps < 1e6:
        raise ConfigurationError(f"'{spec.spec}': fps is '{spec.values['fps']}'; give a positive frame rate")
    return fps


def annotation_files(root: Path) -> list[Path]:
    """A file itself, or the JSON files of a folder or of its ``annotations``.

    Raises:
        SourceError: there is none.
    """
    if root.is_file():
        return [root]
    if not root.is_dir():
        raise SourceError(
            f"no such annotation file or folder: {root}; the format is described at https://cocodataset.org/#format-data"
        )
    places = (root / "annotations", root)
    files = next((files for place in places if (files := sorted(place.glob("*.json")))), [])
    if not files:
        raise SourceError(f"{root} holds no annotation files: neither {root / 'annotations'} nor it has *.json")
    return files


def find_sequence(spec: SequenceSpec) -> Found:
    """The sequence that is asked for, or the only one; one file is held at a time.

    Raises:
        ConfigurationError: it isn't there, or there are several.
        SourceError: a file can't be read.
    """
    found: Found | None = None
    names: list[str] = []
    for file in annotation_files(spec.root):
        tables = read_tables(file)
        here = sequence_names(tables)
        names += here
        wanted = here[0] if spec.sequence is None and here else spec.sequence
        if found is None and wanted in here:
            found = Found(tables, str(wanted))
    if spec.sequence is not None and names.count(spec.sequence) > 1:
        raise ConfigurationError(
            f"'{spec.spec}': several files hold '{spec.sequence}'; name one file in place of the folder"
        )
    if spec.sequence is None and len(names) > 1:
        raise ConfigurationError(f"'{spec.spec}' has {len(names)} sequences; add #SEQUENCE, {listed(names)}")
    if found is None and not names:
        raise SourceError(f"'{spec.spec}': no annotation file lists an image")
    if found is None:
        raise ConfigurationError(f"'{spec.spec}': there is no sequence '{spec.sequence}'; use {listed(names)}")
    return found


def stated_fps(found: Found) -> float | None:
    """The rate that the sequence's row among the videos states, where it has one."""
    for video_id, row in found.tables.videos.items():
        rate = row.get("fps", row.get("frame_rate"))
        if (row.get("name") or str(video_id)) == found.name and isinstance(rate, int | float) and 0 < rate < 1e6:
            return float(rate)
    return None


def image_folder(stated: str | None, annotation_file: Path, file_name: str) -> Path:
    """The folder in which a file name is found: the one given, else the first of the usual ones.

    Raises:
        SourceError: it is in none of them.
    """
    beside = annotation_file.parent
    usual: Sequence[Path] = (beside, beside / "images", beside.parent, beside.parent / "images")
    folders = usual if stated is None else (Path(stated),)
    for folder in folders:
        if (folder / file_name).exists():
            return folder
    if stated is not None and Path(stated).is_dir():
        return Path(stated)
    tried = ", ".join(str(folder) for folder in folders)
    raise SourceError(
        f"{annotation_file} names {file_name}, which is in none of {tried}; give the folder as ?images=FOLDER"
    )
