"""`cable-rpc train segmenter`: what it renders, and that a stage can be run, stopped short and found again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import typer
from cable_models.training.segmentation_samples import read_segmented
from typer.testing import CliRunner

from cable_rpc.cli.train_segmenter import segmenter
from cable_rpc.data.synthetic import SyntheticSource
from cable_rpc.errors import SourceError
from cable_rpc.study.train_segmenter import TRAINING_PLAN, camvid_frames


def test_rendered_samples_are_the_worlds_truth_and_a_stage_learns_from_them(tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(segmenter)
    options = ["--frames", "1", "--held-out", "1", "--batch", "1", "--steps", "1"]
    result = CliRunner().invoke(app, [str(tmp_path), *options, "--stage", "render", "--stage", "encoder"])
    assert result.exit_code == 0, result.output
    assert "encoder step 1: loss dense" in result.output
    assert (tmp_path / "encoder.pt").is_file()

    (entry,) = read_segmented(tmp_path / "train")
    seed, index = (int(part) for part in entry.image_path.stem.split("_"))
    truth = SyntheticSource(TRAINING_PLAN.world(seed)).frame(index).truth
    assert truth is not None
    assert truth.instance_mask is not None
    np.testing.assert_array_equal(entry.load().instances, truth.instance_mask)


def test_camvid_labels_become_classes(tmp_path: Path) -> None:
    shared = Path(__file__).resolve().parents[3] / "shared" / "data" / "camvid-0016E5"
    if not shared.is_dir():
        pytest.skip("the CamVid clip is not on this machine")
    frames = camvid_frames(shared)
    assert len(frames) == 46
    assert set(np.unique(frames[0].classes)) == {0, 1, 2, 3}
    with pytest.raises(SourceError, match="holds no images"):
        camvid_frames(tmp_path)
