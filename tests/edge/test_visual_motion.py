"""View motion from pictures against known homographies and the rendered world."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.edge.visual_motion import estimate_view_motion, is_plausible

SIZE = (225, 400)


def texture(seed, size=SIZE):
    """Blobs of all sizes, as pictures have them: amplitude falls with frequency."""
    rng = np.random.default_rng(seed)
    noise = sum(
        scale * cv2.GaussianBlur(rng.standard_normal(size).astype(np.float32), (0, 0), scale) for scale in (1, 3, 9)
    )
    return cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def corner_error(estimate, truth, size=SIZE):
    height, width = size
    corners = np.array([[[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]]], np.float64)
    moved, expected = cv2.perspectiveTransform(corners, estimate), cv2.perspectiveTransform(corners, truth)
    return np.abs(moved - expected).max()


MOTIONS = {
    "nothing": np.eye(3),
    "turn": np.array([[1.0, 0, 9.3], [0, 1, 0.4], [0, 0, 1]]),
    "zoom": np.array([[1.04, 0, -8], [0, 1.04, -4.5], [0, 0, 1]]),
    "roll": np.array([[0.9994, -0.035, 3], [0.035, 0.9994, -6], [0, 0, 1]]),
    "perspective": np.array([[1.01, 0.003, -2], [0.002, 1.02, -3], [1e-5, 6e-5, 1]]),
}


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("seed", [0, 1])
def test_known_homography_is_found(name, seed):
    truth = MOTIONS[name]
    before = texture(seed)
    after = cv2.warpPerspective(before, truth, SIZE[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    warp = estimate_view_motion(before, after, None)
    assert warp is not None
    assert warp.far is None
    assert corner_error(warp.ground, truth) < 0.3


def test_moving_actors_are_left_out():
    before = texture(3)
    truth = MOTIONS["turn"]
    after = cv2.warpPerspective(before, truth, SIZE[::-1], borderMode=cv2.BORDER_REFLECT)
    moving = np.zeros(SIZE, np.bool_)
    moving[40:200, 60:320] = True
    after[40:200, 60:320] = before[40:200, 60:320]
    warp = estimate_view_motion(before, after, moving)
    assert warp is not None
    assert corner_error(warp.ground, truth) < 0.5


def test_answer_is_always_the_same():
    before, after = texture(4), np.roll(texture(4), 5, axis=1)
    first = estimate_view_motion(before, after, None)
    cv2.setRNGSeed(77)
    assert np.array_equal(estimate_view_motion(before, after, None).ground, first.ground)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (np.full(SIZE, 90, np.uint8), np.full(SIZE, 90, np.uint8)),
        (texture(5), texture(6)),
        (texture(5), np.zeros(SIZE, np.uint8)),
        (texture(7, (12, 300)), texture(7, (12, 300))),
        (texture(8, (3, 3)), texture(8, (3, 3))),
    ],
    ids=["blank", "cut", "black", "thin", "tiny"],
)
def test_nothing_to_follow_gives_none(before, after):
    assert estimate_view_motion(before, after, None) is None


def test_everything_moving_gives_none():
    assert estimate_view_motion(texture(1), texture(1), np.ones(SIZE, np.bool_)) is None


@pytest.mark.parametrize(
    "homography",
    [
        np.diag([3.0, 3.0, 1.0]),
        np.diag([-1.0, 1.0, 1.0]),
        np.diag([0.2, 0.2, 1.0]),
        np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]]),
    ],
)
def test_absurd_homographies_are_refused(homography):
    assert not is_plausible(homography, SIZE)
    assert is_plausible(MOTIONS["perspective"], SIZE)


def test_rendered_turn_is_seen():
    source = SyntheticSource(SyntheticConfig(seed=7, width=800, height=450, frame_count=42))
    frames = [source.frame(index) for index in (39, 40)]
    small = [
        cv2.resize(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), (400, 225), interpolation=cv2.INTER_AREA)
        for frame in frames
    ]
    moving = (frames[0].truth.instance_mask > 0)[::2, ::2].copy()
    warp = estimate_view_motion(*small, moving)
    assert warp is not None
    # What is far, at the horizon straight ahead, moves by f tan(psi) to the right when turning left.
    (begin, _), (end, _) = (source.world.ego(frame.index / 10) for frame in frames)
    camera = source.camera
    x, y = 199.5, (camera.horizon_row + 0.5) / 2 - 0.5
    u, v, w = warp.ground @ (x, y, 1.0)
    expected = camera.intrinsics.fx / 2 * math.tan(end.heading - begin.heading)
    assert abs(expected) > 3
    assert u / w - x == pytest.approx(expected, abs=1.0)
    assert v / w - y == pytest.approx(0.0, abs=1.0)


def test_large_pictures_are_followed_at_a_smaller_size():
    """Twelve hundred columns and a shift of 45 pixels, beyond the reach of the features at full size."""
    small = texture(3)
    before = cv2.resize(small, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)[:, :1199]
    truth = np.array([[1.0, 0, 45], [0, 1, 6], [0, 0, 1]])
    after = cv2.warpPerspective(before, truth, before.shape[::-1], borderMode=cv2.BORDER_REFLECT)
    moving = np.zeros(before.shape, np.bool_)
    moving[:100, :100] = True
    warp = estimate_view_motion(before, after, moving)
    assert warp is not None
    corners = np.array([[0, 1198, 0, 1198], [0, 0, before.shape[0] - 1, before.shape[0] - 1], [1, 1, 1, 1]])
    mapped = warp.ground @ corners
    assert np.abs(mapped[:2] / mapped[2] - (truth @ corners)[:2]).max() < 1.5
