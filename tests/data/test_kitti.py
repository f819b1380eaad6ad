"""KITTI tracking: round trip of a rendered drive, real fragments, signs, spellings, damage."""

from __future__ import annotations

import logging
import math
from dataclasses import astuple
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.cuboids import cuboid_corners, project_corners
from cable_rpc.data.kitti import KittiSource, open_kitti, sequences, write_kitti
from cable_rpc.data.kitti.calibration import read_calibration
from cable_rpc.data.kitti.labels import ground_truth, label_row
from cable_rpc.data.poses import inverse_rigid
from cable_rpc.data.rendered_drive import DriveFrame, RenderedDrive
from cable_rpc.data.source import SourceOptions
from cable_rpc.data.synthetic import SyntheticConfig
from cable_rpc.data.time_stamps import read_stamps, stamp_ns, stamp_text
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.types import CameraIntrinsics, CameraMount, EgoMotion, Frame

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
LONG_CLIP, MINI = SHARED / "kitti-tracking-0002", SHARED / "formats" / "kitti-tracking-mini"
needs_long_clip = pytest.mark.skipif(not LONG_CLIP.is_dir(), reason="the fragment of KITTI sequence 0002 is not there")
needs_mini = pytest.mark.skipif(not MINI.is_dir(), reason="the fragments of KITTI 0001 and 0016 are not there")
CAR = "0 3 Car 0 0 -1.5 10.0 20.0 60.0 50.0 1.5 1.6 4.0 1.0 1.7 20.0 0.1"


@lru_cache(maxsize=1)
def drive() -> tuple[DriveFrame, ...]:
    return tuple(RenderedDrive(SyntheticConfig(3, 384, 216, 10.0, 5, route="turns", mount_height_m=1.65)))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kitti")
    write_kitti(root, {"0000": drive()}, spelling="tracking", least_height_px=25.0)
    write_kitti(root, {"0000": drive()[:2], "0001": drive()[:2]}, spelling="object", split="testing", oxts=False)
    return root


def single(root: Path, lines: list[str], images: int = 2) -> str:
    """A sequence of grey images with the label lines given; its spec."""
    write_kitti(root, {"0000": drive()[:1]}, suffix=".jpg")
    (root / "training/image_02/0000/000000.jpg").unlink()
    for number in range(images):
        cv2.imwrite(str(root / f"training/image_02/0000/{number:06d}.png"), np.full((60, 100, 3), 90, np.uint8))
    (root / "training/label_02/0000.txt").write_text("".join(f"{line}\n" for line in lines))
    return str(root)


def frames_of(source: KittiSource) -> list[Frame]:
    return list(source)


def test_round_trip(written: Path) -> None:
    source = open_kitti(f"{written}#0000", SourceOptions())
    assert (source.name, source.fps, source.size_wh, source.frame_count) == ("kitti-0000", 10.0, (384, 216), 5)
    assert source.mount.height_m == 1.65
    assert source.mount.pitch_down_rad == pytest.approx(math.radians(1.8), abs=1e-6)
    assert source.mount.forward_m == pytest.approx(0.0, abs=1e-6)
    ignored = kept = 0
    for driven, frame in zip(drive(), source, strict=True):
        theirs, truth = driven.frame.truth, frame.truth
        assert theirs is not None
        assert truth is not None
        assert frame.ego is not None
        assert driven.frame.ego is not None
        assert np.array_equal(frame.image, driven.frame.image)
        assert (frame.index, frame.capture_time_ns) == (driven.frame.index, driven.frame.index * 100_000_000)
        assert frame.ego.speed_mps == pytest.approx(driven.frame.ego.speed_mps)
        assert frame.ego.yaw_rate_radps == pytest.approx(driven.frame.ego.yaw_rate_radps)
        assert frame.intrinsics is not None
        assert driven.frame.intrinsics is not None
        assert astuple(frame.intrinsics) == pytest.approx(astuple(driven.frame.intrinsics))
        tall = theirs.boxes_xyxy[:, 3] - theirs.boxes_xyxy[:, 1] >= 25
        expected = [row for row, class_id in enumerate(theirs.class_ids) if tall[row] and class_id in (0, 1, 2, 7)]
        assert truth.track_ids.tolist() == theirs.track_ids[expected].tolist()
        assert truth.class_ids.tolist() == theirs.class_ids[expected].tolist()
        assert truth.boxes_xyxy == pytest.approx(theirs.boxes_xyxy[expected], abs=1e-4)
        assert {round(share, 3) for share in truth.visibility.tolist()} <= {1.0, 0.7, 0.4}
        assert (truth.visibility <= theirs.visibility[expected] + 0.4).all()
        far = theirs.boxes_xyxy[~tall]
        assert (truth.ignored_boxes_xyxy is None) == (len(far) == 0)
        if truth.ignored_boxes_xyxy is not None:
            assert truth.ignored_boxes_xyxy == pytest.approx(far, abs=1e-4)
        ignored, kept = ignored + len(far), kept + len(expected)
    assert ignored > 3
    assert kept > 3
    assert [frame.index for frame in source] == [0, 1, 2, 3, 4]


def test_written_3d_boxes_project_to_the_objects(written: Path) -> None:
    """Devkit's formula (readme.txt, projectToImage.m) on the written columns, beside the drive's own cuboids."""
    calibration = (written / "training/calib/0000.txt").read_text().splitlines()
    projection = np.array(calibration[2].split()[1:], float).reshape(3, 4)
    rows = [line.split() for line in (written / "training/label_02/0000.txt").read_text().splitlines()]
    compared = 0
    for driven in drive():
        found = project_corners(
            cuboid_corners(driven.cuboids),
            inverse_rigid(driven.vehicle_from_camera),
            driven.frame.intrinsics or pytest.fail("no camera"),
            (384, 216),
        )
        for box, inside, cuboid in zip(found.boxes_xyxy, found.inside_share, driven.cuboids, strict=True):
            row = next((row for row in rows if row[:2] == [str(driven.frame.index), str(cuboid.track_id)]), None)
            if row is None or inside < 0.999:
                continue
            height, width, length, x, y, z, turn = (float(word) for word in row[10:17])
            ends = np.array(
                [(a * length / 2, b, c * width / 2) for a in (1, -1) for b in (0, -height) for c in (1, -1)]
            )
            cosine, sine = math.cos(turn), math.sin(turn)
            rotation = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
            points = np.hstack([ends @ rotation.T + (x, y, z), np.ones((8, 1))]) @ projection.T
            pixels = points[:, :2] / points[:, 2:]
            # KITTI's boxes stand upright in the camera's axes, so a tilted camera's differ from the cuboids a little.
            assert np.concatenate([pixels.min(0), pixels.max(0)]) == pytest.approx(box, abs=3.0)
            base = np.array(cuboid.centre_m) - (0, 0, cuboid.size_lwh_m[2] / 2)
            pose = inverse_rigid(driven.vehicle_from_camera)
            assert (x + 0.06, y, z) == pytest.approx(pose[:3, :3] @ base + pose[:3, 3], abs=1e-5)
            assert float(row[5]) == pytest.approx(math.remainder(turn - math.atan2(x, z), 2 * math.pi), abs=1e-5)
            compared += 1
    assert compared > 5


@pytest.mark.parametrize("split", ["training", "testing"])
def test_chain_of_poses_ends_at_the_rendered_camera(written: Path, split: str) -> None:
    """Through lidar, rectification and P2's baseline; the IMU is 0.93 m above the point whose motion is told."""
    vehicle_from_imu = np.eye(4)
    vehicle_from_imu[2, 3] = 0.93
    expected = inverse_rigid(drive()[0].vehicle_from_camera) @ vehicle_from_imu
    found = read_calibration(written / split / "calib/0000.txt").camera_from_imu
    assert found == pytest.approx(expected, abs=1e-9)


def test_splits_and_spellings(written: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert sequences(written) == ["0000", "testing/0000", "testing/0001"]
    assert sequences(written / "testing") == ["0000", "0001"]
    with caplog.at_level(logging.WARNING):
        source = open_kitti(f"{written}#testing/0001", SourceOptions())
        frames = frames_of(source) + frames_of(source)
    assert [record.message.split(";")[1] for record in caplog.records] == [" frames come without ego-motion"]
    assert source.name == "kitti-testing-0001"
    assert [(frame.truth, frame.ego) for frame in frames] == [(None, None)] * 4
    own = open_kitti(f"{written / 'training'}", SourceOptions())
    assert source.mount.pitch_down_rad == pytest.approx(own.mount.pitch_down_rad)
    assert "Tr_velo_cam " in (written / "training/calib/0000.txt").read_text()
    assert "Tr_velo_to_cam: " in (written / "testing/calib/0001.txt").read_text()
    with pytest.raises(ConfigurationError, match="3 sequences; add #SEQUENCE, one of '0000', 'testing/0000'"):
        open_kitti(str(written), SourceOptions())
    with pytest.raises(ConfigurationError, match="no sequence '0009'"):
        open_kitti(f"{written}#0009", SourceOptions())


def test_options(written: Path, tmp_path: Path) -> None:
    options = SourceOptions(max_frames=2, size=(192, 108), fps=5.0)
    source = open_kitti(f"{written}#0000", options)
    assert (source.fps, source.size_wh, source.frame_count) == (5.0, (192, 108), 2)
    whole = frames_of(open_kitti(f"{written}#0000", SourceOptions()))
    for frame, full in zip(source, (whole[0], whole[2]), strict=True):
        assert frame.image.shape == (108, 192, 3)
        assert frame.capture_time_ns == full.capture_time_ns
        assert frame.truth is not None
        assert full.truth is not None
        assert frame.truth.boxes_xyxy == pytest.approx(full.truth.boxes_xyxy / 2)
        assert frame.intrinsics == source.intrinsics
        assert frame.intrinsics.fx == pytest.approx((full.intrinsics or pytest.fail("no camera")).fx / 2)
    log = tmp_path / "ego.csv"
    log.write_text("frame,speed_mps,yaw_rate_radps\n1,7.5,-0.25\n")
    egos = [frame.ego for frame in open_kitti(f"{written}#0000", SourceOptions(ego_csv=log))]
    assert egos == [None, EgoMotion(7.5, 0.0, -0.25), None, None, None]
    for refused in (
        SourceOptions(mount=CameraMount(1.0)),
        SourceOptions(intrinsics=CameraIntrinsics(1.0, 1.0, 0.0, 0.0)),
    ):
        with pytest.raises(ConfigurationError, match="calibrated"):
            open_kitti(f"{written}#0000", refused)
    with pytest.raises(ConfigurationError, match="option 'camera=3'"):
        open_kitti(f"{written}#0000?camera=3", SourceOptions())


def test_signs_on_a_left_turn_drifting_right(tmp_path: Path) -> None:
    """Yaw grows counter-clockwise from east; the velocity points to the right of the heading."""
    spec = single(tmp_path, [], images=4)
    lines = []
    for step in range(3):
        yaw = 2.0 + 0.03 * step
        ahead, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
        east, north = 10.0 * ahead - 0.5 * left
        forward, leftward = east * ahead[0] + north * ahead[1], east * left[0] + north * left[1]
        lines.append(
            f"49 8 110 0 0 {yaw} {north} {east} {forward} {leftward} 0 0 0 9.8 0 0 9.8 0 0 0.29 0 0 0.3 0 0 4 9 4 4 0"
        )
    (tmp_path / "training/oxts/0000.txt").write_text("\n".join(lines))
    egos = [frame.ego for frame in open_kitti(spec, SourceOptions())]
    assert egos[3] is None
    for ego in egos[:3]:
        assert ego is not None
        assert (ego.speed_mps, ego.lateral_mps, ego.yaw_rate_radps) == pytest.approx((10.0, 0.5, 0.3))


@pytest.mark.parametrize(
    ("truncated", "occluded", "visibility"),
    [("0", "0", 1.0), ("0", "1", 0.7), ("0", "2", 0.4), ("0", "3", 0.4), ("2", "0", 0.4), ("0.25", "0", 0.75),
     ("1.00", "0", 0.0), ("1", "0", 0.7), ("0.10", "2", 0.4)],
)  # fmt: skip
def test_visibility(truncated: str, occluded: str, visibility: float) -> None:
    words = CAR.split()
    words[3:5] = truncated, occluded
    frame, row = label_row(words, "here")
    assert frame == 0
    assert row is not None
    assert row.visibility == pytest.approx(visibility)


def test_types_and_clipping() -> None:
    def rows(kind: str, box: str = "-5 10 50 210") -> list:
        words = CAR.split()
        words[2], words[6:10] = kind, box.split()
        words[1] = "-1" if kind == "DontCare" else "3"
        row = label_row(words, "here")[1]
        return [] if row is None else [row]

    classes = {"Car": 2, "Van": 2, "Truck": 7, "Pedestrian": 0, "Person": 0, "Person_sitting": 0, "Cyclist": 1}
    for kind, class_id in classes.items():
        truth = ground_truth(rows(kind), (100, 200))
        assert truth.class_ids.tolist() == [class_id]
        assert truth.boxes_xyxy.tolist() == [[0, 10, 50, 200]]
        assert truth.ignored_boxes_xyxy is None
    assert rows("Tram") == rows("Misc") == []
    dont_care = ground_truth(rows("DontCare"), (100, 200))
    assert dont_care.ignored_boxes_xyxy is not None
    assert dont_care.ignored_boxes_xyxy.tolist() == [[0, 10, 50, 200]]
    assert len(dont_care) == 0
    assert len(ground_truth(rows("Car", "120 10 150 20"), (100, 200))) == 0


@pytest.mark.parametrize(
    ("place", "word", "message"),
    [(0, "x", "frame is 'x'"), (1, "1.5", "track_id is '1.5'"), (2, "Tractor", "type is 'Tractor'"),
     (3, "7", "truncated is '7'"), (4, "-1", "occluded is '-1'"), (6, "nan", "left is 'nan'"),
     (8, "9.0", "has no area"), (16, None, "16 columns")],
)  # fmt: skip
def test_bad_label_row(tmp_path: Path, place: int, word: str | None, message: str) -> None:
    words = CAR.split()
    words[place : place + 1] = [] if word is None else [word]
    spec = single(tmp_path, [CAR, " ".join(words), CAR.replace("0 3", "1 3", 1)])
    with pytest.raises(SourceError, match=message) as error:
        open_kitti(spec, SourceOptions())
    assert "label_02/0000.txt line 2" in str(error.value)
    skipping = BadFrames(skip=True)
    truths = [frame.truth for frame in open_kitti(spec, SourceOptions(bad_frames=skipping))]
    assert [len(truth) for truth in truths if truth is not None] == [1, 1]
    assert len(skipping.skipped) == 1


def test_damaged_images(tmp_path: Path) -> None:
    spec = single(tmp_path, [CAR], images=4)
    images = tmp_path / "training/image_02/0000"
    whole = (images / "000001.png").read_bytes()
    (images / "000001.png").write_bytes(whole[: len(whole) // 2])
    cv2.imwrite(str(images / "000002.png"), np.zeros((50, 100, 3), np.uint8))
    with pytest.raises(SourceError, match=r"000001\.png"):
        frames_of(open_kitti(spec, SourceOptions()))
    skipping = BadFrames(skip=True)
    frames = frames_of(open_kitti(spec, SourceOptions(bad_frames=skipping)))
    assert [(frame.index, frame.capture_time_ns) for frame in frames] == [(0, 0), (1, 300_000_000)]
    assert len(skipping.skipped) == 2
    assert "100x50" in skipping.skipped[1]
    (images / "000000.png").write_bytes(b"")
    second = BadFrames(skip=True)
    assert len(frames_of(open_kitti(spec, SourceOptions(max_frames=4, bad_frames=second)))) == 1


def test_missing_parts(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SourceError, match=r"training/image_02.*https://www\.cvlibs\.net"):
        open_kitti(str(tmp_path), SourceOptions())
    spec = single(tmp_path, [CAR])
    labels, calibration = tmp_path / "training/label_02/0000.txt", tmp_path / "training/calib/0000.txt"
    oxts = tmp_path / "training/oxts/0000.txt"
    good = calibration.read_text()
    for text, message in (
        (good.replace("Tr_imu_velo", "Tr_other"), "has no Tr_imu_to_velo or Tr_imu_velo; found P0"),
        (good.replace("P2: ", "P2: x "), "line 3: P2 is 'x "),
        ("P2: " + "0 " * 12 + good[good.index("R_rect") - 1 :], "no focal length"),
    ):
        calibration.write_text(text)
        with pytest.raises(SourceError, match=message):
            open_kitti(spec, SourceOptions())
    calibration.unlink()
    with pytest.raises(SourceError, match=r"calib/0000\.txt.*https://www\.cvlibs\.net"):
        open_kitti(spec, SourceOptions())
    calibration.write_text(good)
    oxts.write_text("\n1 2 3\n")
    with pytest.raises(SourceError, match=r"oxts/0000\.txt line 2: 3 values"):
        open_kitti(spec, SourceOptions())
    labels.unlink()
    with pytest.raises(SourceError, match=r"label_02/0000\.txt"):
        open_kitti(spec, SourceOptions(bad_frames=BadFrames(skip=True)))
    labels.parent.rmdir()
    with caplog.at_level(logging.WARNING):
        source = open_kitti(spec, SourceOptions(bad_frames=BadFrames(skip=True)))
    assert [(frame.truth, frame.ego) for frame in source] == [(None, None)] * 2
    assert "no line for 2 frames, the first is 0" in caplog.text
    for image in (tmp_path / "training/image_02/0000").iterdir():
        image.unlink()
    with pytest.raises(SourceError, match="no PNG or JPEG"):
        open_kitti(spec, SourceOptions())


def test_time_stamps_of_raw_style(tmp_path: Path) -> None:
    spec = single(tmp_path, [])
    stamps = tmp_path / "training/image_02/0000/timestamps.txt"
    stamps.write_text("2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.064389445\n")
    times = [frame.capture_time_ns for frame in open_kitti(spec, SourceOptions())]
    assert times == [1317042145964389445, 1317042146064389445]
    assert open_kitti(spec, SourceOptions()).fps == pytest.approx(10.0)
    for text, message in (
        ("2011-09-26 13:02:25.9\nnoon\n", "line 2: 'noon'"),
        ("2011-09-26 13:02:25.9\n", "1 lines, none for image 1"),
        ("2011-09-26 13:02:25.9\n2011-09-26 13:02:25.9\n", "not after"),
    ):
        stamps.write_text(text)
        with pytest.raises(SourceError, match=message):
            open_kitti(spec, SourceOptions())


@given(st.integers(0, 4_000_000_000_000_000_000))
def test_stamps_keep_every_nanosecond(time_ns: int) -> None:
    text = str(np.datetime64(time_ns, "ns")).replace("T", " ")
    assert stamp_ns(text) == time_ns
    assert stamp_text(time_ns) == text


def test_no_stamps(tmp_path: Path) -> None:
    assert [stamp_ns(text) for text in ("", "2011-13-01 00:00:00", "2011-01-01 00:00:00.1234567890")] == [None] * 3
    with pytest.raises(SourceError, match="can't read time stamps"):
        read_stamps(tmp_path / "timestamps.txt")


@needs_long_clip
def test_real_sequence() -> None:
    """Sequence 0002, frames 36 to 65, beside a literal reading of its label file and an estimate of its motion."""
    log = LONG_CLIP / "ego" / "ego_motion_from_pose.csv"
    source = open_kitti(f"{LONG_CLIP}#0002", SourceOptions(ego_csv=log))
    assert (source.name, source.fps, source.size_wh, source.frame_count) == ("kitti-0002", 10.0, (1242, 375), 30)
    rows = [line.split() for line in (LONG_CLIP / "training/label_02/0002.txt").read_text().splitlines()]
    kinds = {"Car": 2, "Van": 2, "Pedestrian": 0}
    frame = None
    for number, frame in zip(range(36, 66), source, strict=True):
        here = [row for row in rows if int(row[0]) == number and row[2] in kinds]
        assert frame.truth is not None
        assert frame.truth.track_ids.tolist() == [int(row[1]) for row in here]
        assert frame.truth.class_ids.tolist() == [kinds[row[2]] for row in here]
        assert frame.truth.boxes_xyxy == pytest.approx(np.array([row[6:10] for row in here], float), abs=1e-3)
        ignored = frame.truth.ignored_boxes_xyxy
        dont_care = sum(int(row[0]) == number and row[2] == "DontCare" for row in rows)
        assert (0 if ignored is None else len(ignored)) == dont_care
        if number == 36:
            assert frame.ego == EgoMotion(12.535, 0.0, -0.029261)
    assert frame is not None
    assert frame.capture_time_ns == 6_500_000_000
    # Published in the sensor set-up: 0.81 m from IMU to lidar and 0.27 m on to the cameras, all level.
    assert source.mount.forward_m == pytest.approx(1.08, abs=0.01)
    assert abs(source.mount.pitch_down_rad) < math.radians(1)
    assert source.intrinsics == CameraIntrinsics(721.5377, 721.5377, 609.5593, 172.854)


@needs_mini
def test_real_fragments() -> None:
    assert sequences(MINI) == ["0001", "0016"]
    source = open_kitti(f"{MINI}#0016", SourceOptions(size=(612, 185)))
    frames = frames_of(source)
    assert source.fps == 2.0
    assert [frame.capture_time_ns for frame in frames] == [200_000_000, 700_000_000, 1_200_000_000]
    lines = (MINI / "training/label_02/0016.txt").read_text().splitlines()
    for number, frame in zip((2, 7, 12), frames, strict=True):
        rows = [line.split() for line in lines if line.startswith(f"{number} ") and "DontCare" not in line]
        assert frame.truth is not None
        edges = np.array([row[6:10] for row in rows], float) / 2
        assert frame.truth.boxes_xyxy == pytest.approx(edges, abs=1e-3)
        kinds = {"Pedestrian": 0, "Cyclist": 1, "Car": 2}
        assert frame.truth.class_ids.tolist() == [kinds[row[2]] for row in rows]
