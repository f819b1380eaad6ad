"""Bytes saved at equal quality: against a ladder coded and measured frame by frame, lines, and the ladder's ends."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from cable_codecs import CodecParameters, RegionTreatment, TreatedDecoder, create_decoder, create_encoder
from rich.console import Console
from test_tables_drawing import sequence
from test_tables_engine import cheap_models

from cable_rpc.data.source import open_source
from cable_rpc.edge.capture import CapturedFrame
from cable_rpc.study.closed_loop.lane import Lane, Passage
from cable_rpc.study.metrics import Bootstrap
from cable_rpc.study.tables.cells import Cell
from cable_rpc.study.tables.equal_quality import EqualQuality, Rung, pool_equal_quality
from cable_rpc.study.tables.ladder import ladder_crfs
from cable_rpc.study.tables.report import TableReport
from cable_rpc.study.tables.sequence_run import SequenceTask, run_sequence
from cable_rpc.study.tables.settings import RunSettings, SequenceRequest

SIZE = (320, 192)
SETTINGS = RunSettings(detector="tiles", segmenter="boxes", max_frames=6, size=SIZE)
REQUEST = SequenceRequest("synthetic", "synthetic:11")


def luma_of(image: np.ndarray) -> np.ndarray:
    """BT.601, rounded as 8-bit pictures are; int64."""
    return np.floor(image @ np.array([0.114, 0.587, 0.299]) + 0.5).astype(np.int64)


def test_a_cells_sums_are_those_of_a_ladder_coded_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the lanes sent is listened to; everything else is coded, decoded and measured anew."""
    sent: list[tuple[np.ndarray, Passage, bool]] = []
    carry = Lane.carry

    async def listening(lane: Lane, captured: CapturedFrame) -> Passage:
        passage = await carry(lane, captured)
        sent.append((captured.frame.image, passage, len(sent) % 2 == 0))
        return passage

    monkeypatch.setattr(Lane, "carry", listening)
    cell, full = run_sequence(SequenceTask(REQUEST, ("cable", "full-frame"), SETTINGS), cheap_models)
    assert cell.error == full.error == ""
    found = cell.equal_quality
    assert found is not None
    cable = [(image, passage) for image, passage, is_whole in sent if not is_whole]
    whole = [passage for _, passage, is_whole in sent if is_whole]
    regions = [passage.prepared.sent_region.pixels() for _, passage in cable]
    assert len(cable) == 6
    assert not all(region.all() for region in regions)

    fps = open_source("synthetic:11").fps
    parameters = CodecParameters("h264", *SIZE, fps)
    errors, sizes = [], []
    for rung in found.rungs:
        with create_encoder(replace(parameters, quality=rung.crf)) as encoder, create_decoder(parameters) as decoder:
            packets = [encoder.encode(image, None).data for image, _ in cable]
            pictures = [decoder.decode(packet) for packet in packets]
        errors.append(squared_error(cable, regions, pictures))
        sizes.append(sum(map(len, packets)))
    overhead = sum(one.prepared.uplink_message_bytes - len(one.prepared.encoded.data) for one in whole)
    assert [rung.crf for rung in found.rungs] == [16, 19, 22, 25, 28, 31, 34]
    # OpenCV's luma is in fixed point: a few pixels round the other way.
    assert [rung.squared_error for rung in found.rungs] == pytest.approx(errors, rel=0.01)
    # Lengths are variable-length numbers.
    assert [rung.bytes_up - overhead for rung in found.rungs] == pytest.approx(sizes, abs=4 * len(cable))

    receiver = TreatedDecoder(parameters, RegionTreatment.default_for(stateless=False))
    pictures = [
        receiver.decode(
            one.prepared.encoded.data,
            one.prepared.sent_region.blocks if one.prepared.message.HasField("region") else None,
            one.prepared.sent_region.block_size,
        ).image
        for _, one in cable
    ]
    receiver.close()
    own_error, pixels = squared_error(cable, regions, pictures), sum(int(region.sum()) for region in regions)
    assert found.squared_error == pytest.approx(own_error, rel=0.01)
    assert found.pixels == pixels
    assert found.bytes_up == sum(one.prepared.uplink_message_bytes for _, one in cable)

    qualities = 10 * np.log10(255**2 * pixels / np.array(errors))
    quality = 10 * np.log10(255**2 * pixels / own_error)
    straight = np.exp(np.interp(quality, qualities[::-1], np.log(np.array(sizes) + overhead)[::-1]))
    assert found.whole_bytes() == pytest.approx(straight, rel=0.03)
    pooled = pool_equal_quality([found])
    assert pooled.figure("byte_saving_equal_psnr").value == pytest.approx(1 - found.bytes_up / straight, abs=0.03)
    assert pooled.figure("roi_psnr_db").value == pytest.approx(quality, abs=0.05)
    assert pooled.figure("full_psnr_db").value == pytest.approx(qualities[4], abs=0.05)

    assert full.equal_quality is not None
    assert full.equal_quality.pixels == 6 * SIZE[0] * SIZE[1]
    assert pool_equal_quality([full.equal_quality]).figure("byte_saving_equal_psnr").value == 0.0


def squared_error(
    cable: list[tuple[np.ndarray, Passage]], regions: list[np.ndarray], pictures: list[np.ndarray]
) -> int:
    return sum(
        int(((luma_of(image) - luma_of(picture))[region] ** 2).sum())
        for (image, _), region, picture in zip(cable, regions, pictures, strict=True)
    )


def on_a_line(decibels: float, bytes_up: int, scale: int = 1) -> EqualQuality:
    """Whole frames of which 6 dB more cost twice the bytes: 1000 * scale at 30 dB, and a strategy beside them."""
    pixels = 10_000
    error_at = partial(error_of, pixels)
    rungs = tuple(Rung(28 - 4 * step, scale * 1000 * 2**step, error_at(30.0 + 6 * step)) for step in reversed(range(5)))
    return EqualQuality(pixels, error_at(decibels), bytes_up, 28, rungs)


def error_of(pixels: int, decibels: float) -> float:
    return pixels * 255.0**2 / 10.0 ** (decibels / 10.0)


def test_a_straight_curve_is_met_between_its_points() -> None:
    found = on_a_line(39.0, 1000)
    assert found.whole_bytes() == pytest.approx(1000 * 2**1.5)
    assert EqualQuality.from_json(found.to_json()) == found
    pooled = pool_equal_quality([found, None, on_a_line(36.0, 6000, scale=3)])
    assert pooled.saving().value == pytest.approx(1 - 7000 / (1000 * 2**1.5 + 6000))


def test_intervals_run_over_sequences() -> None:
    pooled = pool_equal_quality([on_a_line(36.0, size) for size in (500, 1000, 1500)], Bootstrap(draws=2000))
    estimate = pooled.figure("byte_saving_equal_psnr")
    assert estimate.value == pytest.approx(0.5)
    assert estimate.interval is not None
    # One draw in 27 has the same sequence three times.
    assert (estimate.interval.low, estimate.interval.high) == pytest.approx((0.25, 0.75))
    assert pool_equal_quality([on_a_line(36.0, 500)] * 2, Bootstrap()).saving().interval is None


@pytest.mark.parametrize("decibels", [29.9, 54.1])
def test_beyond_the_ladder_there_is_a_dash_and_a_note(decibels: float) -> None:
    beyond = on_a_line(decibels, 1000)
    assert beyond.whole_bytes() is None
    cells = [
        Cell(REQUEST, "cable", "drive", sequence([1.0, 0.2], keep=1, name="drive"), equal_quality=one)
        for one in (beyond, None)
    ]
    for cell, psnr in zip(cells, (f"{decibels}", "–"), strict=True):
        report = TableReport([cell], ("cable",), RunSettings())
        (row,) = report.tables[1].rows[:1]
        columns = {column.key: column for column in report.tables[1].columns}
        assert row.text(columns["byte_saving_equal_psnr"]) == "–"
        assert row.text(columns["roi_psnr_db"]) == psnr
        console = Console(width=120, file=io.StringIO())
        console.print(report.draw())
        assert ("drive (cable)" in console.file.getvalue()) == (psnr != "–")  # type: ignore[attr-defined]


def test_it_can_be_left_out() -> None:
    (cell,) = run_sequence(
        SequenceTask(REQUEST, ("full-frame",), replace(SETTINGS, equal_quality=False, max_frames=1)), cheap_models
    )
    assert cell.error == ""
    assert cell.equal_quality is None


def test_the_ladder_stays_within_the_codecs_lossy_range() -> None:
    assert ladder_crfs(28) == [16, 19, 22, 25, 28, 31, 34]
    assert ladder_crfs(4) == [1, 4, 7, 10]
    assert ladder_crfs(50) == [38, 41, 44, 47, 50, 51]
    assert ladder_crfs(0)[0] == 0
