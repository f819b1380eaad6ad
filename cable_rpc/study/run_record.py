"""What a run writes down: one flat record per captured frame, and one description of the run."""

from __future__ import annotations

import csv
import json
import os
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, Literal, TextIO, get_args, get_origin, get_type_hints

from cable_rpc.errors import ConfigurationError

Outcome = Literal["answered", "rejected", "dropped", "lost"]
TransportSource = Literal["measured", "estimate", "not measured"]

FRAMES_FILE = "frames.csv"
SUMMARY_FILE = "summary.json"
STILLS_FOLDER = "stills"
VIDEO_FILE = "annotated.mp4"
REPORT_FILE = "report.html"


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """Everything measured about one captured frame; None where it was not measured or can't exist."""

    index: int
    capture_time_ns: int
    outcome: Outcome
    """``answered``; ``rejected`` by the cloud; ``dropped`` at the edge, never sent; ``lost``: unanswered."""

    keyframe: bool = False
    """c_k: the frame was uploaded whole."""
    keyframe_reason: str = ""
    """What asked for it; empty on other frames."""
    idr: bool = False
    """The codec coded it without reference to earlier frames."""
    coverage: float | None = None
    """Share of pixels uploaded, 1.0 on keyframes."""
    roi_coverage: float | None = None
    """Share of pixels of R_k, also on keyframes; None where there is no prior yet."""
    staleness_frames: int | None = None
    """Age of the newest cloud mask when R_k was predicted; None without a prior."""

    bitstream_bytes: int = 0
    roi_bytes: int = 0
    uplink_message_bytes: int = 0
    """The whole serialised request."""
    downlink_message_bytes: int = 0
    """The whole serialised answer."""
    mask_bytes: int = 0
    """The mask's part of the answer."""

    capture_ns: int | None = None
    """Reading or rendering the frame, before its capture time stamp and outside ``end_to_end_ns``."""
    roi_ns: int | None = None
    fill_ns: int | None = None
    encode_ns: int | None = None
    uplink_ns: int | None = None
    """Send to receive, corrected by the clock offset; good to ``RunInfo.clock_offset_error_ns``."""
    queue_ns: int | None = None
    decode_ns: int | None = None
    detect_ns: int | None = None
    segment_ns: int | None = None
    segment_preprocess_ns: int | None = None
    """This and the next six are parts of ``segment_ns``, as the segmenter tells them."""
    segment_clip_ns: int | None = None
    segment_prefill_ns: int | None = None
    segment_decode_ns: int | None = None
    segment_sam_encoder_ns: int | None = None
    segment_mask_decoder_ns: int | None = None
    segment_postprocess_ns: int | None = None
    server_ns: int | None = None
    """Receive to send on the server: the queue and all work, and whatever lies between."""
    downlink_ns: int | None = None
    apply_ns: int | None = None
    end_to_end_ns: int | None = None
    """Frame in hand at the edge to its mask applied."""

    detection_count: int | None = None
    mask_coverage: float | None = None
    mask_confidence: float | None = None

    tokens_in: int | None = None
    """Visual tokens that entered the language model; None where the segmenter has none."""
    tokens_full: int | None = None
    """Visual tokens of the whole frame."""
    prompt_tokens: int | None = None
    """Tokens of the prompt besides them; None, like the next four, where the segmenter tells nothing of its prefill."""
    prefill_quadratic: float | None = None
    """Speed-up of the prefill by the paper's estimate; never to be shown without the other columns."""
    prefill_flops: float | None = None
    """Speed-up of the prefill by its operations."""
    prefill_ns: int | None = None
    """The prefill as measured."""
    prefill_whole_ns: int | None = None
    """The prefill of the same frame sent whole, as measured in the full-frame pass; without one, of whole frames that
    the server had seen; None = not yet."""
    decoding: str = ""
    """How the language model's answer came about; empty without one."""

    truth_count: int | None = None
    recognised: int | None = None
    """Truth objects whose box R_k covers by 5 % or more."""
    recognised_25: int | None = None
    recognised_50: int | None = None
    recognised_75: int | None = None
    recognised_95: int | None = None
    true_positives: int | None = None
    false_positives: int | None = None
    false_negatives: int | None = None
    reference_count: int | None = None
    """Detections on the full frame."""
    retained: int | None = None
    spurious: int | None = None
    roi_psnr_db: float | None = None

    baseline_bitstream_bytes: int | None = None
    """The same frame in a full-frame pass with the same codec and quality setting."""
    baseline_message_bytes: int | None = None


@dataclass(frozen=True, slots=True)
class RunInfo:
    """What was run, on what, with what."""

    source: str
    width: int
    height: int
    fps: float
    codec: str
    quality: str
    strategy: str
    mode: str
    prompt: str = ""
    pace: str = ""
    detector: str = ""
    segmenter: str = ""
    server_target: str = ""
    server_version: str = ""
    started: str = ""
    """Wall time, ISO 8601."""
    command_line: str = ""
    clock_offset_ns: int | None = None
    """Server clock minus edge clock."""
    clock_offset_error_ns: int | None = None
    """Bound on the error of the offset, and so of each one-way delay."""
    transport_uplink_bytes: int | None = None
    """The whole run at socket or interface level; None where not known."""
    transport_downlink_bytes: int | None = None
    transport_source: TransportSource = "not measured"
    versions: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file whole or not at all."""
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8", newline="\n")
    os.replace(part, path)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object whole or not at all."""
    write_text(path, json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


class FrameCsvWriter:
    """Context manager that writes records as they come; the file takes its name when the block ends, however.

    Rows already written survive a crash of the process in the ``.part`` file beside it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.part = path.with_name(path.name + ".part")
        self.file: TextIO | None = None

    def __enter__(self) -> FrameCsvWriter:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.file = self.part.open("w", encoding="utf-8", newline="", buffering=1)
        csv.writer(self.file, lineterminator="\n").writerow(entry.name for entry in fields(FrameRecord))
        return self

    def __exit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        traceback: types.TracebackType | None,
    ) -> None:
        if self.file is not None:
            self.file.close()
            self.file = None
            os.replace(self.part, self.path)

    def write(self, record: FrameRecord) -> None:
        """Add one row.

        Raises:
            ConfigurationError: The writer isn't open.
        """
        if self.file is None:
            raise ConfigurationError(f"{self.path} isn't open: use FrameCsvWriter in a with block")
        row = (cell_of(getattr(record, entry.name)) for entry in fields(FrameRecord))
        csv.writer(self.file, lineterminator="\n").writerow(row)


def write_frames(path: Path, records: Iterable[FrameRecord]) -> None:
    """Write all records as CSV, whole or not at all; an empty cell is None, booleans are 0 and 1."""
    with FrameCsvWriter(path) as writer:
        for record in records:
            writer.write(record)


def read_frames(path: Path) -> list[FrameRecord]:
    """Read the records that ``write_frames`` or ``FrameCsvWriter`` wrote.

    Raises:
        ConfigurationError: The file is absent, lacks a column, or holds a cell that can't be read.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file)
            missing = {entry.name for entry in fields(FrameRecord)} - set(reader.fieldnames or ())
            if missing:
                raise ConfigurationError(
                    f"{path} lacks the columns {', '.join(sorted(missing))}: another version wrote it"
                )
            return [record_of(row, path, reader.line_num) for row in reader]
    except OSError as error:
        raise ConfigurationError(f"{path} can't be read ({error.strerror}): name the folder of a run") from error


def read_run_info(path: Path) -> RunInfo:
    """Read the description of the run from a ``summary.json``.

    Raises:
        ConfigurationError: The file is absent, is not JSON, or does not describe a run.
    """
    try:
        run = dict(json.loads(path.read_text(encoding="utf-8"))["run"])
        known = {entry.name for entry in fields(RunInfo)}
        info = {name: value for name, value in run.items() if name in known}
        info["notes"] = tuple(info.get("notes", ()))
        return RunInfo(**info)
    except OSError as error:
        raise ConfigurationError(f"{path} can't be read ({error.strerror}): name the folder of a run") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(f"{path} does not describe a run: {error!r}") from error


def cell_of(value: object) -> str:
    """A field's value as it stands in the CSV file."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    return repr(float(value)) if isinstance(value, float) else str(value)


def record_of(row: Mapping[str, str | None], path: Path, line: int) -> FrameRecord:
    """The record of one CSV row.

    Raises:
        ConfigurationError: A cell can't be read as its column's type.
    """
    values: dict[str, Any] = {}
    for name, (kind, optional) in column_types().items():
        text = row[name]
        try:
            values[name] = None if optional and text == "" else value_of(text, kind)
        except ValueError as error:
            raise ConfigurationError(f"{path} line {line}, column {name}: {error}") from error
    return FrameRecord(**values)


def value_of(text: str | None, kind: Any) -> object:
    """A cell's text as bool, int, float or one of a Literal's words."""
    if text is None:
        raise ValueError("the row is cut short")
    if kind is bool:
        return bool(int(text))
    if get_origin(kind) is Literal:
        if text not in get_args(kind):
            raise ValueError(f"{text!r} is none of {', '.join(get_args(kind))}")
        return text
    return kind(text)


@cache
def column_types() -> dict[str, tuple[Any, bool]]:
    """Each column's type and whether it may be empty."""
    columns: dict[str, tuple[Any, bool]] = {}
    for name, hint in get_type_hints(FrameRecord).items():
        if isinstance(hint, types.UnionType):
            (kind,) = (part for part in get_args(hint) if part is not types.NoneType)
            columns[name] = (kind, True)
        else:
            columns[name] = (hint, False)
    return columns
