"""`cable-rpc inspect` as a person meets it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from cable_rpc.cli.app import app
from cable_rpc.cli.inspect import write_png
from cable_rpc.errors import ConfigurationError

SMALL = ["--source", "synthetic:8", "--size", "160x96"]


def inspect(*arguments: str) -> str:
    """Runs the command in this process; its own errors pass through."""
    done = CliRunner().invoke(app, ["inspect", *arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Five pictures of a bright box on its way to the right, without truth."""
    folder = tmp_path / "drive"
    folder.mkdir()
    for index in range(5):
        image = np.full((96, 160, 3), 90, np.uint8)
        image[30:60, 20 + 4 * index : 60 + 4 * index] = 230
        cv2.imwrite(str(folder / f"{index:03d}.png"), image)
    return folder


def test_writes_one_sheet_of_both_modes(tmp_path: Path) -> None:
    both, paper = tmp_path / "new" / "both.png", tmp_path / "paper.png"
    assert str(both) in inspect(*SMALL, "--frame", "5", "--lead-in", "2", "--out", str(both))
    inspect(*SMALL, "--frame", "5", "--lead-in", "2", "--mode", "paper", "--out", str(paper))
    sheets = [cv2.imread(str(path)) for path in (both, paper)]
    assert all(sheet is not None and sheet.shape[1] == 2020 for sheet in sheets)
    assert sheets[0].shape[0] > 1.8 * (sheets[1].shape[0] - 78)
    assert [path.name for path in both.parent.iterdir()] == ["both.png"]


def test_first_frame_and_changed_switches(tmp_path: Path) -> None:
    out = tmp_path / "first.png"
    inspect(*SMALL, "--frame", "0", "--mode", "robust", "--roi", "corridor=false", "--roi", "top_margin=0.2",
            "--delay", "2", "--out", str(out))  # fmt: skip
    assert out.exists()


def test_pictures_without_truth_take_a_detector(tmp_path: Path, pictures: Path, shared_detector: Path) -> None:
    out = tmp_path / "sheet.png"
    inspect("--source", f"video:{pictures}", "--fps", "10", "--frame", "4", "--detector", f"onnx:{shared_detector}",
            "--out", str(out))  # fmt: skip
    assert out.exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--frame", "120"], "synthetic:8 has 120 frames: give 0 to 119"),
        (["--frame", "1", "--mode", "fast"], "--mode is 'fast'"),
        (["--frame", "1", "--cloud", "sky"], "use truth or detector"),
        (["--frame", "1", "--cloud", "detector"], "give --detector embedded"),
        (["--frame", "1", "--detector", "yolo:x"], "no detector back end is called 'yolo'"),
        (["--frame", "1", "--roi", "speed=3"], "KEY=VALUE with one of the keys"),
        (["--frame", "1", "--mode", "paper", "--roi", "corridor=false"], "--roi changes the robust mode"),
        (["--frame", "1", "--out", "sheet.jpg"], "ends in .png"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_misuse_is_told(arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigurationError) as raised:
        inspect(*SMALL, *arguments)
    assert said in str(raised.value)
    assert list(tmp_path.iterdir()) == []


def test_recording_without_truth_asks_for_a_detector(pictures: Path) -> None:
    with pytest.raises(ConfigurationError, match="give --detector embedded or --detector onnx:FILE"):
        inspect("--source", f"video:{pictures}", "--fps", "10", "--frame", "2")


def test_recording_that_ends_before_says_how_long_it_is(tmp_path: Path, pictures: Path, shared_detector: Path) -> None:
    out = tmp_path / "sheet.png"
    with pytest.raises(ConfigurationError, match="has 5 frames: give 0 to 4"):
        inspect("--source", f"video:{pictures}", "--fps", "10", "--frame", "7", "--out", str(out),
                "--detector", f"onnx:{shared_detector}")  # fmt: skip
    assert not out.exists()


def test_unwritable_place_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    picture = np.zeros((4, 4, 3), np.uint8)
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    with pytest.raises(ConfigurationError, match="can't write the sheet"):
        write_png(blocked / "sheet.png", picture)
    taken = tmp_path / "folder.png"
    taken.mkdir()
    with pytest.raises(ConfigurationError, match="can't write the sheet"):
        write_png(taken, picture)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.png"]


def test_help_teaches() -> None:
    shown = CliRunner().invoke(app, ["inspect", "--help"])
    assert shown.exit_code == 0
    assert "cable-rpc inspect --source synthetic:8 --frame 40" in shown.output


def test_errors_are_one_line() -> None:
    command = [sys.executable, "-m", "cable_rpc", "inspect", *SMALL, "--frame", "1", "--mode", "fast"]
    failed = subprocess.run(command, capture_output=True, text=True, check=False)
    assert failed.returncode == 2
    assert len(failed.stderr.strip().splitlines()) == 1
