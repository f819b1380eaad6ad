"""COCO image sequences: round trip of a rendered panorama, grouping, order, times, categories, damage."""

from __future__ import annotations

import json
import math
from dataclasses import astuple, replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.coco import open_coco_video, open_wod_zb, sequences, write_coco
from cable_rpc.data.coco.boxes import BoxRow, ground_truth
from cable_rpc.data.coco.categories import class_of_category
from cable_rpc.data.coco.images import natural_key
from cable_rpc.data.coco.tables import read_tables
from cable_rpc.data.source import SourceOptions
from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.types import CameraIntrinsics, CameraMount, EgoMotion

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "formats" / "coco"
SIZE = (64, 32)
CATEGORIES = [{"id": 3, "name": "car"}, {"id": 1, "name": "Pedestrian"}, {"id": 9, "name": "tram"}]


@pytest.fixture(scope="module")
def panorama(tmp_path_factory):
    """Two short wide drives as a data set, and the rendered frames that they came from."""
    root = tmp_path_factory.mktemp("panoramas")
    drives = {
        name: list(
            SyntheticSource(SyntheticConfig(seed=seed, width=768, height=160, frame_count=4, horizontal_fov_deg=110))
        )
        for name, seed in (("north", 3), ("south", 8))
    }
    wrapped = {name: [SimpleNamespace(frame=frame) for frame in frames] for name, frames in drives.items()}
    write_coco(root, wrapped, suffix=".png")
    return root, drives


def image_row(number: int, **fields):
    return {"id": number, "file_name": f"drive/{number}.png", "width": SIZE[0], "height": SIZE[1], **fields}


def box_of(image_id, bbox=(10, 4, 20, 10), **fields):
    return {"id": 1, "image_id": image_id, "category_id": 3, "bbox": list(bbox), "iscrowd": 0, **fields}


def write_set(folder: Path, images, annotations=(), **document) -> Path:
    """An annotation file and its images, whose grey level is their id."""
    for row in images:
        path = folder / str(row["file_name"])
        path.parent.mkdir(parents=True, exist_ok=True)
        level = row["id"] if isinstance(row["id"], int) else len(row["id"])
        cv2.imwrite(str(path), np.full((SIZE[1], SIZE[0], 3), level, np.uint8))
    file = folder / "labels.json"
    tables = {"images": images, "annotations": list(annotations), "categories": CATEGORIES, **document}
    file.write_text(json.dumps({key: value for key, value in tables.items() if value is not None}))
    return file


def frames_of(spec, **options):
    return list(open_coco_video(str(spec), SourceOptions(**options)))


def levels(frames):
    return [int(frame.image[0, 0, 0]) for frame in frames]


def test_a_rendered_panorama_comes_back(panorama):
    root, drives = panorama
    assert sequences(root) == ["north", "south"]
    for name, written in drives.items():
        source = open_wod_zb(f"{root}#{name}", SourceOptions())
        assert (source.name, source.size_wh, source.frame_count) == (name, (768, 160), 4)
        assert source.fps == pytest.approx(10.0)
        for _ in range(2):
            read = list(source)
            assert [frame.index for frame in read] == [0, 1, 2, 3]
            for before, after in zip(written, read, strict=True):
                np.testing.assert_array_equal(after.image, before.image)
                assert after.capture_time_ns == before.capture_time_ns
                assert (after.ego, after.intrinsics, after.mount) == (before.ego, before.intrinsics, before.mount)
                assert len(before.truth) > 0
                np.testing.assert_allclose(after.truth.boxes_xyxy, before.truth.boxes_xyxy, atol=1e-3)
                np.testing.assert_array_equal(after.truth.class_ids, before.truth.class_ids)
                np.testing.assert_array_equal(after.truth.track_ids, before.truth.track_ids)
                np.testing.assert_allclose(after.truth.visibility, before.truth.visibility, atol=1e-6)


def test_an_independent_library_reads_what_was_written(panorama):
    faster_coco_eval = pytest.importorskip("faster_coco_eval")
    root, drives = panorama
    coco = faster_coco_eval.COCO(str(root / "annotations" / "instances.json"))
    written = [frame for frames in drives.values() for frame in frames]
    assert len(coco.getImgIds()) == len(written)
    for image_id, frame in zip(sorted(coco.getImgIds()), written, strict=True):
        rows = coco.loadAnns(coco.getAnnIds(imgIds=[image_id]))
        boxes = np.array([row["bbox"] for row in rows])
        np.testing.assert_allclose(boxes[:, :2] + boxes[:, 2:], frame.truth.boxes_xyxy[:, 2:], atol=1e-3)
        names = [coco.loadCats([row["category_id"]])[0]["name"] for row in rows]
        assert [class_of_category(name) for name in names] == frame.truth.class_ids.tolist()


def test_a_panorama_is_resized_with_camera_and_boxes(panorama):
    root, drives = panorama
    half = next(iter(open_wod_zb(f"{root}#north", SourceOptions(size=(384, 80)))))
    whole = drives["north"][0]
    assert half.image.shape == (80, 384, 3)
    assert half.intrinsics == whole.intrinsics.scaled(0.5, 0.5)
    np.testing.assert_allclose(half.truth.boxes_xyxy, whole.truth.boxes_xyxy / 2, atol=1e-3)


@pytest.mark.parametrize(
    ("fields", "videos", "names"),
    [
        ([{"video_id": 7}, {"video_id": 8}], [{"id": 7, "name": "a/x"}, {"id": 8, "name": "b"}], ["a/x", "b"]),
        ([{"video_id": 7}, {"video_id": 8}], None, ["7", "8"]),
        ([{"video_id": "q"}, {"video_id": "q"}], [{"id": "q"}], ["q"]),
        ([{"sequence": "s10"}, {"sequence": "s9"}], None, ["s9", "s10"]),
        ([{"video": "one"}, {"video": "two"}], None, ["one", "two"]),
        ([{"file_name": "d1/1.png"}, {"file_name": "d2/2.png"}], None, ["d1", "d2"]),
        ([{"file_name": "1.png"}, {"file_name": "2.png"}], None, ["labels"]),
    ],
)
def test_images_are_grouped_into_sequences(tmp_path, fields, videos, names):
    rows = [image_row(number, **values) for number, values in enumerate(fields, 1)]
    file = write_set(tmp_path, rows, videos=videos)
    assert sequences(file) == names
    for name in names:
        assert frames_of(f"{file}#{name}")
        assert len(frames_of(f"{file}?sequence={name}")) == 2 / len(names)


def test_the_order_is_by_number_then_time_then_natural_name(tmp_path):
    names = [{"file_name": f"d/img{name}.png"} for name in (10, 9, 100)]
    rows = [image_row(number, **name) for number, name in enumerate(names, 1)]
    assert levels(frames_of(write_set(tmp_path, rows))) == [2, 1, 3]
    stamped = [{**row, "timestamp": 1.6e9 + stamp} for row, stamp in zip(rows, (5, 7, 6), strict=True)]
    assert levels(frames_of(write_set(tmp_path, stamped))) == [1, 3, 2]
    numbered = [{**row, "frame_id": number} for row, number in zip(rows, (2, 1, 0), strict=True)]
    assert levels(frames_of(write_set(tmp_path, numbered))) == [3, 2, 1]


@pytest.mark.parametrize(
    ("fields", "expected_ns"),
    [
        ([{"timestamp": 12.5}, {"timestamp": 12.75}], [12_500_000_000, 12_750_000_000]),
        ([{"timestamp": 1_531_883_530_412_470}, {"timestamp": 1_531_883_530_512_470}],
         [1_531_883_530_412_470_000, 1_531_883_530_512_470_000]),
        ([{"timestamp": 1_531_883_530_412}, {"timestamp": 1_531_883_530_512}],
         [1_531_883_530_412_000_000, 1_531_883_530_512_000_000]),
        ([{"timestamp_ns": 1_531_883_530_412_470_001}, {"timestamp_ns": 1_531_883_530_512_470_003}],
         [1_531_883_530_412_470_001, 1_531_883_530_512_470_003]),
        ([{"timestamp_micros": 5}, {"timestamp_micros": 9}], [5000, 9000]),
        ([{"frame_index": 30}, {"frame_index": 60}], [0, 6_000_000_000]),
        ([{}, {}], [0, 200_000_000]),
    ],
)  # fmt: skip
def test_times_are_the_rows_own_in_their_unit(tmp_path, fields, expected_ns):
    rows = [image_row(number, **values) for number, values in enumerate(fields, 1)]
    source = open_coco_video(f"{write_set(tmp_path, rows)}?fps=5", SourceOptions())
    assert [frame.capture_time_ns for frame in source] == expected_ns
    assert source.fps == pytest.approx(1e9 / (expected_ns[1] - expected_ns[0]))


def test_a_video_row_tells_the_rate_and_options_thin_and_stop(tmp_path):
    rows = [image_row(number, video_id=1, frame_id=number) for number in range(1, 13)]
    file = write_set(tmp_path, rows, videos=[{"id": 1, "name": "v", "fps": 30}])
    source = open_coco_video(str(file), SourceOptions(fps=10))
    assert (source.fps, source.frame_count) == (10, 4)
    assert levels(source) == [1, 4, 7, 10]
    assert [frame.capture_time_ns for frame in source] == [0, 100_000_000, 200_000_000, 300_000_000]
    assert levels(frames_of(file, max_frames=2)) == [1, 2]
    assert open_coco_video(str(file), SourceOptions(fps=60)).fps == pytest.approx(30)


def test_boxes_are_clipped_and_the_rest_is_sorted_out(tmp_path):
    annotations = [
        box_of(1, (-10, 4, 20, 10), track_id=5),
        box_of(1, (60, 4, 8, 8), track_id=6, visibility=0.25),
        box_of(1, (70, 4, 8, 8), track_id=7),
        box_of(1, (0, 0, 8, 8), category_id=9, track_id=8),
        box_of(1, (0, 0, 30, 8), iscrowd=1, track_id=9),
        box_of(1, (0, 8, 30, 8), ignore=1, category_id=1, track_id=10),
    ]
    first, second = frames_of(write_set(tmp_path, [image_row(1), image_row(2)], annotations))
    np.testing.assert_array_equal(first.truth.boxes_xyxy, [[0, 4, 10, 14], [60, 4, 64, 12]])
    np.testing.assert_allclose(first.truth.visibility, [0.5, 0.25])
    assert first.truth.track_ids.tolist() == [5, 6]
    assert first.truth.class_ids.tolist() == [2, 2]
    np.testing.assert_array_equal(first.truth.ignored_boxes_xyxy, [[0, 0, 30, 8], [0, 8, 30, 16]])
    assert len(second.truth) == 0
    assert second.truth.ignored_boxes_xyxy is None


def test_a_file_without_annotations_has_no_truth(tmp_path):
    file = write_set(tmp_path, [image_row(1)], annotations=(), categories=None)
    document = json.loads(file.read_text())
    del document["annotations"]
    file.write_text(json.dumps(document))
    assert frames_of(file)[0].truth is None


def test_text_ids_get_numbers_that_stay_over_the_sequence(tmp_path):
    rows = [image_row(1) | {"id": name, "frame_id": place} for place, name in enumerate(("ab", "abc"))]
    annotations = [
        box_of("ab", track_id="left"),
        box_of("ab", track_id="right"),
        box_of("abc", track_id="right"),
    ]
    first, second = frames_of(write_set(tmp_path, rows, annotations))
    assert first.truth.track_ids.tolist() == [1, 2]
    assert second.truth.track_ids.tolist() == [2]


def test_ego_motion_keeps_its_signs_and_a_log_replaces_it(tmp_path):
    """Left turn with a drift to the right: both positive, as everywhere in the package."""
    ego = {"speed_mps": 8.0, "lateral_mps": 0.3, "yaw_rate_radps": 0.2}
    camera = {"fx": 50, "fy": 51, "cx": 32, "cy": 16, "mount": [1.5, 0.02, 1.0]}
    file = write_set(tmp_path, [image_row(1, **ego, **camera), image_row(2)])
    first, second = frames_of(file)
    assert first.ego == EgoMotion(8.0, 0.3, 0.2)
    assert first.intrinsics == CameraIntrinsics(50, 51, 32, 16)
    assert first.mount == CameraMount(1.5, 0.02, 1.0)
    assert (second.ego, second.intrinsics, second.mount) == (None, None, None)
    log = tmp_path / "ego.csv"
    log.write_text("time_s,speed_mps,yaw_rate_radps\n0,4,-0.1\n1,4,-0.1\n")
    chosen = CameraIntrinsics(10, 10, 5, 5)
    assert [frame.ego for frame in frames_of(file, ego_csv=log)] == [EgoMotion(4.0, 0.0, -0.1)] * 2
    assert frames_of(file, intrinsics=chosen)[0].intrinsics == chosen


@pytest.mark.parametrize(
    ("row", "annotation", "where"),
    [
        (image_row(2, timestamp=math.nan), None, "images[1]: timestamp is nan"),
        (image_row(2) | {"width": "wide"}, None, "images[1]: width is 'wide'"),
        (image_row(2) | {"id": 1}, None, "images[1]: id 1 is that of"),
        (image_row(2, speed_mps=3.0), None, "images[1]: yaw_rate_radps is None"),
        (image_row(2, cam_intrinsic=[[1, 2], [3]]), None, "images[1]: cam_intrinsic is [[1, 2], [3]]"),
        (image_row(2) | {"width": 65}, None, "is 64x32, but"),
        (None, box_of(1, (1, 2, 3)), "annotations[0]: bbox is [1, 2, 3]"),
        (None, box_of(1, (1, 2, -3, 4)), "annotations[0]: bbox is [1, 2, -3, 4]"),
        (None, box_of(1, (1, 2, math.inf, 4)), "annotations[0]: bbox is"),
        (None, box_of(77), "annotations[0]: image_id 77 is that of no image"),
        (None, box_of(1, category_id=5), "annotations[0]: category_id 5 is none of"),
        (None, box_of(1, visibility=3), "annotations[0]: visibility is 3"),
    ],
)
def test_a_damaged_row_is_named_and_can_be_left_out(tmp_path, row, annotation, where):
    rows = [image_row(1), *([row] if row else []), image_row(3)]
    file = write_set(tmp_path, rows, [annotation] if annotation else [])
    with pytest.raises(SourceError) as raised:
        frames_of(file)
    assert where in str(raised.value)
    assert "labels.json" in str(raised.value)
    skipping = BadFrames(skip=True)
    frames = frames_of(file, bad_frames=skipping)
    assert levels(frames) == [1, 3]
    assert [frame.index for frame in frames] == [0, 1]
    assert len(frames[0].truth) == 0
    assert len(skipping.skipped) == 1
    assert where in skipping.skipped[0]


def test_numbers_and_times_must_rise_together(tmp_path):
    rows = [image_row(n, frame_id=n, timestamp=stamp) for n, stamp in ((1, 10.0), (2, 9.0), (3, 11.0))]
    file = write_set(tmp_path, rows)
    with pytest.raises(SourceError, match=r"images\[1\]: time 9000000000 ns doesn't rise"):
        frames_of(file)
    assert levels(frames_of(file, bad_frames=BadFrames(skip=True))) == [1, 3]


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("damage", ["half", "missing", "empty", "tail"])
def test_a_cut_or_missing_image_is_found(tmp_path, suffix, damage):
    rows = [image_row(number) | {"file_name": f"d/{number}{suffix}"} for number in (1, 2, 3)]
    file = write_set(tmp_path, rows)
    noise = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3), np.uint8)
    path = tmp_path / "d" / f"2{suffix}"
    cv2.imwrite(str(path), noise)
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(data[: {"half": len(data) // 2, "empty": 0, "tail": len(data) - 5}[damage]])
    with pytest.raises(SourceError, match=rf"2\{suffix}"):
        frames_of(file)
    skipping = BadFrames(skip=True)
    frames = frames_of(file, bad_frames=skipping)
    assert levels(frames) == [1, 3]
    assert [frame.index for frame in frames] == [0, 1]
    assert len(skipping.skipped) == 1


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ('{"images": [', "line 1, column"),
        ("[]", "COCO's format is an object"),
        ('{"annotations": []}', "no list 'images'"),
        ('{"images": [3]}', r"images\[0\] is 3"),
        ('{"images": [], "annotations": [{"id": 1}]}', "no 'categories'"),
        ('{"images": [], "categories": [{"id": 1}]}', r"categories\[0\]: name is None"),
        ('{"images": []}', "no annotation file lists an image"),
    ],
)
def test_a_file_of_another_form_is_refused_even_when_damage_is_skipped(tmp_path, content, complaint):
    file = tmp_path / "labels.json"
    file.write_text(content)
    with pytest.raises(SourceError, match=complaint):
        frames_of(file, bad_frames=BadFrames(skip=True))


def test_specs_that_cannot_be_opened_say_why(tmp_path):
    rows = [image_row(n) | {"file_name": f"d{n}/1.png"} for n in range(1, 13)]
    file = write_set(tmp_path, rows)
    with pytest.raises(ConfigurationError, match=r"has 12 sequences; add #SEQUENCE, one of 'd1', 'd2'.*and 2 more"):
        frames_of(file)
    with pytest.raises(ConfigurationError, match="no sequence 'd99'; use one of 'd1'"):
        frames_of(f"{file}#d99")
    for query in ("color=red", "fps", "fps=0", "fps=fast", "fps=1&fps=2"):
        with pytest.raises(ConfigurationError, match="fps"):
            frames_of(f"{file}?{query}")
    with pytest.raises(SourceError, match=r"cocodataset\.org"):
        frames_of(tmp_path / "gone.json")
    with pytest.raises(SourceError, match="no annotation files"):
        open_wod_zb(str(tmp_path / "d1"), SourceOptions())
    with pytest.raises(SourceError, match="give the folder as"):
        frames_of(f"{file}?images={tmp_path / 'elsewhere'}&sequence=d1")


def test_several_annotation_files_of_a_folder_are_searched(tmp_path):
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
        file = write_set(tmp_path / name, [image_row(1) | {"file_name": f"../{name}/1.png"}])
        (tmp_path / "annotations").mkdir(exist_ok=True)
        document = json.loads(file.read_text())
        document["images"][0]["sequence"] = name
        (tmp_path / "annotations" / f"{name}.json").write_text(json.dumps(document))
    assert sequences(tmp_path) == ["a", "b"]
    assert open_wod_zb(f"{tmp_path}#b", SourceOptions()).frame_count == 1


@pytest.mark.parametrize(
    ("name", "class_id"),
    [("Car", 2), ("VAN", 2), ("construction_vehicle", 7), ("human.pedestrian.adult", 0), ("vehicle.bus.rigid", 5),
     ("vehicle.construction", 7), ("Person", 0), ("cyclist", 1), ("Rider", 1), ("motor-bike", None),
     ("motorbike", 3), ("traffic_cone", None), ("static_object.bicycle_rack", None), ("tram", None)],
)  # fmt: skip
def test_categories_go_by_their_names(name, class_id):
    assert class_of_category(name) == class_id


@given(st.lists(st.integers(0, 10**6), min_size=1, max_size=20, unique=True))
def test_natural_order_is_that_of_the_numbers(numbers):
    names = [f"drive2/img{number}_left.png" for number in numbers]
    assert sorted(names, key=natural_key) == [f"drive2/img{number}_left.png" for number in sorted(numbers)]


coordinate = st.floats(-100, 200, allow_nan=False)


@given(coordinate, coordinate, st.floats(0.5, 100), st.floats(0.5, 100), st.floats(0, 1))
def test_a_clipped_box_lies_in_the_image_and_is_as_visible_as_its_part(left, top, width, height, share):
    row = BoxRow((left, top, left + width, top + height), 2, ("track", 1), share)
    truth = ground_truth([row], {row.track: 1}, (100, 50))
    overlap_x = max(0.0, min(left + width, 100) - max(left, 0))
    overlap_y = max(0.0, min(top + height, 50) - max(top, 0))
    inside = overlap_x * overlap_y / (width * height)
    assert len(truth) == (inside > 0)
    if inside > 0:
        assert truth.visibility[0] == pytest.approx(min(share, inside), abs=1e-5)
        assert 0 <= truth.boxes_xyxy[0, 0] <= truth.boxes_xyxy[0, 2] <= 100
        assert 0 <= truth.boxes_xyxy[0, 1] <= truth.boxes_xyxy[0, 3] <= 50


def test_segmentations_are_not_kept(tmp_path):
    file = write_set(tmp_path, [image_row(1)], [box_of(1, segmentation=[[1, 2, 3, 4, 5, 6]])])
    assert "segmentation" not in read_tables(file).annotations[0]


def test_the_nuscenes_fragment_loads(tmp_path):
    file = SHARED / "nus_infos_mono3d.coco.json"
    if not file.exists():
        pytest.skip("needs the COCO fragments in ../shared/data/formats/coco")
    names = sequences(file)
    assert len(names) == 6
    assert "samples/CAM_BACK_RIGHT" in names
    for row in json.loads(file.read_text())["images"]:
        path = tmp_path / row["file_name"]
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.zeros((row["height"], row["width"], 3), np.uint8))
    (frame,) = frames_of(f"{file}?images={tmp_path}&sequence=samples/CAM_FRONT")
    assert frame.truth.class_ids.tolist() == [7]
    np.testing.assert_allclose(frame.truth.boxes_xyxy, [[0.0, 357.7328, 342.5644, 606.9820]], atol=1e-3)
    assert astuple(frame.intrinsics) == pytest.approx((1266.4172, 1266.4172, 816.2670, 491.5071), abs=1e-3)
    (behind,) = frames_of(f"{file}?images={tmp_path}&sequence=samples/CAM_BACK_LEFT")
    assert behind.truth.class_ids.tolist() == [0, 0]


def test_the_kitti_fragment_loads(tmp_path):
    file = SHARED / "kitti_infos_mono3d.coco.json"
    if not file.exists():
        pytest.skip("needs the COCO fragments in ../shared/data/formats/coco")
    image = tmp_path / "training" / "image_2" / "000007.png"
    image.parent.mkdir(parents=True)
    cv2.imwrite(str(image), np.zeros((375, 1242, 3), np.uint8))
    source = open_coco_video(f"{file}?images={tmp_path}", SourceOptions())
    assert source.name == "training-image_2"
    (frame,) = source
    assert frame.truth.class_ids.tolist() == [2, 2, 2, 1]
    assert replace(frame.intrinsics, fx=0, fy=0) == CameraIntrinsics(0, 0, 609.5593, 172.854)
