"""The verification that a user runs on his own weights, here on a tiny checkpoint."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_lisa import SHORT_ANSWER, build_tiny_lisa
from typer.testing import CliRunner

from cable_rpc.cli.app import app
from cable_rpc.study.mask_agreement import agreement, boundary_accuracy
from cable_rpc.study.verify_lisa import corridor, rotated


def verify(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["verify", "lisa", *arguments], catch_exceptions=True)
    return result.exit_code, result.output + str(result.exception or "")


def test_verification_recommends_only_what_keeps_the_masks(tmp_path: Path) -> None:
    model = build_tiny_lisa(tmp_path / "model")
    code, text = verify(
        *("--model", str(model), "--source", "synthetic:3", "--size", "320x180", "--frames", "3"),
        *("--coverage", "0.25", "--threads", "1", "--out", str(tmp_path / "report.json")),
    )
    assert code == 0, text
    report = json.loads((tmp_path / "report.json").read_text())["verification"]
    rows = {row["variant"]["name"]: row for row in report["results"]}
    assert rows["published (generated)"]["to_published"] == {"region": 1.0, "boundary": 1.0}
    assert rows["nothing left out"]["to_region"] == {"region": 1.0, "boundary": 1.0}
    assert report["forced_equal"] == report["frames"] == 2
    assert rows["image_tokens=drop"]["token_share"] < 1 == rows["sam_windows=skip"]["token_share"]
    recommended = rows[report["recommended"]["name"]]
    assert recommended["to_region"]["region"] >= 0.95
    good = [row for row in rows.values() if row["variant"]["shown"] == "region" and not row["variant"]["crop"]]
    good = [row for row in good if row["to_region"]["region"] >= 0.95]
    assert recommended["wall_ms"] == min(row["wall_ms"] for row in good)
    assert f"recommended: {recommended['variant']['name']}" in text


def test_forced_answer_that_the_model_would_not_give_is_told(tmp_path: Path) -> None:
    model = build_tiny_lisa(tmp_path / "model", says=SHORT_ANSWER)
    code, text = verify(
        *("--model", str(model), "--source", "synthetic:3", "--size", "160x90", "--frames", "2"),
        *("--coverage", "0.5", "--threads", "1"),
    )
    assert code == 0, text
    assert "on 0 of 1 frames" in text
    assert "leave decoding=forced with its checks on" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "nothing to verify"),
        (("--model", "somewhere"), "--source"),
        (("--model", "/no/such", "--source", "synthetic:1"), "no/such"),
        (("--golden", "/no/such"), "no/such"),
        (("--model", "x", "--source", "synthetic:1", "--dtype", "int3"), "--dtype"),
        (("--model", "x", "--source", "synthetic:1", "--device", "abacus"), "abacus"),
    ],
)
def test_wrong_arguments_are_named(arguments: tuple[str, ...], message: str) -> None:
    code, text = verify(*arguments)
    assert code != 0
    assert message in text


def literal_boundary_accuracy(found: np.ndarray, reference: np.ndarray) -> float:
    """F by the distance of every boundary pixel to every other."""
    radius = int(np.ceil(0.008 * np.hypot(*found.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    reach = {(int(y) - radius, int(x) - radius) for y, x in np.argwhere(disc)}

    def points(mask: np.ndarray) -> set[tuple[int, int]]:
        height, width = mask.shape
        near = [(0, 1), (1, 0), (1, 1)]
        return {
            (y, x)
            for y in range(height)
            for x in range(width)
            if any(y + dy < height and x + dx < width and mask[y, x] != mask[y + dy, x + dx] for dy, dx in near)
        }

    a, b = points(found), points(reference)
    if not a or not b:
        return float(not a and not b)

    def hits(these: set[tuple[int, int]], those: set[tuple[int, int]]) -> float:
        return sum(any((y + dy, x + dx) in those for dy, dx in reach) for y, x in these) / len(these)

    precision, recall = hits(a, b), hits(b, a)
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


@given(st.integers(0, 10_000), st.integers(6, 24), st.integers(6, 24))
def test_boundary_accuracy_is_the_literal_one(seed: int, height: int, width: int) -> None:
    random = np.random.default_rng(seed)
    masks = [cv2.blur(random.random((height, width)), (3, 3)) > random.uniform(0.3, 0.7) for _ in range(2)]
    assert boundary_accuracy(*masks) == pytest.approx(literal_boundary_accuracy(*masks))


def test_agreement_of_known_shapes() -> None:
    mask = np.zeros((200, 300), np.bool_)
    mask[50:100, 60:160] = True
    assert agreement(mask, mask).mean == 1.0
    assert agreement(np.zeros_like(mask), np.zeros_like(mask)).mean == 1.0
    assert agreement(mask, np.zeros_like(mask)).mean == 0.0
    shifted = np.roll(mask, 50, axis=1)
    assert agreement(mask, shifted).region == pytest.approx(1 / 3)
    assert boundary_accuracy(mask, np.roll(mask, 2, axis=1)) == 1.0


def test_corridor_has_the_share_asked_for() -> None:
    assert corridor(720, 1280, 0.25).coverage == pytest.approx(0.25, abs=0.006)
    assert corridor(9, 9, 0.0).coverage > 0
    assert corridor(720, 1280, 1.0).coverage == 1.0


def test_every_variant_is_first_once() -> None:
    assert [rotated("abc", number)[0] for number in range(4)] == ["a", "b", "c", "a"]
