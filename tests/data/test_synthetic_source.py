"""The rendered world: interface, determinism, population."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.errors import ConfigurationError
from cable_rpc.types import COCO_ROAD_USERS


@lru_cache(maxsize=32)
def small(seed: int, **changes: float) -> SyntheticSource:
    settings = {"width": 320, "height": 180, "frame_count": 60, **changes}
    return SyntheticSource(SyntheticConfig(seed=seed, **settings))  # type: ignore[arg-type]


def test_interface() -> None:
    source = small(3, frame_count=4, fps=12.5)
    assert (source.name, source.fps, source.size_wh, source.frame_count, len(source)) == (
        "synthetic:3", 12.5, (320, 180), 4, 4,
    )  # fmt: skip
    frames = list(source)
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert [frame.capture_time_ns for frame in frames] == [0, 80_000_000, 160_000_000, 240_000_000]
    image = frames[0].image
    assert image.shape == (180, 320, 3)
    assert image.dtype == np.uint8
    assert image.flags.c_contiguous
    assert frames[0].intrinsics == source.camera.intrinsics


def test_same_seed_same_frames_in_any_order() -> None:
    forward = list(small(5, frame_count=6))
    other = SyntheticSource(SyntheticConfig(seed=5, width=320, height=180, frame_count=6))
    for index in (5, 0, 3, 0):
        frame = other.frame(index)
        assert np.array_equal(frame.image, forward[index].image)
        assert frame.truth is not None
        assert forward[index].truth is not None
        assert np.array_equal(frame.truth.boxes_xyxy, forward[index].truth.boxes_xyxy)  # type: ignore[union-attr]
        assert np.array_equal(frame.truth.instance_mask, forward[index].truth.instance_mask)  # type: ignore[union-attr, arg-type]
        assert frame.ego == forward[index].ego


def test_seeds_differ() -> None:
    pictures = [small(seed).frame(0).image for seed in (0, 1, 3)]
    for a, b in ((0, 1), (1, 2), (0, 2)):
        assert np.abs(pictures[a].astype(int) - pictures[b]).mean() > 5.0


def test_noise_is_new_in_every_frame_and_absent_when_off() -> None:
    still = small(3, noise_strength=0.0, frame_count=2)
    noisy = small(3, noise_strength=3.0, frame_count=2)
    residual = [noisy.frame(i).image.astype(float) - still.frame(i).image for i in (0, 1)]
    inner = [part[40:140, 40:280].ravel() for part in residual]
    assert 0.5 < inner[0].std() < 8.0
    assert abs(np.corrcoef(inner[0], inner[1])[0, 1]) < 0.05


@pytest.mark.parametrize(("width", "height"), [(321, 181), (64, 48), (127, 255), (481, 33)])
def test_odd_sizes(width: int, height: int) -> None:
    frame = small(1, width=width, height=height, frame_count=2).frame(1)
    assert frame.image.shape == (height, width, 3)
    assert frame.truth is not None
    assert frame.truth.instance_mask is not None
    assert frame.truth.instance_mask.shape == (height, width)


def test_truth_agrees_with_the_instance_mask() -> None:
    for seed in range(4):
        source = small(seed)
        for index in (0, 30):
            truth = source.frame(index).truth
            assert truth is not None
            mask = truth.instance_mask
            assert mask is not None
            assert mask.dtype == np.int32
            assert set(np.unique(mask)) - {0} == set(range(1, len(truth) + 1))
            assert len(set(truth.track_ids.tolist())) == len(truth)
            assert set(truth.class_ids.tolist()) <= set(COCO_ROAD_USERS)
            assert np.all((truth.visibility > 0.0) & (truth.visibility <= 1.0))
            for row, box in enumerate(truth.boxes_xyxy):
                y, x = np.nonzero(mask == row + 1)
                assert box.tolist() == [x.min(), y.min(), x.max() + 1, y.max() + 1]
                assert 0 <= box[0] < box[2] <= 320
                assert 0 <= box[1] < box[3] <= 180


def test_tracks_are_stable_and_move_smoothly() -> None:
    source = small(0)
    before = source.frame(10).truth
    after = source.frame(11).truth
    assert before is not None
    assert after is not None
    classes = dict(zip(before.track_ids.tolist(), before.class_ids.tolist(), strict=True))
    centres = {
        track: (box[:2] + box[2:]) / 2
        for track, box, seen in zip(before.track_ids.tolist(), before.boxes_xyxy, before.visibility, strict=True)
        if seen > 0.95
    }
    common = 0
    for track, box, kind, seen in zip(
        after.track_ids.tolist(), after.boxes_xyxy, after.class_ids.tolist(), after.visibility, strict=True
    ):
        assert classes.get(track, kind) == kind
        if track in centres and seen > 0.95:
            common += 1
            size = float(max(box[2:] - box[:2]))
            assert np.abs((box[:2] + box[2:]) / 2 - centres[track]).max() < max(6.0, 0.5 * size)
    assert common >= 3


def test_hidden_share_counts_occluders_and_the_image_border() -> None:
    partly = 0
    for seed in range(4):
        truth = small(seed).frame(20).truth
        assert truth is not None
        at_border = (truth.boxes_xyxy[:, 0] <= 0) | (truth.boxes_xyxy[:, 2] >= 320)
        partly += int((truth.visibility[at_border] < 0.98).sum())
        assert (truth.visibility > 0.95).any()
    assert partly >= 1


def test_all_classes_occur_over_seeds() -> None:
    seen: set[int] = set()
    for seed in range(12):
        source = small(seed)
        for index in (0, 30):
            truth = source.frame(index).truth
            assert truth is not None
            seen |= set(truth.class_ids.tolist())
        if seen >= {0, 1, 2, 5, 7}:
            break
    assert seen >= {0, 1, 2, 5, 7}


@pytest.mark.parametrize(
    "bad",
    [
        {"seed": -1},
        {"height": 8, "width": 99},
        {"fps": 0.0},
        {"fps": float("nan")},
        {"frame_count": 0},
        {"horizontal_fov_deg": 179.0},
    ],
)
def test_bad_settings_say_what_is_wrong(bad: dict[str, float]) -> None:
    named = "99x8" if "width" in bad else next(iter(bad))
    with pytest.raises(ConfigurationError, match=named):
        SyntheticConfig(**bad)  # type: ignore[arg-type]


def test_index_outside_the_clip() -> None:
    source = small(0, frame_count=3)
    for index in (-1, 3):
        with pytest.raises(IndexError, match=r"0\.\.2"):
            source.frame(index)
