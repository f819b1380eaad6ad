from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from rich.console import Console

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.annotate import AnnotatedVideoWriter, annotate
from cable_rpc.study.run_record import (
    FrameCsvWriter,
    FrameRecord,
    RunInfo,
    TransportSource,
    read_frames,
    read_run_info,
    write_frames,
)
from cable_rpc.study.summary import summarise, write_summary
from cable_rpc.study.summary_table import render_summary
from cable_rpc.types import Detections

INFO = RunInfo("clip", 640, 480, 10.0, "h264", "CRF 28", "cable", "paper", segmenter="boxes", notes=("a note",))


def record(index: int, **changes: object) -> FrameRecord:
    base = FrameRecord(
        index, index * 10**8, "answered", coverage=0.25, roi_coverage=0.25, staleness_frames=1,
        bitstream_bytes=1000, roi_bytes=50, uplink_message_bytes=1100, downlink_message_bytes=300, mask_bytes=100,
        roi_ns=2_000_000, encode_ns=5_000_000, end_to_end_ns=(index + 1) * 1_000_000,
        baseline_bitstream_bytes=4000, baseline_message_bytes=4050,
        retained=3, reference_count=4, spurious=1, truth_count=2, recognised=2, recognised_25=2, recognised_50=1,
        recognised_75=1, recognised_95=0, true_positives=1, false_positives=1, false_negatives=1,
    )  # fmt: skip
    return replace(base, **changes)  # type: ignore[arg-type]


RECORDS = [
    record(0, keyframe=True, idr=True, coverage=1.0, roi_coverage=None, staleness_frames=None, bitstream_bytes=4000,
           uplink_message_bytes=4050, roi_bytes=0),
    record(1),
    record(2, outcome="rejected", downlink_message_bytes=50, mask_bytes=0, end_to_end_ns=None),
    FrameRecord(3, 3 * 10**8, "dropped"),
    record(4),
]  # fmt: skip


def test_csv_round_trip_keeps_every_type(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    write_frames(path, RECORDS)
    assert read_frames(path) == RECORDS
    assert not list(tmp_path.glob("*.part"))


def test_csv_writer_leaves_a_whole_file_after_an_error(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    with pytest.raises(RuntimeError), FrameCsvWriter(path) as writer:
        writer.write(RECORDS[0])
        raise RuntimeError("the link broke")
    assert read_frames(path) == RECORDS[:1]


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [("answered", "answred", "column outcome"), (",1100,", ",many,", "column uplink"), ("keyframe", "kf", "keyframe")],
)
def test_damaged_csv_names_the_place(tmp_path: Path, before: str, after: str, said: str) -> None:
    path = tmp_path / "frames.csv"
    write_frames(path, RECORDS)
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(ConfigurationError, match=said):
        read_frames(path)


def test_summary_by_hand() -> None:
    summary = summarise(RECORDS, INFO)
    frames = summary.frames
    assert (frames.captured, frames.answered, frames.rejected, frames.dropped, frames.lost) == (5, 3, 1, 1, 0)
    assert summary.coverage_tx == pytest.approx((1 + 3 * 0.25) / 4)
    assert summary.pixel_saving == pytest.approx(1 - (1 + 3 * 0.25) / 4)
    assert summary.coverage_roi == pytest.approx(0.25)
    assert summary.keyframe_rate == pytest.approx(1 / 4)
    message = summary.layer("message")
    assert message.uplink_bytes_per_frame == pytest.approx((4050 + 3 * 1100) / 4)
    assert message.uplink_kbps == pytest.approx((4050 + 3 * 1100) * 8 / 1000 / (5 / 10.0))
    assert message.byte_saving == pytest.approx(1 - (4050 + 3 * 1100) / (4 * 4050))
    end_to_end = summary.stage("end_to_end")
    assert end_to_end is not None
    assert (end_to_end.frames, end_to_end.p50_ms) == (3, 2.0)
    assert summary.quality.retention == pytest.approx(0.75)
    assert summary.quality.spurious_rate == pytest.approx(4 / 16)
    assert dict(summary.quality.recognition)[0.5] == pytest.approx(0.5)
    assert summary.quality.micro is not None
    assert summary.quality.micro.recall == pytest.approx(0.5)


def test_estimated_transport_is_set_against_the_full_frame_by_the_same_formula() -> None:
    info = replace(INFO, transport_uplink_bytes=9_000, transport_downlink_bytes=4_000, transport_source="estimate")
    summary = summarise(RECORDS, info)
    transport = summary.layer("transport")
    assert transport.uplink_bytes_per_frame == pytest.approx(9_000 / 4)
    assert transport.downlink_bytes_per_frame == pytest.approx(4_000 / 4)
    # 4050 B take three packets, 1100 B one; the answer's acknowledgement and window update ride along.
    whole, region, back = 4050 + 14 + 3 * 52, 1100 + 14 + 52, 52 + 13
    assert transport.full_frame_bytes_per_frame == pytest.approx(whole + back)
    assert transport.byte_saving == pytest.approx(1 - (whole + 3 * region + 4 * back) / (4 * (whole + back)))


@pytest.mark.parametrize("source", ["measured", "estimate", "not measured"])
def test_transport_says_where_its_figure_is_from(source: TransportSource) -> None:
    known = source != "not measured"
    info = replace(INFO, transport_uplink_bytes=9_000 if known else None, transport_source=source)
    summary = summarise(RECORDS, info)
    assert (summary.layer("transport").byte_saving is None) == (source != "estimate")
    console = Console(width=100, file=io.StringIO(), record=True)
    console.print(render_summary(summary))
    text = console.export_text()
    assert f"transport ({source})" in text
    assert ("Transport bytes" in text) == known


def test_summary_of_nothing_and_without_baseline() -> None:
    nothing = summarise([], INFO)
    assert nothing.frames.captured == 0
    assert nothing.pixel_saving is None
    bare = summarise([FrameRecord(0, 0, "answered", bitstream_bytes=10, uplink_message_bytes=20)], INFO)
    assert bare.layer("message").byte_saving is None
    for summary in (nothing, bare):
        Console(width=100, record=True, quiet=True).print(render_summary(summary))


def test_closing_table_shows_both_savings_and_never_says_bandwidth() -> None:
    console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(render_summary(summarise(RECORDS, INFO)))
    text = console.export_text()
    assert "bytes saved 54.6 %" in text
    assert "pixels saved 56.2 %" in text
    assert "bandwidth" not in text.lower()
    assert max(map(len, text.splitlines())) <= 100


def run_folder(tmp_path: Path) -> Path:
    write_frames(tmp_path / "frames.csv", RECORDS)
    write_summary(tmp_path, summarise(RECORDS, INFO))
    (tmp_path / "stills").mkdir()
    for kind in ("camera", "received"):
        cv2.imwrite(str(tmp_path / "stills" / f"000001_{kind}.jpg"), np.full((40, 60, 3), 90, np.uint8))
    return tmp_path


def test_summary_file_describes_the_run(tmp_path: Path) -> None:
    assert read_run_info(run_folder(tmp_path) / "summary.json") == INFO


def test_report_is_one_file_that_loads_nothing(tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    from cable_rpc.study.report import write_report

    page = write_report(run_folder(tmp_path)).read_text()
    markup = re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!data:|annotated\.mp4)""", markup)
    assert "54.6 %" in markup
    assert "56.2 %" in markup
    assert "a note" in markup
    assert markup.count("data:image/jpeg;base64,") == 2
    for plot in ("bytes", "coverage", "latency", "stages", "quality"):
        assert f'Plotly.newPlot("plot-{plot}"' in page


def test_report_escapes_what_users_wrote(tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    from cable_rpc.study.report import write_report

    folder = run_folder(tmp_path)
    write_summary(folder, summarise(RECORDS, replace(INFO, source="<script>alert(1)</script>")))
    assert "<script>alert(1)" not in write_report(folder).read_text()


def test_report_of_no_run_says_so(tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    from cable_rpc.study.report import write_report

    with pytest.raises(ConfigurationError, match=r"frames\.csv can't be read"):
        write_report(tmp_path)


def test_annotated_video_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "annotated.mp4"
    image = np.random.default_rng(0).integers(0, 255, (61, 83, 3), np.uint8)
    roi = np.zeros((61, 83), np.bool_)
    roi[10:40, 10:60] = True
    boxes = Detections(np.array([[12, 12, 40, 30]], np.float32), np.array([2], np.int32), np.array([0.5], np.float32))
    with AnnotatedVideoWriter(path, 10.0) as video:
        for _ in range(7):
            drawn = annotate(image, roi=roi, mask=roi, detections=boxes, status=["frame"], keyframe=True)
            video.write(drawn, image)
    assert not list(tmp_path.glob("*.part"))
    with av.open(str(path)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 7


def test_interrupted_video_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "annotated.mp4"
    with pytest.raises(KeyboardInterrupt), AnnotatedVideoWriter(path, 10.0) as video:
        video.write(np.zeros((32, 32, 3), np.uint8))
        raise KeyboardInterrupt
    with av.open(str(path)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 1


def test_annotation_keeps_the_picture_inside_and_dims_outside() -> None:
    image = np.full((60, 80, 3), 200, np.uint8)
    roi = np.zeros((60, 80), np.bool_)
    roi[20:40, 20:60] = True
    drawn = annotate(image, roi=roi)
    assert (image == 200).all(), "the camera's picture was drawn on"
    assert (drawn[25:35, 25:55] == 200).all()
    assert (drawn[:10] < 120).all()
