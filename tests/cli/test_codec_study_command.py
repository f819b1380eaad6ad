"""`cable-rpc codec-study` as a person meets it."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from cable_rpc.cli import codec_study as command
from cable_rpc.cli.app import app
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.study_points import POINTS_FILE

pytest.importorskip("scipy", reason="needs scipy, in the study extra")
pytest.importorskip("plotly", reason="needs plotly, in the study extra")

SMALL = ["synthetic:8", "--size", "192x112", "--frames", "3", "--workers", "1", "--treatment", "align8-zero"]


def study(*arguments: str) -> str:
    """Runs the command in this process; its own errors pass through."""
    done = CliRunner().invoke(app, ["codec-study", *arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def test_study_prints_tables_and_writes_files(tmp_path: Path) -> None:
    out = tmp_path / "new" / "study"
    shown = study(*SMALL, "--mask", "corridor", "--mask", "loop", "--out", str(out))
    assert "synthetic:8: 3 frames of 192x112 at 10 fps, region corridor, 2" in shown
    assert "region loop by truth" in shown
    assert "BD-rate in % against whole frames in H.264" in shown
    assert sorted(path.name for path in out.iterdir()) == [
        "codec_study.csv", "codec_study.html", "codec_study_bd.csv",
    ]  # fmt: skip
    before = (out / POINTS_FILE).read_text()
    assert len(before.splitlines()) == 1 + 2 * 2 * 5
    again = study(*SMALL, "--mask", "corridor", "--mask", "loop", "--out", str(out))
    assert (out / POINTS_FILE).read_text() == before
    assert again == shown


def test_codecs_and_qualities_are_chosen(tmp_path: Path) -> None:
    qualities = ["--quality", "jpeg=10,30", "--quality", "h264=20,24,28,32,36"]
    study(*SMALL, "--codec", "jpeg", *qualities, "--out", str(tmp_path))
    rows = [line.split(",") for line in (tmp_path / POINTS_FILE).read_text().splitlines()[1:]]
    assert [(row[3], row[4], row[5]) for row in rows] == [
        *(("whole", "h264", str(crf)) for crf in (20, 24, 28, 32, 36)),
        ("whole", "jpeg", "10"), ("whole", "jpeg", "30"), ("align8-zero", "jpeg", "10"), ("align8-zero", "jpeg", "30"),
    ]  # fmt: skip


def test_ctrl_c_says_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "run_study", stop)
    done = CliRunner().invoke(app, ["codec-study", *SMALL, "--out", str(tmp_path)])
    assert done.exit_code == 130
    assert "stopped: 0 of 2 cells are kept in" in done.stderr
    assert "the same command goes on from there" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--quality", "h264"], "write CODEC=A,B,C,D,E with whole numbers"),
        (["--quality", "h264=a,b"], "write CODEC=A,B,C,D,E with whole numbers"),
        (["--quality", "webp=1,2"], "add --codec webp"),
        (["--codec", "webp-lossless"], "no usual qualities are known for codec 'webp-lossless'"),
        (["--codec", "mpeg2", "--quality", "mpeg2=1,2"], "codec 'mpeg2' is unknown"),
        (["--treatment", "magic"], "treatment 'magic' is unknown; use some of whole"),
        (["--mask", "sky"], "mask 'sky' is unknown; use corridor or loop"),
        (["--size", "big"], "big"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_misuse_is_told(arguments: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as raised:
        study(*SMALL, *arguments, "--out", str(tmp_path))
    assert said in str(raised.value)


def test_missing_extra_is_told_before_anything_is_coded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command.importlib.util, "find_spec", lambda name: None if name == "scipy" else name)
    with pytest.raises(ConfigurationError, match=r"needs scipy: pip install 'cable-rpc\[study\]'"):
        study(*SMALL, "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_help_teaches() -> None:
    shown = CliRunner().invoke(app, ["codec-study", "--help"])
    assert shown.exit_code == 0
    assert "cable-rpc codec-study video:drive.mp4 synthetic:1 --frames 30" in shown.output
    assert "align8-zero" in shown.output
