"""CADC: round trip of a rendered drive, projection beside OpenCV's, ego-motion signs, trees, damage."""

from __future__ import annotations

import json
import logging
import math
import shutil
from dataclasses import astuple
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.cadc import open_cadc, sequences, write_cadc
from cable_rpc.data.cadc.calibration import read_calibration
from cable_rpc.data.cadc.novatel import read_novatel
from cable_rpc.data.cadc.writer import LENS
from cable_rpc.data.cuboids import cuboid_corners
from cable_rpc.data.local_plane import east_north_of
from cable_rpc.data.poses import inverse_rigid
from cable_rpc.data.rendered_drive import DriveFrame, RenderedDrive
from cable_rpc.data.source import SourceOptions
from cable_rpc.data.synthetic import SyntheticConfig
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.types import CameraMount

NAME = "2018_03_06/0001"
STATISTICS = Path(__file__).resolve().parents[3] / "shared/data/formats/cadc/cadc_dataset_route_stats.csv"
START_NS = 1520348400_000_000_000
"""2018-03-06 15:00:00."""


@lru_cache(maxsize=1)
def drive() -> tuple[DriveFrame, ...]:
    return tuple(RenderedDrive(SyntheticConfig(3, 384, 216, 10.0, 7, route="turns")))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive of all frames in the raw tree and of every third in the labelled one."""
    root = tmp_path_factory.mktemp("cadc")
    write_cadc(root, {NAME: drive()}, tree="raw", annotations=False)
    write_cadc(root, {NAME: drive()[::3]})
    return root


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Three small frames, the tree named as the devkit does."""
    write_cadc(tmp_path / "cadcd", {NAME: drive()[::3]}, tree="processed")
    return tmp_path


def surface(driven: DriveFrame, row: int) -> np.ndarray:
    """Points all over a cuboid's faces in the camera's axes, [N, 3]."""
    corners = cuboid_corners([driven.cuboids[row]])[0]
    origin, axes = corners[7], corners[[3, 5, 6]] - corners[7]
    grid = np.linspace(0, 1, 25)
    parts = np.stack(np.meshgrid(grid, grid, grid), -1).reshape(-1, 3)
    on_face = ((parts == 0) | (parts == 1)).any(axis=1)
    points = origin + parts[on_face] @ axes
    pose = inverse_rigid(driven.vehicle_from_camera)
    return points @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.parametrize("tree", ["labeled", "raw"])
def test_boxes_bound_what_opencv_projects(written: Path, tree: str) -> None:
    """Boxes are those of surface points put through OpenCV's own lens model, clipped to the image."""
    source = open_cadc(f"{written}?tree={tree}", SourceOptions())
    lens = np.array(LENS) if tree == "raw" else np.zeros(5)
    by_time = {driven.frame.capture_time_ns + START_NS: driven for driven in drive()}
    compared = 0
    for frame in source:
        driven = by_time[frame.capture_time_ns]
        camera, theirs = driven.frame.intrinsics, driven.frame.truth
        if frame.truth is None:
            continue
        assert camera is not None
        assert theirs is not None
        assert frame.intrinsics is not None
        assert astuple(frame.intrinsics) == pytest.approx(astuple(camera))
        matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        assert sorted(frame.truth.class_ids.tolist()) == sorted(theirs.class_ids.tolist())
        for row in range(len(driven.cuboids)):
            points = surface(driven, row)
            if points[:, 2].min() < 2.0:
                continue
            pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, lens)[0][:, 0]
            there = ((pixels >= 0) & (pixels <= (384, 216))).all(axis=1)
            expected = np.concatenate([pixels[there].min(0), pixels[there].max(0)])
            nearest = np.abs(frame.truth.boxes_xyxy - expected).max(axis=1)
            # What the border cuts through is told only as finely as the points lie.
            assert nearest.min() < (0.6 if there.all() else 4.0)
            at = int(nearest.argmin())
            assert frame.truth.class_ids[at] == driven.cuboids[row].class_id
            straight = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, None)[0][:, 0]
            low, high = straight.min(0), straight.max(0)
            inside = np.prod(np.maximum(np.minimum(high, (384, 216)) - np.maximum(low, 0), 0)) / np.prod(high - low)
            if tree == "labeled":
                assert frame.truth.visibility[at] == pytest.approx(inside, abs=0.02)
            else:
                # A barrel lens sees farther than the pinhole behind it.
                assert inside - 0.02 < frame.truth.visibility[at] <= 1.0
            compared += 1
    assert compared > 6


def test_boxes_hold_what_is_seen(written: Path) -> None:
    """No visible pixel of an object, moved as the lens does, lies more than 2 pixels outside its box."""
    by_time = {driven.frame.capture_time_ns + START_NS: driven for driven in drive()}
    seen = 0
    for tree, lens in (("labeled", np.zeros(5)), ("raw", np.array(LENS))):
        for frame in open_cadc(f"{written}?tree={tree}", SourceOptions()):
            theirs, camera = by_time[frame.capture_time_ns].frame.truth, frame.intrinsics
            if frame.truth is None:
                continue
            assert theirs is not None
            assert theirs.instance_mask is not None
            assert camera is not None
            matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
            assert len(frame.truth) == len(theirs)
            for row in range(len(theirs)):
                rows, columns = np.nonzero(theirs.instance_mask == row + 1)
                if len(rows) < 30:
                    continue
                rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, rows * 0 + 1.0], 1)
                pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, lens)[0][:, 0]
                outside = np.maximum(frame.truth.boxes_xyxy[row, :2] - pixels, pixels - frame.truth.boxes_xyxy[row, 2:])
                assert outside.max() < 2.0
                seen += 1
    assert seen > 10


def test_labelled_tree(written: Path) -> None:
    assert sequences(written) == [NAME]
    source = open_cadc(f"{written}#{NAME}", SourceOptions())
    assert (source.name, source.size_wh, source.frame_count) == ("cadc-2018_03_06-0001", (384, 216), 3)
    assert source.fps == pytest.approx(10 / 3)
    frames = list(source)
    assert [frame.index for frame in source] == [0, 1, 2]
    tracks: dict[int, set[int]] = {}
    for driven, frame in zip(drive()[::3], frames, strict=True):
        assert np.array_equal(frame.image, driven.frame.image)
        assert frame.capture_time_ns == START_NS + driven.frame.capture_time_ns
        assert frame.ego is not None
        assert driven.frame.ego is not None
        assert frame.truth is not None
        assert driven.frame.truth is not None
        for theirs, mine in zip(driven.frame.truth.track_ids.tolist(), frame.truth.track_ids.tolist(), strict=True):
            tracks.setdefault(theirs, set()).add(mine)
    assert all(len(mine) == 1 for mine in tracks.values())
    assert len(set.union(*tracks.values())) == len(tracks)
    middle, truth = frames[1].ego, drive()[3].frame.ego
    assert middle is not None
    assert truth is not None
    assert middle.speed_mps == pytest.approx(truth.speed_mps, abs=0.15)
    assert middle.lateral_mps == pytest.approx(0.0, abs=0.05)
    assert middle.yaw_rate_radps == pytest.approx(truth.yaw_rate_radps, abs=0.02)
    assert source.mount is not None
    assert source.mount.height_m == pytest.approx(1.45, abs=0.1)
    assert source.mount.pitch_down_rad == pytest.approx(math.radians(1.8), abs=1e-4)
    assert source.mount.forward_m == pytest.approx(0.0, abs=1e-6)


def test_raw_tree(written: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Annotations go to the raw images of the same instants; speeds come from the messages."""
    frames = list(open_cadc(f"{written}#{NAME}?tree=raw", SourceOptions()))
    assert [frame.truth is not None for frame in frames] == [True, False, False, True, False, False, True]
    for frame, driven in zip(frames, drive(), strict=True):
        assert frame.ego is not None
        assert driven.frame.ego is not None
        assert frame.ego.speed_mps == pytest.approx(driven.frame.ego.speed_mps, abs=1e-5)
        assert frame.ego.lateral_mps == pytest.approx(0.0, abs=1e-5)
    stamps = written / NAME / "labeled/image_00/timestamps.txt"
    text = stamps.read_text()
    stamps.unlink()
    with caplog.at_level(logging.WARNING):
        bare = list(open_cadc(f"{written}#{NAME}?tree=raw", SourceOptions()))
    stamps.write_text(text)
    assert "7 raw images for 3 annotations" in caplog.text
    assert [frame.truth for frame in bare] == [None] * 7


def test_annotation_without_its_raw_image(written: Path, tmp_path: Path) -> None:
    """The last annotated instant is 0.2 s after the last raw image that is left, which was not annotated."""
    root = Path(shutil.copytree(written, tmp_path / "cadc"))
    for number in (5, 6):
        (root / NAME / f"raw/image_00/data/{number:010d}.png").unlink()
    frames = list(open_cadc(f"{root}?tree=raw", SourceOptions()))
    assert [frame.truth is not None for frame in frames] == [True, False, False, True, False]


def test_raw_tree_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The raw download has neither annotations nor the labelled tree; with as many of them the numbers count."""
    write_cadc(tmp_path, {NAME: drive()[:3]}, tree="raw")
    annotated = list(open_cadc(str(tmp_path), SourceOptions()))
    assert [frame.truth is None for frame in annotated] == [False] * 3
    (tmp_path / NAME / "3d_ann.json").unlink()
    with caplog.at_level(logging.WARNING):
        source = open_cadc(str(tmp_path), SourceOptions())
    assert [record.message.partition("; ")[2] for record in caplog.records] == ["frames come without truth"]
    assert (source.name, source.mount) == ("cadc-2018_03_06-0001-raw", None)
    assert [frame.truth for frame in source] == [None] * 3


def test_options(written: Path) -> None:
    source = open_cadc(f"{written}?tree=raw", SourceOptions(max_frames=2, fps=5.0, size=(192, 108)))
    frames = list(source)
    assert (source.fps, source.size_wh, len(frames)) == (5.0, (192, 108), 2)
    assert frames[1].capture_time_ns - frames[0].capture_time_ns == 200_000_000
    assert frames[0].intrinsics == source.intrinsics
    whole = next(iter(open_cadc(f"{written}?tree=raw", SourceOptions())))
    assert whole.truth is not None
    assert frames[0].truth is not None
    assert frames[0].truth.boxes_xyxy == pytest.approx(whole.truth.boxes_xyxy / 2)
    for rest, options, message in (
        (f"{written}?tree=cooked", SourceOptions(), "tree is 'cooked'"),
        (f"{written}?tree=processed", SourceOptions(), "use tree=labeled or tree=raw"),
        (f"{written}#2018_03_06/0002", SourceOptions(), "no sequence '2018_03_06/0002'; use one of"),
        (f"{written}", SourceOptions(mount=CameraMount(1.5)), "leave ego_csv"),
        ("#0001", SourceOptions(), "names no file or folder"),
        (f"{written}?tree=raw&tree=raw", SourceOptions(), "give tree once"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            open_cadc(rest, options)


def novatel_folder(folder: Path, rows: list[tuple[float, float, float]], seconds: list[float]) -> Path:
    """Messages of 15 values at latitudes, longitudes and azimuths given."""
    (folder / "data").mkdir(parents=True)
    for number, (latitude, longitude, azimuth) in enumerate(rows):
        line = f"{latitude:.12f} {longitude:.12f} 330 -36 5.5 6.6 7.7 0 0 {azimuth} 0 0 0 3 56"
        (folder / "data" / f"{number:010d}.txt").write_text(line)
    (folder / "timestamps.txt").write_text("".join(f"2018-03-06 15:00:{second:012.9f}\n" for second in seconds))
    return folder


def earth_centred(latitude: float, longitude: float) -> np.ndarray:
    """Cartesian place on the WGS 84 ellipsoid, metres."""
    phi, lam, flat = math.radians(latitude), math.radians(longitude), 1 / 298.257223563
    squared = flat * (2 - flat)
    normal = 6378137.0 / math.sqrt(1 - squared * math.sin(phi) ** 2)
    across = normal * math.cos(phi)
    return np.array([across * math.cos(lam), across * math.sin(lam), normal * (1 - squared) * math.sin(phi)])


def test_local_plane() -> None:
    """Distances agree with those straight through the ellipsoid to a millimetre over 300 m."""
    points = np.array([(43.47, -80.54), (43.4715, -80.54), (43.47, -80.537), (43.4690, -80.5425)])
    plane = east_north_of(points)
    for (latitude, longitude), place in zip(points, plane, strict=True):
        chord = np.linalg.norm(earth_centred(latitude, longitude) - earth_centred(*points[0]))
        assert np.linalg.norm(place) == pytest.approx(chord, abs=0.02)
    assert plane[1, 1] > 0
    assert plane[2, 0] > 0


@pytest.mark.parametrize("azimuth", [10.0, 100.0, 190.0, 355.0])
def test_signs_on_a_straight_drift(tmp_path: Path, azimuth: float) -> None:
    """A course 3 degrees clockwise of the heading is a drift to the right; yaw doesn't turn."""
    course = math.radians(azimuth + 3.0)
    rows = [(43.47 + 1e-4 * k * math.cos(course), -80.54 + 1e-4 * k * math.sin(course) / 0.728, azimuth % 360)
            for k in range(4)]  # fmt: skip
    log = read_novatel(novatel_folder(tmp_path / "novatel", rows, [0.0, 0.5, 1.0, 1.5]), {}, BadFrames())
    assert log is not None
    speed = float(np.linalg.norm(earth_centred(*rows[1][:2]) - earth_centred(*rows[0][:2]))) / 0.5
    ego = log.at(START_NS + 700_000_000)
    assert ego is not None
    assert ego.speed_mps == pytest.approx(speed * math.cos(math.radians(3.0)), rel=1e-3)
    assert ego.lateral_mps == pytest.approx(speed * math.sin(math.radians(3.0)), rel=0.1)
    assert ego.yaw_rate_radps == pytest.approx(0.0, abs=1e-9)
    assert log.at(START_NS + 3_000_000_000) is None


@pytest.mark.parametrize(("step", "sign"), [(-2.0, 1), (2.0, -1)])
def test_signs_through_north(tmp_path: Path, step: float, sign: int) -> None:
    """An azimuth that falls is a turn to the left, across 0 and 360 degrees too."""
    rows = [(43.47 + 1e-5 * k, -80.54, (-1.5 * step + step * k) % 360) for k in range(4)]
    log = read_novatel(novatel_folder(tmp_path / "novatel", rows, [0.0, 0.1, 0.2, 0.3]), {}, BadFrames())
    assert log is not None
    for time_ns in (0, 150_000_000, 300_000_000):
        ego = log.at(START_NS + time_ns)
        assert ego is not None
        assert ego.yaw_rate_radps == pytest.approx(sign * math.radians(20.0))


def test_velocities_of_messages_count(tmp_path: Path) -> None:
    """Of messages of 23 values, north and east velocity are turned by the azimuth: here 60 degrees."""
    folder = novatel_folder(tmp_path / "novatel", [(43.47, -80.54, 60.0)] * 2, [0.0, 0.1])
    north = 8.0 * math.cos(math.radians(60)) - 0.4 * math.sin(math.radians(60))
    east = 8.0 * math.sin(math.radians(60)) + 0.4 * math.cos(math.radians(60))
    for file in (folder / "data").iterdir():
        file.write_text(f"{file.read_text()} 0 0 {north} {east} 0 0 0 0")
    log = read_novatel(folder, {}, BadFrames())
    assert log is not None
    ego = log.at(START_NS)
    assert ego is not None
    assert astuple(ego) == pytest.approx((8.0, 0.4, 0.0), abs=1e-9)


def test_mount_of_another_rig(small: Path) -> None:
    """Poses in the style of the recording vehicle's: the unit looks along y, 1.1 m behind the lidar."""
    lidar_from_gnss = [[0.0, 1.0, 0.0, -1.13], [-1.0, 0.0, 0.0, 0.07], [0.0, 0.0, 1.0, -1.31], [0.0, 0.0, 0.0, 1.0]]
    tilt = 0.01
    lidar_from_camera = [[0.0, -math.sin(tilt), math.cos(tilt), 0.54], [-1.0, 0.0, 0.0, -0.03],
                         [0.0, -math.cos(tilt), -math.sin(tilt), -0.62], [0.0, 0.0, 0.0, 1.0]]  # fmt: skip
    fields = {"T_LIDAR_CAM00": lidar_from_camera, "T_LIDAR_GPSIMU": lidar_from_gnss}
    folder = small / "cadcd/2018_03_06/calib"
    (folder / "extrinsics.yaml").write_text(yaml.safe_dump(fields))
    calibration = read_calibration(folder)
    assert calibration.forward_m == pytest.approx(1.67)
    assert calibration.pitch_down_rad == pytest.approx(tilt)
    del fields["T_LIDAR_GPSIMU"]
    (folder / "extrinsics.yaml").write_text(yaml.safe_dump(fields))
    calibration = read_calibration(folder)
    assert (calibration.forward_m, calibration.pitch_down_rad) == (0.0, pytest.approx(tilt))


def test_without_stamps(small: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Without any time stamps frames come at a nominal rate, which is said, and motion by number."""
    drive_folder = small / "cadcd" / NAME / "processed"
    (drive_folder / "image_00/timestamps.txt").unlink()
    (drive_folder / "novatel/timestamps.txt").unlink()
    with caplog.at_level(logging.WARNING):
        source = open_cadc(str(small), SourceOptions())
    assert [record.message.partition("; ")[2] for record in caplog.records] == [
        "frames are taken to come at 3 per second"
    ]
    assert source.fps == pytest.approx(3.0)
    assert all(frame.ego is not None for frame in source)


def test_damage(small: Path) -> None:
    folder = small / "cadcd" / NAME
    annotations = json.loads((folder / "3d_ann.json").read_text())
    count = len(annotations[1]["cuboids"])
    annotations[1]["cuboids"] += [
        {**annotations[1]["cuboids"][0], "dimensions": {"x": 0, "y": 1, "z": 1}},
        {**annotations[1]["cuboids"][0], "label": "Horse_and_Buggy"},
        {**annotations[1]["cuboids"][0], "yaw": "north"},
        {**annotations[1]["cuboids"][0], "position": [1, 2, 3]},
    ]
    (folder / "3d_ann.json").write_text(json.dumps(annotations))
    with pytest.raises(SourceError, match=rf"3d_ann\.json \[1\]\.cuboids\[{count}\]: dimensions are"):
        open_cadc(str(small), SourceOptions())
    images = folder / "processed/image_00/data"
    whole = (images / "0000000002.png").read_bytes()
    (images / "0000000002.png").write_bytes(whole[: len(whole) // 2])
    (images / "0000000001.png").unlink()
    (folder / "processed/novatel/data/0000000001.txt").write_text("43 -80 x")
    skipping = BadFrames(skip=True)
    source = open_cadc(str(small), SourceOptions(bad_frames=skipping))
    assert source.frame_count == 3
    frames = list(source)
    assert [frame.index for frame in frames] == [0]
    assert frames[0].ego is not None
    for wanted in ("dimensions", "yaw is 'north'", "position is", "0000000001.txt line 1: 3 values", "0000000001.png",
                   "0000000002.png"):  # fmt: skip
        assert any(wanted in line for line in skipping.skipped)
    assert len(skipping.skipped) == 6


def test_missing_parts(small: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(SourceError, match=r"labeled/image_00/data.*http://cadcd\.uwaterloo\.ca"):
        open_cadc(str(empty), SourceOptions())
    folder = small / "cadcd" / NAME
    calibration = folder.parent / "calib"
    for file, text, message in (
        (calibration / "00.yaml", "camera_matrix: {data: [1, 2]}", r"00\.yaml: camera_matrix\.data is"),
        (calibration / "00.yaml", "a: [", r"00\.yaml is no YAML"),
        (calibration / "extrinsics.yaml", "T_LIDAR_CAM00: [[2, 0], [0, 1]]", r"extrinsics\.yaml: T_LIDAR_CAM00 is"),
        (calibration / "extrinsics.yaml", None, r"extrinsics\.yaml.*calib\.zip at http://cadcd"),
        (folder / "3d_ann.json", "[", r"3d_ann\.json line 1"),
        (folder / "3d_ann.json", "{}", "must be a list"),
        (folder / "3d_ann.json", None, r"3d_ann\.json is missing; .*cadcd"),
    ):
        good = file.read_text()
        file.unlink() if text is None else file.write_text(text)
        with pytest.raises(SourceError, match=message):
            open_cadc(str(small), SourceOptions(bad_frames=BadFrames(skip=True)))
        file.write_text(good)
    camera = yaml.safe_load((calibration / "00.yaml").read_text())
    (calibration / "00.yaml").write_text(yaml.safe_dump({**camera, "image_width": 1280}))
    with pytest.raises(SourceError, match="384x216, but the calibration is for 1280x216"):
        open_cadc(str(small), SourceOptions())
    (calibration / "00.yaml").write_text(yaml.safe_dump(camera))
    (folder / "3d_ann.json").write_text(json.dumps([{"cuboids": []}] * 3))
    for file in (folder / "processed/novatel/data").iterdir():
        file.unlink()
    with caplog.at_level(logging.WARNING):
        source = open_cadc(str(small), SourceOptions())
    assert "without ego-motion" in caplog.text
    assert source.mount is None
    assert [(len(frame.truth or []), frame.ego) for frame in source] == [(0, None)] * 3


@pytest.mark.skipif(not STATISTICS.is_file(), reason="CADC's table of drives is not there")
def test_labels_of_the_published_statistics() -> None:
    """Every class of the published table is either mapped or knowingly left out."""
    from cable_rpc.data.cadc.annotations import CLASS_BY_LABEL

    columns = STATISTICS.read_text().splitlines()[0].split(",")[8:18]
    left_out = {"Horse_and_Buggy", "Animals", "Garbage_Containers_on_Wheels", "Traffic_Guidance_Objects"}
    assert set(columns) == left_out | set(CLASS_BY_LABEL)
