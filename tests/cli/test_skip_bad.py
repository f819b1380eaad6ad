"""``--skip-bad`` leaves damage out and lists it at the end."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from cable_rpc.cli.app import app
from cable_rpc.cli.skip_bad import bad_frames_listed
from cable_rpc.data.coco import write_coco
from cable_rpc.data.rendered_drive import RenderedDrive
from cable_rpc.data.synthetic import SyntheticConfig
from cable_rpc.errors import ConfigurationError, SourceError


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of one drive, its second image cut off."""
    root = tmp_path_factory.mktemp("damaged")
    write_coco(root, {"drive": RenderedDrive(SyntheticConfig(seed=3, width=160, height=96, frame_count=4))})
    image = root / "images" / "drive" / "000001.jpg"
    image.write_bytes(image.read_bytes()[:-30])
    return root


def test_inspect_goes_on_without_a_damaged_frame(damaged: Path, shared_detector: Path, tmp_path: Path) -> None:
    arguments = ["inspect", "--source", f"wod_zb:{damaged}", "--detector", f"onnx:{shared_detector}", "--frame", "2"]
    arguments += ["--out", str(tmp_path / "sheet.png"), "--mode", "paper"]
    done = CliRunner().invoke(app, [*arguments, "--skip-bad"])
    assert done.exit_code == 0, done.output
    *_, wrote, skipped = done.stdout.strip().splitlines()
    assert wrote == f"wrote {tmp_path / 'sheet.png'}"
    assert skipped.startswith(f"skipped: {damaged}/images/drive/000001.jpg: the image is cut off")
    with pytest.raises(SourceError, match=r"000001\.jpg: the image is cut off"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)


def test_the_list_is_short_and_comes_after_errors_too(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigurationError), bad_frames_listed(skip=True) as bad_frames:
        for number in (*range(12), 3):
            bad_frames.found(SourceError(f"labels.txt line {number}: bad"))
        raise ConfigurationError("another matter")
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["skipped: labels.txt line 0: bad", "skipped: labels.txt line 1: bad"]
    assert lines[-1] == "skipped: 2 more, each in the log on stderr"
    assert len(lines) == 11


@pytest.mark.parametrize("command", ["stream", "inspect", "figure"])
def test_commands_have_the_option(command: str) -> None:
    shown = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200"})
    assert "--skip-bad" in shown.output
