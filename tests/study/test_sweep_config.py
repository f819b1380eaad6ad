"""A sweep's configuration: the cells it stands for, counted by hand, and what it refuses."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cable_codecs import RegionTreatment
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.cli.sweep_flags import AxisFlags, SweepFlags, text_of_flags, text_with_flags
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.sweep.cell import RatePoint, SweepCell
from cable_rpc.study.sweep.config import SweepConfig, config_from_text, read_config
from cable_rpc.study.sweep.link_trace import read_trace
from cable_rpc.study.sweep.simulated_link import SimulatedLink

yaml = pytest.importorskip("yaml", reason="needs PyYAML, in the study extra")

TRACES = Path(__file__).resolve().parents[3] / "shared" / "data" / "network-traces"
EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
ONE = "sequences: [synthetic:1]\n"


def config_of(grids: list[dict[str, Any]], **others: Any) -> SweepConfig:
    return config_from_text(yaml.safe_dump({"sequences": ["synthetic:1"], **others, "grids": grids}), "a.yaml")


def seen(cell: SweepCell) -> tuple[Any, ...]:
    return (
        cell.clip.source, cell.clip.fps, cell.strategy, cell.treatment_label, cell.codec, cell.rate.label,
        cell.treatment.scale, cell.feedback_delay, cell.link and cell.link.name, cell.roi_label,
    )  # fmt: skip


def some(values: list[Any]) -> st.SearchStrategy[list[Any]]:
    return st.lists(st.sampled_from(values), min_size=1, max_size=len(values), unique=True)


AXES = st.fixed_dictionaries(
    {
        "sources": some(["synthetic:1", "synthetic:2", "video:a.mp4"]),
        "strategies": some(["cable", "no-corridor", "full-frame"]),
        "treatments": some(["frozen", "soft", "grey"]),
        "qualities": some([20, 28, 36]),
        "fps": some([5.0, 10.0]),
        "upload_scale": some([1.0, 0.5]),
        "feedback_delay": some([1, 2, 4]),
        "links": some(["none", "thin", "lte"]),
    }
)
TREATMENTS = {
    "frozen": RegionTreatment(fill="freeze", refill="diffuse"),
    "soft": RegionTreatment(fill="keep", quantiser_offset=0.4, refill="diffuse"),
    "grey": RegionTreatment(fill="grey", grid=16, refill="diffuse"),
}
SWITCHES = {"frozen": "", "soft": ":fill=keep,quantiser_offset=0.4", "grey": ":fill=grey,grid=16"}
LINKS = {
    "none": None,
    "thin": SimulatedLink("thin", uplink_kbps=1000, delay_ms=40),
    "lte": SimulatedLink("lte", uplink_kbps=5000),
}
LINK_SWITCHES = {"none": "", "thin": ":uplink_kbps=1000,delay_ms=40", "lte": ":uplink_kbps=5000"}


@settings(max_examples=20, deadline=None)
@given(AXES)
def test_options_make_the_product_of_their_axes(axes: dict[str, list[Any]]) -> None:
    """Options to text to cells, against the product written out; whole frames have no treatment and no delay."""
    flags = AxisFlags(
        data=axes["sources"],
        strategy=[",".join(axes["strategies"])],
        treatment=[label + SWITCHES[label] for label in axes["treatments"]],
        quality=[",".join(map(str, axes["qualities"]))],
        fps=[",".join(map(str, axes["fps"]))],
        upload_scale=[str(scale) for scale in axes["upload_scale"]],
        feedback_delay=[",".join(map(str, axes["feedback_delay"]))],
        link=[label + LINK_SWITCHES[label] for label in axes["links"]],
    )
    text = text_of_flags(SweepFlags(flags, {"max_frames": 7, "size": "320x192", "detector": "onnx:a.onnx"}))
    found = config_from_text(text, "options")
    assert found.text == text
    wanted = set()
    order = ("sources", "fps", "strategies", "treatments", "qualities", "upload_scale", "feedback_delay", "links")
    for source, fps, strategy, treatment, quality, scale, delay, link in itertools.product(*map(axes.get, order)):  # type: ignore[arg-type]
        whole = strategy == "full-frame"
        wanted.add(
            (source, fps, strategy, "default" if whole else treatment, "h264", f"q {quality}", scale,
             1 if whole else delay, None if link == "none" else link, "robust")
        )  # fmt: skip
    for source, fps, quality in itertools.product(axes["sources"], axes["fps"], axes["qualities"]):
        wanted.add((source, fps, "full-frame", "default", "h264", f"q {quality}", 1.0, 1, None, "robust"))
    assert Counter(map(seen, found.cells)) == Counter(wanted)
    for cell in found.cells:
        assert (cell.clip.max_frames, cell.clip.size, cell.clip.models.detector) == (7, (320, 192), "onnx:a.onnx")
        assert cell.link == LINKS["none" if cell.link is None else cell.link.name]
        if cell.strategy != "full-frame":
            assert replace(cell.treatment, scale=1.0) == TREATMENTS[cell.treatment_label]
    clips = [cell.clip for cell in found.cells]
    assert len([clip for clip, _ in itertools.groupby(clips)]) == len(set(clips))
    assert config_from_text(found.text, "again").cells == found.cells


def test_equal_cells_of_several_grids_are_one() -> None:
    grid = {"strategies": "cable", "codecs": {"h264": {"quality": [20, 24, 28, 32, 36]}}}
    labels_differ = {**grid, "treatments": {"mine": {"fill": "freeze"}}}
    overlapping = {**grid, "codecs": {"h264": {"quality": [36, 40]}}}
    assert len(config_of([grid]).cells) == 5 + 5
    assert config_of([grid, labels_differ]).cells == config_of([grid]).cells
    twice = config_of([{**grid, "treatments": {"a": {}, "b": {"fill": "freeze"}}}])
    assert len(twice.cells) == 10
    assert twice.notes == ("a.yaml: grids[0].treatments.b is for h264 the same as 'a', and is one with it",)
    assert len(config_of([grid, overlapping]).cells) == 6 + 6
    assert len(config_of([grid, {**grid, "strategies": "full-frame"}]).cells) == 10


def test_the_anchor_is_there_for_every_sequence_and_rate() -> None:
    grids = [
        {"codecs": {"webp": {"quality": [20, 50]}}, "fps": [5, None]},
        {"codecs": {"webp": {"quality": 80}}, "fps": 2},
    ]
    found = config_of(grids, sequences=["synthetic:1", "synthetic:2"])
    anchors = [cell for cell in found.cells if cell.strategy == "full-frame"]
    assert found.anchor == "full-frame · h264"
    assert Counter((cell.clip.source, cell.clip.fps) for cell in anchors) == {
        (source, fps): 7 for source in ("synthetic:1", "synthetic:2") for fps in (5, None, 2)
    }
    assert {cell.rate for cell in anchors} == {RatePoint(crf) for crf in (20, 24, 28, 32, 36, 40, 44)}
    other = config_of(grids[:1], anchor={"strategy": "cable", "codec": "hevc", "quality": [30, 20]})
    assert other.anchor == "cable · default · hevc"
    assert [note for note in other.notes if "the anchor has 2 points; a BD-rate needs 5" in note]


def test_codecs_take_lists_and_rates() -> None:
    found = config_of([{"codecs": ["vp9", "webp-lossless"]}], anchor={"quality": [20, 25, 30, 35, 40]})
    rates = {codec: [cell.rate for cell in found.cells if cell.codec == codec] for codec in ("vp9", "webp-lossless")}
    assert rates == {"vp9": [RatePoint(q) for q in (20, 30, 40, 50, 60)], "webp-lossless": [RatePoint()]}
    both = config_of([{"codecs": {"h264": {"quality": 30, "bitrate_kbps": [300, 600]}}}])
    cable = [cell.rate for cell in both.cells if cell.strategy == "cable"]
    assert cable == [RatePoint(30), RatePoint(bitrate_kbps=300), RatePoint(bitrate_kbps=600)]


def test_what_a_codec_cannot_carry_is_left_out_and_told() -> None:
    treatments = {
        "plain": {},
        "soft": {"fill": "keep", "quantiser_offset": 0.4},
        "still": {"fill": "freeze", "crop": "none", "grid": 16},
    }
    found = config_of([{"treatments": treatments, "codecs": ["h264", "jpeg", "av1"]}])
    assert {(cell.codec, cell.treatment_label) for cell in found.cells if cell.strategy == "cable"} == {
        ("h264", "plain"), ("h264", "soft"), ("h264", "still"), ("jpeg", "plain"), ("av1", "plain"), ("av1", "still"),
    }  # fmt: skip
    assert len(found.notes) == 3
    assert all("is left out for" in note for note in found.notes)
    del treatments["plain"]
    with pytest.raises(ConfigurationError, match=r"grids\[0\].treatments has nothing that jpeg can carry"):
        config_of([{"treatments": treatments, "codecs": ["h264", "jpeg"]}])


def test_roi_settings_are_an_axis() -> None:
    found = config_of([{}], rois={"robust": {}, "paper": {"mode": "paper"}, "wide": {"top_margin": 0.3}})
    by_label = {cell.roi_label: cell.roi for cell in found.cells if cell.strategy == "cable"}
    assert by_label == {"robust": RoiConfig(), "paper": RoiConfig.paper(), "wide": RoiConfig(top_margin=0.3)}
    one = config_of([{}], roi={"mode": "paper"})
    assert {cell.roi_label for cell in one.cells if cell.strategy == "cable"} == {"paper"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (ONE + "grids: [{codecs: {h264: {quality: [20, 99]}}}]", "a.yaml:2: grids[0].codecs.h264.quality[1] is 99;"),
        (ONE + "grids:\n- {}\n- codecs:\n    h264: {quality: yes}", "a.yaml:5: grids[1].codecs.h264.quality is True;"),
        (ONE + "grids: [{strategy: cable}]", "grids[0].strategy is unknown; did you mean strategies? known"),
        (ONE + "grids: [{strategies: cabel}]", "grids[0].strategies is 'cabel'; give one of cable, no-corridor"),
        (ONE + "grids: [{codecs: {h265: {}}}]", "grids[0].codecs.h265 is unknown; did you mean h264?"),
        (ONE + "grids: [{codecs: {webp-lossless: {bitrate_kbps: 5}}}]", "has no meaning for webp-lossless"),
        (ONE + "grids: [{upload_scale: .nan}]", "grids[0].upload_scale is nan; give a finite number of 0.0625..1"),
        (ONE + "grids: [{feedback_delay: [1, 0]}]", "grids[0].feedback_delay[1] is 0; give a whole number of 1..1000"),
        (ONE + "grids: [{fps: []}]", "grids[0].fps is empty; leave it out or give at least one value"),
        (ONE + "grids: [{treatments: {soft: {fill: foggy}}}]", "grids[0].treatments.soft.fill is 'foggy'; give one of"),
        (ONE + "grids: [{treatments: {soft: {grid: 99}}}]", "treatments.soft can't be used: the region's grid must"),
        (ONE + "grids: [{treatments: {half: {scale: 0.5}}}]", "half.scale is an axis of its own; give it as"),
        (ONE + "grids: [{links: {thin: {}}}]", "links.thin can't be used: link 'thin' needs uplink"),
        (ONE + "grids: [{links: {thin: {uplink_kbps: .inf}}}]", "links.thin.uplink_kbps is inf; give a finite number"),
        (ONE + "grids: [{links: {lte: {trace: no.mahi}}}]", "can't read the trace no.mahi: No such file"),
        (ONE + "grids: [{links: {lte: {seconds: 3}}}]", "grids[0].links.lte has seconds without a trace"),
        (ONE + "grids: [{}]\ngrids: [{}]", "a.yaml:3: grids was given in line 2 already; keep one"),
        (ONE + "roi: {top_margin: 3}\ngrids: [{}]", "a.yaml:2: roi can't be used: RoiConfig.top_margin is 3.0"),
        (ONE + "roi: {}\nrois: {}\ngrids: [{}]", "rois stands beside 'roi'; keep one of them"),
        (ONE + "size: 960\ngrids: [{}]", "a.yaml:2: size is 960; give WIDTHxHEIGHT"),
        (ONE + "truth: maybe\ngrids: [{}]", "truth is 'maybe'; give one of auto, annotated, detector"),
        (ONE + "name: ../x\ngrids: [{}]", "name is '../x'; give 1..60 letters"),
        (ONE + "grids: [{}]\nreport: {qualities: [beauty]}", "report.qualities[0] is 'beauty'; give one of retention,"),
        (ONE + "grids: [{}, {treatments: {default: {grid: 16}}}]", "'synthetic:1, cable · default · h264, q 18'"),
        ("sequences: [carla:town]\ngrids: [{}]", "a.yaml:1: sequences[0] can't be used: 'carla:town' is no source"),
        ("grids: [{}]", "'sequences' is missing"),
        (ONE, "'grids' is missing"),
        (ONE + "1: 2\ngrids: [{}]", "has the key 1, which YAML takes for no text; put it in quotes"),
        ("- 1", "a sweep's configuration is a mapping of keys"),
        ("a: [", "a.yaml:1: this is no YAML"),
        ("&a sequences: &b [*b]\ngrids: [{}]", "sequences[0] is [[[...]]]; give a text"),
        ("[" * 500, "a.yaml: this is no usable YAML"),
    ],
)  # fmt: skip
def test_errors_say_where_and_what_is_allowed(text: str, said: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        config_from_text(text, "a.yaml")
    assert said in str(raised.value)
    assert str(raised.value).startswith("a.yaml")


def test_too_many_cells_are_counted_and_refused() -> None:
    grid = {"strategies": ["cable", "full-frame"], "codecs": {"h264": {"quality": list(range(50))}}}
    axes = {"feedback_delay": list(range(1, 201)), "upload_scale": [1, 0.5, 0.25], "fps": [5, 10, 20, 25]}
    with pytest.raises(ConfigurationError, match=f"make {(50 * 200 + 50) * 3 * 4} cells, at most 100000 are run"):
        config_of([{**grid, **axes}])


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (AxisFlags(), "needs a configuration, or --data"),
        (AxisFlags(["synthetic:1"], quality=["webp=3"]), "--quality 'webp=3': there is no --codec webp; add it"),
        (AxisFlags(["synthetic:1"], codec=["jpeg", "webp"], quality=["3"]), "write CODEC=A,B,C for each of jpeg, webp"),
        (AxisFlags(["synthetic:1"], codec=["jpeg"], bitrate=["300"]), "--bitrate '300': needs a video codec"),
        (AxisFlags(["synthetic:1"], treatment=[":fill=keep"]), "':fill=keep': write LABEL or LABEL:KEY=VALUE"),
        (AxisFlags(["synthetic:1"], link=["thin:fast"]), "--link 'fast': write KEY=VALUE"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_misused_options_are_told(flags: AxisFlags, said: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        text_of_flags(SweepFlags(flags))
    assert said in str(raised.value)


def test_options_replace_single_keys_of_a_file_only() -> None:
    text = ONE + "max_frames: 60  # many\ngrids: [{codecs: h264}]"
    assert text_with_flags(text, "a.yaml", SweepFlags()) == text
    changed = text_with_flags(text, "a.yaml", SweepFlags(scalars={"max_frames": 5, "detector": "onnx:b.onnx"}))
    (clip,) = {cell.clip for cell in config_from_text(changed, "a.yaml").cells}
    assert (clip.max_frames, clip.models.detector, clip.source) == (5, "onnx:b.onnx", "synthetic:1")
    with pytest.raises(ConfigurationError, match=r"--upload-scale: a.yaml holds the axes"):
        text_with_flags(text, "a.yaml", SweepFlags(AxisFlags(upload_scale=["1"])))


def test_a_sweep_without_a_name_is_called_as_its_file(tmp_path: Path) -> None:
    path = tmp_path / "my sweep.yaml"
    path.write_text(ONE + "grids: [{}]")
    assert read_config(path).name == "my-sweep"
    with pytest.raises(ConfigurationError, match="can't read the sweep's configuration"):
        read_config(tmp_path / "none.yaml")


@pytest.mark.parametrize("name", ["real-clips", "rendered-drives", "codecs", "feedback-delay"])
def test_the_configurations_of_the_study_are_valid(name: str) -> None:
    config = read_config(EXAMPLES.parent / "study" / f"{name}.yaml")
    assert config.name == name
    assert any(cell.method.startswith(config.anchor) for cell in config.cells)


@pytest.mark.parametrize(("name", "cells"), [("rendered", 3 * 3 * 5), ("links", 3 * (5 + 2 * 5 * 2 + 2 * 3 * 2))])
def test_the_documented_examples_are_valid(name: str, cells: int) -> None:
    found = read_config(EXAMPLES / f"{name}.yaml")
    assert (found.name, len(found.cells), found.notes) == (name, cells, ())


def test_a_table_of_constant_rate_gives_packets_of_equal_distance(tmp_path: Path) -> None:
    """1200 kbit/s are 100 packets of 12 kbit each second; a second at half the rate has half of them."""
    path = tmp_path / "trace.csv"
    stamps = ["2020.02.27_20.59.58", "2020.02.27_20.59.59", "2020.02.27_20.59.59", "2020.02.27_21.00.00"]
    path.write_text(
        "Timestamp,DL_bitrate\n" + "".join(f"{s},{r}\n" for s, r in zip(stamps, (1200, 400, 800, 0), strict=True))
    )
    first, second = list(range(10, 1001, 10)), list(range(1020, 2001, 20))
    assert read_trace(path, "DL_bitrate") == pytest.approx(first + second, abs=1)
    assert read_trace(path, "DL_bitrate", 1, 1) == pytest.approx([time - 1000 for time in second[:-1]], abs=1)
    with pytest.raises(ConfigurationError, match="no packet can leave between 2 s and 3 s"):
        read_trace(path, "DL_bitrate", 2, 1)
    with pytest.raises(ConfigurationError, match="name its column"):
        read_trace(path)
    with pytest.raises(ConfigurationError, match="there is no column 'UL'; there are Timestamp, DL_bitrate"):
        read_trace(path, "UL")


@pytest.mark.skipif(not TRACES.is_dir(), reason="needs the shared network traces")
def test_recorded_traces_have_their_published_rates() -> None:
    times = read_trace(TRACES / "mahimahi" / "ATT-LTE-driving.up")
    assert len(times) * 12 / times[-1] == pytest.approx(0.83, abs=0.005)
    part = read_trace(TRACES / "mahimahi" / "ATT-LTE-driving.up", start_s=100, seconds=50)
    assert part == [time - 100_000 for time in times if 100_000 <= time < 150_000]
    with pytest.raises(ConfigurationError, match="more than 100000 packets could leave; choose a part"):
        read_trace(TRACES / "mahimahi" / "TMobile-LTE-short.up")
    with pytest.raises(ConfigurationError, match=r"SOURCE.md:1: '# network-traces"):
        read_trace(TRACES / "SOURCE.md")
    table = read_trace(TRACES / "5g-driving" / "B_2020.02.14_12.58.17.csv", "DL_bitrate", seconds=100)
    assert 0 <= table[0] <= table[-1] < 100_000
