"""Frames a second and memory of the readers of data sets: ``python benchmarks/readers.py``.

Each reader reads a data set in its own format, written from one rendered drive by its writer, in a process of its own
and on one thread. ``open`` is the time to the first frame, everything that is read beforehand included; ``fps`` counts
the frames after it with their decoding, by the clock and by CPU time. Memory is the peak above what the imports take,
as Linux counts it (``VmHWM``); ``growth`` is what of it came in the second half of the frames: a lazy reader
has next to none. With ``--shared PATH`` the fragments of real data sets in that folder are read too, as far as they go.
Data sets of your own are measured with ``--spec kitti:ROOT#0002``.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
from rich.console import Console
from rich.table import Table

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.source import SourceOptions
from cable_rpc.errors import CableError

NAME = "drive"
READERS = {
    "nuscenes": ("cable_rpc.data.nuscenes", "open_nuscenes"),
    "waymo": ("cable_rpc.data.waymo", "open_waymo"),
    "kitti": ("cable_rpc.data.kitti", "open_kitti"),
    "cadc": ("cable_rpc.data.cadc", "open_cadc"),
    "wod_zb": ("cable_rpc.data.coco", "open_wod_zb"),
    "coco-video": ("cable_rpc.data.coco", "open_coco_video"),
    "video": ("cable_rpc.data.source", "open_video"),
}
"""Scheme to module and function; imported by the process that measures it only."""
WRITERS = {
    "nuscenes": ("cable_rpc.data.nuscenes", "write_nuscenes", "nuscenes", "scene-0001"),
    "waymo, v2": ("cable_rpc.data.waymo", "write_waymo", "waymo", NAME),
    "waymo, v1": ("cable_rpc.data.waymo", "write_waymo_v1", "waymo", NAME),
    "kitti": ("cable_rpc.data.kitti", "write_kitti", "kitti", "0000"),
    "cadc": ("cable_rpc.data.cadc", "write_cadc", "cadc", "2018_03_06/0001"),
    "wod_zb": ("cable_rpc.data.coco", "write_coco", "wod_zb", NAME),
}
"""Label to module, function, scheme, and the name of the sequence to write."""
FRAGMENTS = (
    "kitti:kitti-tracking-0002",
    "kitti:formats/kitti-tracking-mini#0001",
    "nuscenes:formats/nuscenes",
    "waymo:formats/waymo-v1/pvps_data_one_frame.tfrecord",
    "video:camvid-0016E5/images",
    "video:urban-540p/traffic.mp4",
)


@dataclass(frozen=True)
class Reading:
    """What reading a sequence took."""

    name: str
    width: int
    height: int
    frames: int
    boxes: int
    open_ms: float
    fps: float
    cpu_fps: float
    memory_mb: float
    growth_mb: float


def measure(spec: str, skip_bad: bool) -> Reading:
    """Read a sequence to its end."""
    scheme, _, rest = spec.partition(":")
    module, function = READERS[scheme]
    open_reader = getattr(importlib.import_module(module), function)
    options = SourceOptions(bad_frames=BadFrames(skip=skip_bad))
    imported_mb = peak_mb()
    began = time.perf_counter()
    source = open_reader(rest, options)
    half = (source.frame_count or 0) // 2
    count = boxes = 0
    half_mb = imported_mb
    started = cpu_started = open_ms = 0.0
    for frame in source:
        if count == 0:
            open_ms = 1e3 * (time.perf_counter() - began)
            started, cpu_started = time.perf_counter(), time.process_time()
        count += 1
        boxes += 0 if frame.truth is None else len(frame.truth)
        if count == half:
            half_mb = peak_mb()
    seconds, cpu_s = time.perf_counter() - started, time.process_time() - cpu_started
    width, height = source.size_wh
    later = count - 1
    return Reading(
        source.name, width, height, count, boxes, open_ms,
        later / seconds if later > 0 else 0.0, later / cpu_s if later > 0 and cpu_s > 0 else 0.0,
        peak_mb() - imported_mb, peak_mb() - half_mb if half else 0.0,
    )  # fmt: skip


def peak_mb() -> float:
    """Peak resident memory of this process so far, MB.

    Not ``ru_maxrss``: Linux carries the parent's peak over into it.
    """
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1024 / 1e6


def measured_in_child(spec: str, skip_bad: bool) -> Reading | str:
    """A reading in a process of its own; in words why there is none."""
    command = [sys.executable, __file__, "--child", spec, *(["--skip-bad"] if skip_bad else [])]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        return (done.stderr.strip().splitlines() or ["it ended without a word"])[-1]
    return Reading(**json.loads(done.stdout.splitlines()[-1]))


def write_sets(folder: Path, frames: int, size: tuple[int, int], seed: int) -> dict[str, str]:
    """Write one rendered drive in every format; label to spec, or to why it isn't there in brackets."""
    from cable_rpc.data.rendered_drive import RenderedDrive
    from cable_rpc.data.synthetic import SyntheticConfig

    width, height = size
    drive = list(RenderedDrive(SyntheticConfig(seed=seed, width=width, height=height, frame_count=frames)))
    specs: dict[str, str] = {}
    for label, (module, function, scheme, sequence) in WRITERS.items():
        root = folder / label.replace(", ", "-")
        try:
            write = getattr(importlib.import_module(module), function)
            write(root, {sequence: drive})
        except (ImportError, AttributeError, CableError) as error:
            specs[label] = f"({error})"
        else:
            specs[label] = f"{scheme}:{root}"
    specs["coco-video"] = f"coco-video:{folder / 'wod_zb' / 'annotations' / 'instances.json'}"
    specs["video, folder of the same JPEGs"] = f"video:{folder / 'wod_zb' / 'images' / NAME}"
    return specs


def render(readings: dict[str, Reading | str]) -> Table:
    """The table of all readings."""
    table = Table("reader", "picture", "frames", "boxes", "open ms", "fps", "CPU fps", "memory MB", "growth MB")
    for column in table.columns[2:]:
        column.justify = "right"
    for label, reading in readings.items():
        if isinstance(reading, str):
            table.add_row(label, "not read")
            continue
        table.add_row(
            label, f"{reading.width}x{reading.height}", str(reading.frames), str(reading.boxes),
            f"{reading.open_ms:.0f}", *(f"{fps:.0f}" if fps else "-" for fps in (reading.fps, reading.cpu_fps)),
            f"{reading.memory_mb:.0f}", f"{reading.growth_mb:.1f}",
        )  # fmt: skip
    return table


def shared_specs(shared: Path) -> dict[str, str]:
    """The real fragments of a folder that are there."""
    specs: dict[str, str] = {}
    for fragment in FRAGMENTS:
        scheme, _, rest = fragment.partition(":")
        if (shared / rest.partition("#")[0]).exists():
            specs[fragment] = f"{scheme}:{shared / rest}"
    return specs


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=24, help="of the rendered drive (default 24)")
    parser.add_argument("--size", default="1280x720", help="of the rendered drive (default 1280x720)")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--shared", type=Path, help="folder with fragments of real data sets")
    parser.add_argument("--spec", action="append", default=[], help="a data set of your own; repeatable")
    parser.add_argument("--skip-bad", action="store_true", help="leave damaged frames and rows out")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    if options.child is not None:
        try:
            print(json.dumps(asdict(measure(options.child, options.skip_bad))))
        except (CableError, ImportError) as error:
            raise SystemExit(str(error).splitlines()[0]) from error
        return

    width, _, height = options.size.partition("x")
    with tempfile.TemporaryDirectory(prefix="cable-rpc-readers-") as folder:
        specs = write_sets(Path(folder), options.frames, (int(width), int(height)), options.seed)
        specs |= shared_specs(options.shared) if options.shared is not None else {}
        specs |= {spec: spec for spec in options.spec}
        readings = {
            label: spec if spec.startswith("(") else measured_in_child(spec, options.skip_bad)
            for label, spec in specs.items()
        }
    console = Console(width=140, highlight=False)
    console.print(render(readings))
    for label, reading in readings.items():
        if isinstance(reading, str):
            console.print(f"{label}: {reading.strip('()')}", markup=False)


if __name__ == "__main__":
    main()
