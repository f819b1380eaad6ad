"""nuScenes' tables: reading in pieces and by search, damage, wrong requests."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.cuboids import Cuboid
from cable_rpc.data.nuscenes import open_nuscenes, sequences, write_nuscenes
from cable_rpc.data.nuscenes import selection as selection_module
from cable_rpc.data.nuscenes.can_bus import CanMotion, read_can_motion
from cable_rpc.data.nuscenes.selection import rows_where, scanned
from cable_rpc.data.nuscenes.tables import RowReader, read_rows
from cable_rpc.data.poses import rigid
from cable_rpc.data.rendered_drive import DriveFrame
from cable_rpc.data.source import SourceOptions
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.types import CameraIntrinsics, EgoMotion, Frame, GroundTruth

PLAIN = SourceOptions()
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def drive(frames: int) -> list[DriveFrame]:
    """8 m/s straight ahead at 10 Hz behind two cars, grey pictures that get lighter."""
    cuboids = tuple(Cuboid((12.0, y, 1.0), (4.0, 2.0, 1.5), 0.0, 2, track) for track, y in ((1, 2.0), (2, -2.0)))
    truth = GroundTruth(
        np.zeros((2, 4), np.float32), np.full(2, 2, np.int32), np.array([1, 2], np.int32), np.ones(2, np.float32)
    )
    camera = CameraIntrinsics(50.0, 50.0, 31.5, 15.5)
    return [
        DriveFrame(
            Frame(np.full((32, 64, 3), 20 * i, np.uint8), i, i * 100_000_000, EgoMotion(8.0), camera, truth),
            rigid(np.eye(3), (0.8 * i, 0.0, 0.0)),
            rigid(OPTICAL, (1.0, 0.0, 1.5)),
            cuboids,
        )
        for i in range(frames)
    ]


@pytest.fixture(scope="module")
def pristine(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("tables")
    write_nuscenes(root, {"scene-0001": drive(9), "scene-0002": drive(5)}, keyframe_every=4)
    return root


@pytest.fixture
def copy(pristine: Path, tmp_path: Path) -> Path:
    shutil.copytree(pristine, tmp_path, dirs_exist_ok=True)
    return tmp_path


def edit(root: Path, table: str, change) -> Path:
    """Apply a change to a table's rows."""
    path = root / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    path.write_text(json.dumps(change(rows) or rows))
    return path


def skipping() -> SourceOptions:
    return SourceOptions(bad_frames=BadFrames(skip=True))


rows_of_any_shape = st.lists(
    st.dictionaries(st.text(max_size=5), st.none() | st.floats(allow_nan=False) | st.text(max_size=8), max_size=4),
    max_size=8,
)


@settings(max_examples=40, deadline=None)
@given(rows_of_any_shape, st.integers(1, 40), st.sampled_from([None, 0, 2]), st.booleans())
def test_pieces_of_any_size_give_the_rows(rows, size: int, indent: int | None, ascii_only: bool) -> None:
    text = json.dumps(rows, indent=indent, ensure_ascii=ascii_only)
    reader = RowReader(Path("t.json"))
    reader.feed(text[:1])
    reader.at = 1
    found = list(reader.complete())
    for start in range(1, len(text), size):
        reader.feed(text[start : start + size])
        found += reader.complete()
    assert [row.values for row in found] == rows
    assert [row.place for row in found] == [f"t.json [{index}]" for index in range(len(rows))]


@pytest.mark.parametrize("indent", [None, 0, 1])
def test_search_finds_what_parsing_finds(tmp_path: Path, indent: int | None) -> None:
    path = tmp_path / "sample_data.json"
    rows = [
        {"token": f"é{i}", "sample_token": f"s{i % 5}", "numbers": [i, [i]], "prev": "s1", "next": ""}
        for i in range(40)
    ]
    path.write_text(json.dumps(rows, indent=indent, ensure_ascii=False), encoding="utf-8")
    found = scanned(path, "sample_token", {"s1", "s3"})
    parsed = [row for row in read_rows(path) if row.token("sample_token") in ("s1", "s3")]
    assert found == parsed
    assert len(parsed) == 16
    assert scanned(path, "token", {"é7"})[0].values == rows[7]
    assert scanned(path, "sample_token", set()) == []


@pytest.mark.parametrize(
    "text",
    [
        '[{"info": {"a": 1}, "token": "x"}]',
        '[{"token": "x", "info": {"a": 1}}]',
        '[{"token": "x", "name": "brace } in a text"}]',
        '[{"inner": {"token": "x"}, "token": "y"}]',
    ],
)
def test_search_leaves_what_is_not_flat_to_the_parser(tmp_path: Path, monkeypatch, text: str) -> None:
    path = tmp_path / "t.json"
    path.write_text(text)
    monkeypatch.setattr(selection_module, "SCANNED_BYTES", 1)
    expected = [row for row in json.loads(text) if row["token"] in {"x"}]
    assert [row.values for row in rows_where(path, "token", {"x"})] == expected


def test_the_order_of_rows_does_not_matter(copy: Path) -> None:
    for table in ("sample_data", "sample", "ego_pose"):
        edit(copy, table, lambda rows: rows[::-1])
    frames = list(open_nuscenes(f"{copy}#scene-0001?boxes=interpolate", PLAIN))
    assert np.diff([frame.capture_time_ns for frame in frames]).tolist() == [100_000_000] * 8
    assert [round(float(frame.image.mean()) / 20) for frame in frames] == list(range(9))
    assert all(len(frame.truth) == 2 for frame in frames)


def test_whole_scenes_are_the_same_by_search(pristine: Path, monkeypatch) -> None:
    parsed = list(open_nuscenes(f"{pristine}#scene-0002", PLAIN))
    monkeypatch.setattr(selection_module, "SCANNED_BYTES", 1)
    searched = list(open_nuscenes(f"{pristine}#scene-0002", PLAIN))
    assert len(parsed) == len(searched) == 5
    for one, two in zip(parsed, searched, strict=True):
        assert (one.capture_time_ns, one.ego) == (two.capture_time_ns, two.ego)
        assert (one.truth is None) == (two.truth is None)
        assert one.truth is None or np.array_equal(one.truth.boxes_xyxy, two.truth.boxes_xyxy)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", r"line 1, row \[0\]: a table begins with"),
        ('{"token": "a"}', r"line 1, row \[0\]: a table begins with"),
        ('[\n{"token": "a"},\n{"tok', r"line 3, row \[1\]"),
        ('[\n{"token": "a"},\n{"token": nope}]', r"line 3, row \[1\]"),
        ('[\n{"token": "a"}\n', r"the closing '\]' is missing"),
        ("[1, 2]", r"row \[0\]: 1 is no object"),
    ],
)
def test_damaged_tables(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "t.json"
    path.write_text(content)
    with pytest.raises(SourceError, match=message):
        list(read_rows(path))
    path.write_bytes(b'[{"token": "\xff"}]')
    with pytest.raises(SourceError, match=r"t\.json isn't JSON"):
        list(read_rows(path))


def test_a_cut_off_table_is_told_by_search_too(copy: Path, monkeypatch) -> None:
    monkeypatch.setattr(selection_module, "SCANNED_BYTES", 1)
    path = copy / "v1.0-mini" / "sample_data.json"
    path.write_text(path.read_text()[:-200])
    with pytest.raises(SourceError, match=r"sample_data\.json line \d+, row \[13\]: .*cut off"):
        open_nuscenes(f"{copy}#scene-0001", PLAIN)


def test_versions(copy: Path) -> None:
    shutil.copytree(copy / "v1.0-mini", copy / "v1.0-trainval")
    with pytest.raises(ConfigurationError, match=r"v1\.0-mini, v1\.0-trainval; add \?version=v1\.0-mini"):
        open_nuscenes(f"{copy}#scene-0001", PLAIN)
    assert open_nuscenes(f"{copy}#scene-0001?version=v1.0-trainval", PLAIN).frame_count == 9
    with pytest.raises(ConfigurationError, match=r"no version 'v1\.0-test'"):
        open_nuscenes(f"{copy}#scene-0001?version=v1.0-test", PLAIN)
    with pytest.raises(ConfigurationError, match=r"v1\.0-mini, v1\.0-trainval; .*, or give .*/v1\.0-mini"):
        sequences(copy)


def test_a_versions_own_folder_is_a_root(copy: Path) -> None:
    shutil.copytree(copy / "v1.0-mini", copy / "v1.0-trainval")
    edit(copy, "scene", lambda rows: rows[:-1])
    kept = json.loads((copy / "v1.0-mini" / "scene.json").read_text())
    assert sequences(copy / "v1.0-mini") == [kept[0]["name"]]
    assert sequences(copy / "v1.0-trainval") == ["scene-0001", "scene-0002"]
    assert [frame.index for frame in open_nuscenes(f"{copy}/v1.0-mini", PLAIN)] == list(range(9))
    with pytest.raises(ConfigurationError, match=r"no version 'v1\.0-mini'"):
        open_nuscenes(f"{copy}/v1.0-trainval#scene-0001?version=v1.0-mini", PLAIN)


@pytest.mark.parametrize(
    ("rest", "message"),
    [
        ("", "has 2 sequences; add #SEQUENCE, one of 'scene-0001', 'scene-0002'"),
        ("#scene-0003", "no sequence 'scene-0003'; use one of 'scene-0001', 'scene-0002'"),
        ("#scene-0001?camera=CAM_BACK", "no camera 'CAM_BACK'; it has CAM_FRONT"),
        ("#scene-0001?boxes=all", "boxes is 'all'; use keyframes or interpolate"),
        ("#scene-0001?ego=imu", "ego is 'imu'; use pose or can"),
        ("#scene-0001?speed=1", "known are version, camera, boxes, ego, frames"),
        ("#scene-0001?ego=can&ego=can", "give ego once"),
        ("#scene-0001?ego", "write key=value"),
    ],
)
def test_wrong_requests(pristine: Path, rest: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        open_nuscenes(f"{pristine}{rest}", PLAIN)
    assert message in str(caught.value)


def test_no_root(tmp_path: Path, pristine: Path) -> None:
    with pytest.raises(SourceError, match=r"no such folder: .*/nowhere; nuScenes can be had at https://www\.nuscenes"):
        open_nuscenes(f"{tmp_path}/nowhere#scene-0001", PLAIN)
    with pytest.raises(SourceError, match=r"holds no v1\.0-\*/scene\.json"):
        sequences(tmp_path)
    with pytest.raises(ConfigurationError, match="names no file or folder"):
        open_nuscenes("#scene-0001", PLAIN)
    with pytest.raises(ConfigurationError, match="leave ego_csv, intrinsics and mount out"):
        open_nuscenes(f"{pristine}#scene-0001", SourceOptions(intrinsics=CameraIntrinsics(1.0, 1.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    "table", ["calibrated_sensor", "sensor", "sample", "sample_data", "ego_pose", "sample_annotation", "instance"]
)
def test_missing_tables_are_never_skipped(copy: Path, table: str) -> None:
    (copy / "v1.0-mini" / f"{table}.json").unlink()
    with pytest.raises(SourceError, match=rf"{table}\.json is missing; .*https://www\.nuscenes\.org"):
        open_nuscenes(f"{copy}#scene-0001", skipping())


def test_missing_or_bad_calibration(copy: Path) -> None:
    path = edit(copy, "calibrated_sensor", lambda rows: rows[1:])
    with pytest.raises(
        SourceError, match=r"calibrated_sensor\.json has no row '\w{32}', which .*sample_data\.json \[0\]"
    ):
        open_nuscenes(f"{copy}#scene-0001", skipping())
    assert open_nuscenes(f"{copy}#scene-0002", PLAIN).frame_count == 5
    path.write_text(path.read_text().replace('"camera_intrinsic": [[50.0', '"camera_intrinsic": [["50"'))
    with pytest.raises(SourceError, match=r"calibrated_sensor\.json \[0\]: camera_intrinsic\[0\] is \['50'"):
        open_nuscenes(f"{copy}#scene-0002", skipping())
    edit(copy, "calibrated_sensor", lambda rows: [{**rows[0], "camera_intrinsic": []}])
    with pytest.raises(SourceError, match=r"\[0\]: camera_intrinsic is \[\]; a camera has 3 rows"):
        open_nuscenes(f"{copy}#scene-0002", skipping())


def test_damaged_images(copy: Path) -> None:
    files = sorted((copy / "sweeps").glob("*/scene-0001*"))
    files[1].write_bytes(files[1].read_bytes()[:-20])
    files[2].unlink()
    source = open_nuscenes(f"{copy}#scene-0001", PLAIN)
    with pytest.raises(SourceError, match=f"{files[1].name}: the image is cut off"):
        list(source)
    options = skipping()
    frames = list(open_nuscenes(f"{copy}#scene-0001", options))
    assert [frame.index for frame in frames] == list(range(7))
    # The second and third of three sweeps after the first keyframe, at 200 and 300 ms.
    assert [(frame.capture_time_ns - frames[0].capture_time_ns) // 100_000_000 for frame in frames] == [
        0, 1, 4, 5, 6, 7, 8,
    ]  # fmt: skip
    assert [files[1].name in options.bad_frames.skipped[0], files[2].name in options.bad_frames.skipped[1]] == [
        True
    ] * 2


def test_an_image_of_another_size(copy: Path) -> None:
    edit(copy, "sample_data", lambda rows: [{**row, "width": 65} for row in rows])
    with pytest.raises(SourceError, match=r"\.jpg is 64x32, but its row in sample_data\.json says 65x32"):
        list(open_nuscenes(f"{copy}#scene-0001", PLAIN))


@pytest.mark.parametrize(
    ("table", "row", "values", "message"),
    [
        ("sample_data", 2, {"timestamp": "late"}, r"sample_data\.json \[2\]: timestamp is 'late'"),
        ("sample_data", 2, {"height": 0}, r"sample_data\.json \[2\]: height is 0"),
        ("sample_data", 2, {"filename": None}, r"sample_data\.json \[2\]: filename is None"),
        ("ego_pose", 2, {"rotation": [0, 0, 0, 0]}, r"ego_pose\.json \[2\]: \[0\.0, 0\.0, 0\.0, 0\.0\] is no rotation"),
        ("ego_pose", 2, {"translation": [1, 2]}, r"ego_pose\.json \[2\]: translation is \[1, 2\]"),
        ("ego_pose", 2, {"token": "gone"}, r"ego_pose\.json has no row '\w{32}', which .*sample_data\.json \[2\]"),
    ],
)
def test_a_bad_row_costs_its_frame(copy: Path, table: str, row: int, values: dict, message: str) -> None:
    edit(copy, table, lambda rows: rows[row].update(values))
    with pytest.raises(SourceError, match=message):
        open_nuscenes(f"{copy}#scene-0001", PLAIN)
    options = skipping()
    frames = list(open_nuscenes(f"{copy}#scene-0001", options))
    assert [frame.index for frame in frames] == list(range(8))
    assert len(options.bad_frames.skipped) == 1
    assert frames[2].ego.speed_mps == pytest.approx(8.0)


def test_two_images_of_one_time(copy: Path) -> None:
    edit(copy, "sample_data", lambda rows: rows[2].update(timestamp=rows[1]["timestamp"]))
    with pytest.raises(SourceError, match=r"sample_data\.json \[2\]: .*jpg has the time of .*jpg"):
        open_nuscenes(f"{copy}#scene-0001", PLAIN)


def test_no_usable_image(copy: Path) -> None:
    edit(copy, "sample_data", lambda rows: [{**row, "is_key_frame": False} for row in rows])
    with pytest.raises(SourceError, match="scene 'scene-0001' has no keyframe of CAM_FRONT"):
        open_nuscenes(f"{copy}#scene-0001?frames=keyframes", PLAIN)
    edit(copy, "sample_data", lambda rows: [{**row, "timestamp": None} for row in rows])
    with pytest.raises(SourceError, match=r"has no image of CAM_FRONT in scene 'scene-0001' that can be used"):
        open_nuscenes(f"{copy}#scene-0001", skipping())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"size": [2.0, -4.0, 1.5]}, r"sample_annotation\.json \[1\]: size is \[2\.0, -4\.0, 1\.5\]"),
        ({"translation": ["x", 0, 0]}, r"sample_annotation\.json \[1\]: translation is \['x'"),
        ({"rotation": [1.0]}, r"sample_annotation\.json \[1\]: rotation is \[1\.0\]"),
        ({"visibility_token": "9"}, r"sample_annotation\.json \[1\]: visibility_token '9' is none of v0-40"),
        ({"instance_token": "who"}, r"sample_annotation\.json \[1\]: no instance 'who' with a known category"),
    ],
)
def test_a_bad_annotation_costs_its_box(copy: Path, values: dict, message: str) -> None:
    edit(copy, "sample_annotation", lambda rows: rows[1].update(values))
    with pytest.raises(SourceError, match=message):
        open_nuscenes(f"{copy}#scene-0001", PLAIN)
    options = skipping()
    frames = list(open_nuscenes(f"{copy}#scene-0001", options))
    assert [len(frame.truth) for frame in frames if frame.truth is not None] == [1, 2, 2]
    assert len(options.bad_frames.skipped) == 1


def test_what_is_not_evaluated(copy: Path) -> None:
    """Boxes without a single point, and classes that nuScenes doesn't tell, are regions to be ignored."""
    edit(copy, "sample_annotation", lambda rows: rows[0].update(num_lidar_pts=0, num_radar_pts=0))
    first = next(iter(open_nuscenes(f"{copy}#scene-0001", PLAIN))).truth
    assert (len(first), first.ignored_boxes_xyxy.shape) == (1, (1, 4))
    edit(copy, "category", lambda rows: [{**row, "name": "vehicle.emergency.police"} for row in rows])
    first = next(iter(open_nuscenes(f"{copy}#scene-0001", PLAIN))).truth
    assert (len(first), first.ignored_boxes_xyxy.shape) == (0, (2, 4))
    edit(copy, "category", lambda rows: [{**row, "name": "animal"} for row in rows])
    first = next(iter(open_nuscenes(f"{copy}#scene-0001", PLAIN))).truth
    assert (len(first), first.ignored_boxes_xyxy) == (0, None)


def test_a_test_set_has_no_truth(copy: Path) -> None:
    edit(copy, "sample_annotation", lambda rows: rows.clear())
    (copy / "v1.0-mini").rename(copy / "v1.0-test")
    assert all(frame.truth is None for frame in open_nuscenes(f"{copy}#scene-0001", PLAIN))
    (copy / "v1.0-test" / "sample_annotation.json").unlink()
    assert all(frame.truth is None for frame in open_nuscenes(f"{copy}#scene-0001?boxes=interpolate", PLAIN))


def test_can_bus_holes_and_ends() -> None:
    """Messages at 0, 20, 520 and 1220 ms: half a second is bridged, 0.7 s isn't, 0.1 s beyond the ends is held."""
    times = np.array([0, 20, 520, 1220], np.int64) * 1_000_000 + 1_532_402_927_000_000_000
    can = CanMotion(times, np.array([[1.0, 0, 0], [2.0, 0, 0], [7.0, 0, 0.5], [9.0, 0, 0]]))

    def speed(milliseconds: int) -> float | None:
        motion = can.at(int(times[0]) + milliseconds * 1_000_000)
        return None if motion is None else motion.speed_mps

    assert [speed(ms) for ms in (0, 10, 20, 270, 520)] == pytest.approx([1.0, 1.5, 2.0, 4.5, 7.0])
    assert [speed(ms) for ms in (521, 900, 1219)] == [None] * 3
    assert [speed(ms) for ms in (-100, 1220, 1320)] == pytest.approx([1.0, 9.0, 9.0])
    assert [speed(ms) for ms in (-101, 1321)] == [None] * 2


def test_can_bus_damage(copy: Path) -> None:
    path = copy / "can_bus" / "scene-0001_pose.json"
    rows = json.loads(path.read_text())
    rows[3]["vel"] = [1.0, 2.0]
    rows[5]["utime"] = rows[4]["utime"]
    path.write_text(json.dumps(rows))
    with pytest.raises(SourceError, match=r"scene-0001_pose\.json \[3\]: vel is \[1\.0, 2\.0\]"):
        open_nuscenes(f"{copy}#scene-0001?ego=can", PLAIN)
    bad = BadFrames(skip=True)
    assert len(read_can_motion(copy, "scene-0001", bad).times_ns) == len(rows) - 2
    assert "[5]: utime" in bad.skipped[1]
    path.write_text("[]")
    with pytest.raises(SourceError, match=r"holds no message that can be used; use \?ego=pose"):
        open_nuscenes(f"{copy}#scene-0001?ego=can", PLAIN)
    path.unlink()
    with pytest.raises(SourceError, match=r"scene-0001_pose\.json is missing; .*use \?ego=pose"):
        open_nuscenes(f"{copy}#scene-0001?ego=can", PLAIN)


def test_writing_refuses_what_it_cannot_write(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="drive 'a' has no frames"):
        write_nuscenes(tmp_path, {"a": []})
