"""The original code's tensors, reproduced through the public loader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from cable_models.lisa import FrameRequest, LisaOptions, LisaPipeline, load_lisa
from cable_models.lisa.golden import compare_golden
from cable_models.lisa.loader import LoadedLisa
from cable_models.lisa.options import PLAIN

GOLDENS = Path(__file__).resolve().parents[3] / "shared" / "golden"
FOLDERS = sorted(path for path in GOLDENS.glob("lisa_*") if (path / "outputs_forced.npz").is_file())

pytestmark = pytest.mark.skipif(not FOLDERS, reason=f"no reference tensors of the original code in {GOLDENS}")


@pytest.fixture(scope="module", params=FOLDERS, ids=lambda path: path.name)
def golden(request: pytest.FixtureRequest) -> tuple[LoadedLisa, Path]:
    torch.set_num_threads(1)
    return load_lisa(str(request.param), dtype=torch.float32), request.param


def test_every_stage_is_that_of_the_original(golden: tuple[LoadedLisa, Path]) -> None:
    loaded, folder = golden
    errors = compare_golden(loaded, folder)
    assert len(errors) >= 30
    assert {error.stage for error in errors} == {"inputs", "features", "forced", "generate"}
    assert [error for error in errors if not error.passed] == []


@pytest.mark.parametrize("path", ["generate", "forced"])
def test_pipeline_gives_the_masks_of_the_original(golden: tuple[LoadedLisa, Path], path: str) -> None:
    loaded, folder = golden
    inputs, outputs = np.load(folder / "inputs.npz"), np.load(folder / f"outputs_{path}.npz")
    frame = np.ascontiguousarray(inputs["image_uint8"][..., ::-1])
    prompt = inputs["input_ids_prompt"][0].tolist()
    answer = tuple(outputs["token_ids"][0].tolist()[len(prompt) :])
    options = PLAIN if path == "generate" else LisaOptions(forced_ids=answer, verify_frames=0)
    (found,) = LisaPipeline(loaded, options).segment([FrameRequest(frame, None, prompt)])
    assert found.answer_ids == answer
    assert found.forced == (path == "forced")
    assert np.count_nonzero(found.masks != outputs["masks"]) <= 1e-4 * outputs["masks"].size
    scale = np.abs(outputs["mask_logits"]).max()
    np.testing.assert_allclose(found.mask_logits, outputs["mask_logits"], atol=1e-4 * scale, rtol=0)


def test_a_forced_answer_that_greedy_decoding_would_not_give_is_generated_instead(
    golden: tuple[LoadedLisa, Path],
) -> None:
    loaded, folder = golden
    inputs, outputs = np.load(folder / "inputs.npz"), np.load(folder / "outputs_generate.npz")
    frame = np.ascontiguousarray(inputs["image_uint8"][..., ::-1])
    prompt = inputs["input_ids_prompt"][0].tolist()
    greedy = tuple(outputs["token_ids"][0].tolist()[len(prompt) :])
    wrong = tuple(inputs["input_ids_forced"][0].tolist()[len(prompt) :])
    assert wrong != greedy
    pipeline = LisaPipeline(loaded, LisaOptions(forced_ids=wrong))
    first, second = (pipeline.segment([FrameRequest(frame, None, prompt)])[0] for _ in range(2))
    assert (first.forced, first.agrees, first.answer_ids) == (False, False, greedy)
    assert (second.forced, second.agrees, second.answer_ids) == (True, True, greedy)
    assert np.count_nonzero(second.masks != outputs["masks"]) <= 1e-4 * outputs["masks"].size
