"""Decoded frames on disk, and what the models find in them before any coding: made once, read by every cell.

A clip is a folder that appears whole or not at all. Frames are raw and mapped into memory, so processes beside each
other share one copy of them.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cable_rpc.data.source import open_source
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.study.digests import source_stamp
from cable_rpc.study.sweep.cell import ClipRequest
from cable_rpc.types import CameraIntrinsics, CameraMount, EgoMotion, Frame, GroundTruth

META_FILE, FRAMES_FILE, TRUTH_FILE = "clip.json", "frames.bgr", "truth.npz"
TRUTH_ARRAYS = ("boxes", "class_ids", "track_ids", "visibility")


@dataclass(frozen=True, slots=True)
class StoredClip:
    """A decoded clip; a `FrameSource`."""

    folder: Path
    meta: Mapping[str, Any]

    @property
    def name(self) -> str:
        """The source's own name."""
        return str(self.meta["name"])

    @property
    def fps(self) -> float:
        """Nominal frame rate."""
        return float(self.meta["fps"])

    @property
    def size_wh(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        width, height = self.meta["size_wh"]
        return int(width), int(height)

    @property
    def frame_count(self) -> int:
        """How many frames there are."""
        return len(self.meta["frames"])

    @property
    def annotated(self) -> bool:
        """Whether any frame has boxes of its own."""
        return any(entry["annotated"] for entry in self.meta["frames"])

    def __iter__(self) -> Iterator[Frame]:
        """Frames in order; their images are read-only views of the file."""
        width, height = self.size_wh
        shape = (self.frame_count, height, width, 3)
        images = np.memmap(self.folder / FRAMES_FILE, np.uint8, "r", shape=shape)
        truths = read_truths(self.folder / TRUTH_FILE, [entry["annotated"] for entry in self.meta["frames"]])
        for entry, image, truth in zip(self.meta["frames"], images, truths, strict=True):
            yield Frame(
                np.asarray(image),
                entry["index"],
                entry["capture_time_ns"],
                entry["ego"] and EgoMotion(**entry["ego"]),
                entry["intrinsics"] and CameraIntrinsics(**entry["intrinsics"]),
                truth,
                entry["mount"] and CameraMount(**entry["mount"]),
            )


def stored_clip(request: ClipRequest, cache: Path) -> StoredClip:
    """The clip of a request, decoded now where it isn't there.

    Args:
        request: which frames.
        cache: the folder of all clips.

    Raises:
        ConfigurationError: the source can't be opened so, or the folder can't be written to.
        SourceError: it can't be read, or has no frames.
    """
    folder = cache / clip_key(request)
    if not (folder / META_FILE).is_file():
        build_clip(request, folder)
    return StoredClip(folder, json.loads((folder / META_FILE).read_text(encoding="utf-8")))


def clip_key(request: ClipRequest) -> str:
    """A folder name for the frames of a request."""
    identity = [
        request.source,
        request.fps,
        request.size,
        request.max_frames,
        source_stamp(request.source),
    ]
    return "clip-" + hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:16]


def build_clip(request: ClipRequest, folder: Path) -> None:
    """Decode into a folder of another name, and rename it once it is whole."""
    source = open_source(request.source, max_frames=request.max_frames, size=request.size, fps=request.fps)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix="part-", dir=folder.parent))
    except OSError as error:
        raise ConfigurationError(f"can't write decoded clips to {folder.parent}: {error.strerror or error}") from error
    try:
        frames, truths = write_frames(source, part / FRAMES_FILE)
        if not frames:
            raise SourceError(f"'{request.source}' has no frames; choose another sequence or allow more of them")
        write_truths(truths, part / TRUTH_FILE)
        meta = {"name": source.name, "fps": source.fps, "size_wh": list(source.size_wh), "frames": frames}
        (part / META_FILE).write_text(json.dumps(meta), encoding="utf-8")
        publish(part, folder)
    except OSError as error:
        raise ConfigurationError(
            f"can't write decoded clips to {folder.parent}: {error.strerror or error}; free space there, or lower "
            "max_frames or size"
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def publish(part: Path, folder: Path) -> None:
    """Give a finished folder its name; another process may have been first, and made the same."""
    try:
        os.rename(part, folder)
    except OSError:
        if not (folder / META_FILE).is_file():
            raise


def write_frames(source: Any, path: Path) -> tuple[list[dict[str, Any]], list[GroundTruth | None]]:
    """Images into one raw file; everything else of the frames is returned."""
    width, height = source.size_wh
    entries: list[dict[str, Any]] = []
    truths: list[GroundTruth | None] = []
    with path.open("wb") as file:
        for frame in source:
            if frame.size_hw != (height, width):
                raise SourceError(
                    f"frame {frame.index} of '{source.name}' is {frame.size_hw[1]}x{frame.size_hw[0]}, the first was "
                    f"{width}x{height}; give a size to resize all of them to"
                )
            file.write(np.ascontiguousarray(frame.image).data)
            truths.append(frame.truth)
            entries.append(
                {
                    "index": frame.index,
                    "capture_time_ns": frame.capture_time_ns,
                    "ego": frame.ego and asdict(frame.ego),
                    "intrinsics": frame.intrinsics and asdict(frame.intrinsics),
                    "mount": frame.mount and asdict(frame.mount),
                    "annotated": frame.truth is not None,
                }
            )
    return entries, truths


def write_truths(truths: list[GroundTruth | None], path: Path) -> None:
    """All frames' boxes behind each other, with their numbers; instance masks are left out."""
    empty = np.zeros((0, 4), np.float32)
    ignored = [empty if one is None or one.ignored_boxes_xyxy is None else one.ignored_boxes_xyxy for one in truths]
    np.savez(
        path,
        counts=np.array([0 if one is None else len(one) for one in truths], np.int64),
        boxes=np.concatenate([empty if one is None else one.boxes_xyxy for one in truths]),
        class_ids=np.concatenate([[] if one is None else one.class_ids for one in truths]).astype(np.int32),
        track_ids=np.concatenate([[] if one is None else one.track_ids for one in truths]).astype(np.int32),
        visibility=np.concatenate([[] if one is None else one.visibility for one in truths]).astype(np.float32),
        ignored_counts=np.array([len(one) for one in ignored], np.int64),
        ignored=np.concatenate(ignored),
    )


def read_truths(path: Path, annotated: list[bool]) -> list[GroundTruth | None]:
    """The inverse of `write_truths`."""
    with np.load(path, allow_pickle=False) as stored:
        parts = {name: np.split(stored[name], np.cumsum(stored["counts"])[:-1]) for name in TRUTH_ARRAYS}
        ignored = np.split(stored["ignored"], np.cumsum(stored["ignored_counts"])[:-1])
    return [
        GroundTruth(
            parts["boxes"][k],
            parts["class_ids"][k],
            parts["track_ids"][k],
            parts["visibility"][k],
            ignored_boxes_xyxy=ignored[k] if len(ignored[k]) else None,
        )
        if has_truth
        else None
        for k, has_truth in enumerate(annotated)
    ]
