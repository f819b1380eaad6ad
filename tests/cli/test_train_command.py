"""`cable-rpc train detector` from rendering to a checked ONNX file, very small."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from cable_rpc.cli.train import stop_on_signals, train_app

pytest.importorskip("transformers", reason="training needs transformers, in the cloud extra")


def command(work: Path, *options: str) -> str:
    """Runs it in this process; its own errors pass through."""
    app = typer.Typer()
    app.add_typer(train_app, name="train")
    small = ["--frames", "2", "--held-out", "1", "--batch", "1"]
    done = CliRunner().invoke(app, ["train", "detector", str(work), *small, *options], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return " ".join(done.stdout.split())


def test_detector_is_rendered_trained_continued_and_exported(tmp_path: Path) -> None:
    command(tmp_path, "--only", "render")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["held_out", "train"]
    assert len(list((tmp_path / "train").glob("*.jpg"))) == 2
    command(tmp_path, "--steps", "1", "--only", "train")
    state = tmp_path / "rtdetr_compact.state.safetensors"
    before = state.read_bytes()
    shown = command(tmp_path, "--steps", "2")
    assert "of torch" in shown
    assert "mean AP50" in shown
    assert "pedestrian" in shown
    assert state.read_bytes() != before
    assert (tmp_path / "rtdetr_compact_rendered.onnx").stat().st_size < 15_000_000


def test_signals_ask_for_a_stop_between_two_steps() -> None:
    import signal

    handler = signal.getsignal(signal.SIGTERM)
    with stop_on_signals() as stopped:
        assert not stopped.is_set()
        signal.raise_signal(signal.SIGTERM)
        assert stopped.is_set()
    assert signal.getsignal(signal.SIGTERM) is handler
