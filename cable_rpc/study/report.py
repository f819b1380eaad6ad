"""One run as a single HTML file that needs no network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cable_rpc.study.language_table import PREFILL_COLUMNS, language_rows, prefill_rows, speedup_texts
from cable_rpc.study.report_page import Tile, in_script, jpeg_uri, render_page, study_extra_missing
from cable_rpc.study.run_record import (
    FRAMES_FILE,
    REPORT_FILE,
    STILLS_FOLDER,
    SUMMARY_FILE,
    VIDEO_FILE,
    RunInfo,
    read_frames,
    read_run_info,
    write_text,
)
from cable_rpc.study.summary import RunSummary, honesty_notes, summarise
from cable_rpc.study.summary_table import layer_label, percent, quality_rows, whole


@dataclass(frozen=True, slots=True)
class StillPair:
    """One frame as the camera saw it, annotated, and as the cloud received it."""

    index: int
    camera: str
    received: str


def write_report(run_dir: Path) -> Path:
    """Write ``report.html`` from the run's frames.csv, summary.json and stills.

    Returns:
        The file's path.

    Raises:
        ConfigurationError: the folder holds no run, or the ``study`` extra is not installed.
    """
    try:
        from cable_rpc.study.report_plots import plots_of
    except ImportError as error:
        raise study_extra_missing(error) from error
    records = read_frames(run_dir / FRAMES_FILE)
    info = read_run_info(run_dir / SUMMARY_FILE)
    summary = summarise(records, info)
    path = run_dir / REPORT_FILE
    text = render_page(
        "report.html.j2",
        title=f"{info.source} · {info.codec} {info.quality} · {info.strategy}",
        info=info,
        summary=summary,
        tiles=tiles_of(summary),
        layers=layer_rows(summary),
        quality=quality_rows(summary),
        language=[] if summary.language is None else language_rows(summary.language),
        prefill_columns=PREFILL_COLUMNS,
        prefill=prefill_rows(summary),
        notes=honesty_notes(summary),
        environment=environment_rows(info),
        plots=[(plot, in_script(plot.figure.to_json(engine="json"))) for plot in plots_of(records, info.fps)],
        stills=still_pairs(run_dir / STILLS_FOLDER),
        video=VIDEO_FILE if (run_dir / VIDEO_FILE).exists() else None,
    )
    write_text(path, text)
    return path


def tiles_of(summary: RunSummary) -> list[Tile]:
    """The figures that a reader asks for first."""
    message, end_to_end, quality = summary.layer("message"), summary.stage("end_to_end"), summary.quality
    tiles = [
        Tile("bytes saved", percent(message.byte_saving), "against the same frames whole, same codec and setting"),
        Tile("pixels not sent", percent(summary.pixel_saving), "a share of the picture, no measure of bytes"),
        Tile(
            "uplink",
            f"{whole(message.uplink_kbps)} kbit/s",
            f"{whole(message.uplink_bytes_per_frame)} bytes a frame at {summary.info.fps:g} fps",
        ),
    ]
    if end_to_end is not None:
        detail = f"p95 {end_to_end.p95_ms:.0f} ms, p99 {end_to_end.p99_ms:.0f} ms"
        tiles.append(Tile("end to end", f"{end_to_end.p50_ms:.0f} ms", f"median; {detail}"))
    stale = summary.staleness_mean_frames
    if stale is not None:
        tiles.append(Tile("age of the prior", f"{stale:.1f} frames", f"mean; largest {summary.staleness_max_frames}"))
    tiles.append(
        Tile(
            "detections kept",
            percent(quality.retention),
            f"of full-frame ones; {percent(quality.spurious_rate)} spurious",
        )
    )
    if quality.recognition:
        shares = dict(quality.recognition)
        detail = f"of the objects with half their box sent; {percent(shares.get(0.05))} at 5 %"
        tiles.append(Tile("recognised", percent(shares.get(0.5)), detail))
    if summary.language is not None and summary.language.of_run is not None:
        texts = [text.removesuffix(" ×") for text in speedup_texts(summary.language.of_run)]
        tiles.append(
            Tile("prefill, times faster", " / ".join(texts), "the paper's estimate / by operations / as measured")
        )
    return tiles


def layer_rows(summary: RunSummary) -> list[tuple[str, ...]]:
    """Bytes per frame and kbit/s by layer."""
    return [
        (
            layer_label(layer, summary.info.transport_source),
            whole(layer.uplink_bytes_per_frame),
            whole(layer.uplink_kbps),
            whole(layer.downlink_bytes_per_frame),
            whole(layer.downlink_kbps),
            whole(layer.full_frame_bytes_per_frame),
            percent(layer.byte_saving),
        )
        for layer in summary.layers
    ]


def environment_rows(info: RunInfo) -> list[tuple[str, str]]:
    """What was run, on what."""
    offset = "not measured"
    if info.clock_offset_ns is not None and info.clock_offset_error_ns is not None:
        offset = f"{info.clock_offset_ns / 1e6:.3f} ms ± {info.clock_offset_error_ns / 1e6:.3f} ms"
    rows = [
        ("source", f"{info.source}, {info.width}x{info.height}, {info.fps:g} fps"),
        ("codec", f"{info.codec}, {info.quality}"),
        ("strategy", f"{info.strategy}, {info.mode} mode, {info.pace}"),
        ("detector", info.detector),
        ("segmenter", info.segmenter),
        ("server", f"{info.server_target} ({info.server_version})"),
        ("server clock against edge clock", offset),
        ("started", info.started),
        ("command", info.command_line),
        ("versions", ", ".join(f"{name} {version}" for name, version in info.versions.items())),
    ]
    return [(name, value) for name, value in rows if value]


def still_pairs(folder: Path) -> list[StillPair]:
    """The stills that come in pairs, in order, embedded."""
    pairs = []
    for camera in sorted(folder.glob("*_camera.jpg")):
        received = camera.with_name(camera.name.replace("_camera", "_received"))
        if received.exists():
            pictures = (jpeg_uri(path.read_bytes()) for path in (camera, received))
            pairs.append(StillPair(int(camera.name.split("_")[0]), *pictures))
    return pairs
