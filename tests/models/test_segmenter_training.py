"""Training of the compact LISA: its pieces against unmodified transformers modules and simple truths, and in small."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from cable_models.errors import ModelError
from cable_models.lisa.images import sam_input
from cable_models.lisa.loader import load_lisa
from cable_models.lisa.options import LisaOptions
from cable_models.lisa.pipeline import FrameRequest, LisaPipeline
from cable_models.training.samples import LabelledImage
from cable_models.training.segmentation_batches import BatchMaker, normalised
from cable_models.training.segmentation_encoder import encode_rows
from cable_models.training.segmentation_evaluation import evaluate_masks, object_region, token_segmenter
from cable_models.training.segmentation_export import CONCEPT_PROMPTS, export_segmenter
from cable_models.training.segmentation_language import CompactLisaConfig, clip_pixels
from cable_models.training.segmentation_losses import dense_loss, mask_loss
from cable_models.training.segmentation_muon import orthogonal
from cable_models.training.segmentation_prompts import ANSWER, Question
from cable_models.training.segmentation_samples import SegmentedImage, append_segmented, read_segmented
from cable_models.training.segmentation_stages import STAGES, SegmenterTraining, run_stage
from cable_models.training.segmentation_state import averaged
from cable_models.training.segmentation_trainer import StageConfig
from cable_models.training.segmentation_views import ViewConfig, changed_view, filled_outside, random_region
from cable_models.training.segmentation_vision import CONCEPTS, CompactSamConfig, VisionTrainee, concept_tokens
from cable_models.training.upload_views import grey
from torch.nn import functional

TINY_SAM = CompactSamConfig(image_size=96, width=32, layers=2, heads=2, window=2, global_layers=(1,), channels=32)
TINY = CompactLisaConfig(
    TINY_SAM, clip_image=28, clip_width=32, clip_layers=2, clip_heads=2, llama_width=32, llama_layers=1, llama_mlp=64
)
SIZE_HW = (54, 96)


def write_scenes(folder: Path, count: int) -> None:
    """Grey pictures with a blue car, a red pedestrian and a green cyclist, all plain rectangles."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(1)
    for number in range(count):
        image = np.full((*SIZE_HW, 3), 110, np.uint8)
        instances = np.zeros(SIZE_HW, np.int32)
        boxes = []
        for row, (colour, width, height) in enumerate(
            (((230, 60, 40), 30, 18), ((40, 40, 220), 8, 20), ((40, 200, 40), 12, 16))
        ):
            x, y = 32 * row + int(rng.integers(0, 32 - width + 1)), int(rng.integers(0, 34))
            image[y : y + height, x : x + width] = colour
            instances[y : y + height, x : x + width] = row + 1
            boxes.append((x, y, x + width, y + height))
        sample = LabelledImage(
            image, np.array(boxes, np.float32), np.array((2, 0, 1), np.int32), np.ones(3, np.float32)
        )
        append_segmented(folder, f"{number:03d}", sample, instances)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> SegmenterTraining:
    """Every stage of a tiny training."""
    torch.set_num_threads(1)
    work = tmp_path_factory.mktemp("segmenter")
    write_scenes(work / "train", 12)
    training = SegmenterTraining(work, TINY, batch=4, views=ViewConfig(crop=0.3, colour=0, region_only=0.2, jpeg=0))
    for stage, steps in zip(STAGES, (60, 70, 60), strict=True):
        config = StageConfig(1.0, steps, learning_rate=4e-3, matrix_rate=8e-3, warmup_steps=5, average_decay=0.9)
        assert run_stage(training, stage, config, lambda progress, segment: None)
    return training


def test_samples_come_back_as_they_were_written(tmp_path: Path) -> None:
    write_scenes(tmp_path / "scenes", 2)
    entries = read_segmented(tmp_path / "scenes")
    sample = entries[0].load()
    assert sample.table.tolist() == [0, 1, 2, 3]
    assert [int((sample.classes == index).sum()) for index in (1, 2, 3)] == [540, 160, 192]


def test_a_sample_without_its_instance_file_is_named(tmp_path: Path) -> None:
    write_scenes(tmp_path / "scenes", 1)
    (tmp_path / "scenes" / "000.ids.png").unlink()
    with pytest.raises(ModelError, match=r"000\.ids\.png"):
        read_segmented(tmp_path / "scenes")[0].load()


def test_encoder_over_all_rows_is_the_unmodified_module() -> None:
    torch.manual_seed(0)
    trainee = VisionTrainee(TINY_SAM)
    pixels = torch.randn(2, 3, 96, 96)
    with torch.no_grad():
        own = encode_rows(trainee.sam.vision_encoder, pixels)
        theirs = trainee.sam.vision_encoder(pixels).last_hidden_state
    assert float(theirs.std()) > 0.1
    torch.testing.assert_close(own, theirs, atol=2e-5, rtol=1e-4)


def test_masks_are_those_of_the_unmodified_sam() -> None:
    torch.manual_seed(0)
    trainee = VisionTrainee(TINY_SAM).eval()
    features = torch.randn(1, 32, 6, 6)
    tokens = torch.randn(2, 32)
    with torch.no_grad():
        own = trainee.masks(features, tokens)
        sam = trainee.sam
        theirs = [
            sam.mask_decoder(
                image_embeddings=features,
                image_positional_embeddings=sam.get_image_wide_positional_embeddings(),
                sparse_prompt_embeddings=token.reshape(1, 1, 1, 32),
                dense_prompt_embeddings=sam.prompt_encoder.no_mask_embed.weight.reshape(1, 32, 1, 1).expand(
                    1, 32, 6, 6
                ),
                multimask_output=False,
            )[0][0, 0, 0]
            for token in tokens
        ]
    torch.testing.assert_close(own[0], torch.stack(theirs))


def test_concept_tokens_stand_at_right_angles() -> None:
    tokens = concept_tokens(32)
    torch.testing.assert_close(tokens @ tokens.T / 32, torch.eye(len(CONCEPTS)), atol=1e-5, rtol=0)


def test_muon_makes_singular_values_near_one() -> None:
    torch.manual_seed(0)
    for shape in ((8, 24), (24, 8)):
        values = torch.linalg.svdvals(orthogonal(torch.randn(shape)))
        assert 0.6 < float(values.min()) <= float(values.max()) < 1.3


def test_views_keep_picture_and_truth_together() -> None:
    rng = np.random.default_rng(0)
    image = np.zeros((60, 100, 3), np.uint8)
    instances = np.zeros((60, 100), np.uint16)
    cv2.rectangle(instances, (20, 20), (60, 44), 1, -1)
    image[instances == 1] = 255
    sample = SegmentedImage(image, instances, np.array((0, 2), np.uint8))
    plain = ViewConfig(colour=0, region_only=0, jpeg=0)
    for _ in range(20):
        view = changed_view(sample, (48, 32), plain, rng)
        inside = cv2.erode((view.instances == 1).astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
        outside = cv2.dilate((view.instances == 1).astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
        assert view.image[inside].min(initial=255) > 200
        assert view.image[outside].max(initial=0) < 55


def test_what_a_fill_hides_is_no_object() -> None:
    rng = np.random.default_rng(3)
    sample = SegmentedImage(
        np.full((64, 64, 3), 77, np.uint8), np.ones((64, 64), np.uint16), np.array((0, 1), np.uint8)
    )
    region = np.zeros((64, 64), bool)
    region[8:24, 8:40] = True
    view = filled_outside(sample, region, grey)
    assert (view.classes[region] == 1).all()
    assert not view.classes[~region].any()
    assert (view.image[region] == 77).all()
    assert (view.image[~region] == 128).all()
    blocks = random_region(sample, rng).reshape(8, 8, 8, 8)
    assert (blocks.all(axis=(1, 3)) == blocks.any(axis=(1, 3))).all()


def test_batches_pad_below_the_picture(tmp_path: Path) -> None:
    write_scenes(tmp_path / "scenes", 3)
    maker = BatchMaker(tmp_path / "scenes", 96, 16, 2, ViewConfig())
    heights = set()
    for seed in range(12):
        batch = maker.next(np.random.default_rng(seed))
        taught = batch.shares.sum(1)
        heights.add(batch.pixels.shape[2])
        filled = int(taught[0, :, 0].sum())
        assert torch.allclose(taught[:, :filled], torch.ones(()))
        assert not taught[:, filled:].any()
        assert not batch.pixels[:, :, 4 * filled + 4 :].any()
    assert heights == {64, 96}


def test_losses_vanish_for_the_truth_and_not_otherwise() -> None:
    shares = torch.zeros(1, 4, 6, 6)
    shares[:, 0] = 1
    shares[:, :, 1:4, 1:4] = torch.tensor((0.0, 0.0, 1.0, 0.0))[None, :, None, None]
    assert float(dense_loss(40 * shares - 20, shares)) < 0.01
    assert float(dense_loss(-40 * shares, shares)) > 2
    target = shares[:, 2:3]
    assert float(mask_loss(40 * target - 20, target, torch.ones(1, 1, 6, 6))) < 0.01
    assert float(mask_loss(20 - 40 * target, target, torch.ones(1, 1, 6, 6))) > 2


def test_pooled_iou_of_a_known_mistake(tmp_path: Path) -> None:
    write_scenes(tmp_path / "scenes", 2)
    samples = [entry.load() for entry in read_segmented(tmp_path / "scenes")]

    def only_cars(image: np.ndarray, region: np.ndarray | None) -> np.ndarray:
        blue = (image[..., 0] > 170) & (image[..., 2] < 100)
        return np.stack([blue, blue, np.zeros_like(blue), np.zeros_like(blue)])

    figures = evaluate_masks(only_cars, samples)
    assert figures.iou[2:] == (0.0, 0.0)
    assert figures.iou[1] > 0.9
    assert figures.iou[0] == pytest.approx(540 / 892, abs=0.06)
    region = object_region(samples[0])
    assert region[samples[0].classes > 0].all()
    assert not region.all()


def test_stopped_and_resumed_training_is_the_unbroken_one(tmp_path: Path) -> None:
    write_scenes(tmp_path / "train", 4)
    config = StageConfig(1.0, steps=6, warmup_steps=2)
    steps = iter(range(3, 100))
    whole = SegmenterTraining(tmp_path, TINY, batch=2)
    assert run_stage(whole, "encoder", config, lambda progress, segment: None)
    unbroken = averaged(whole.checkpoint("encoder"))
    whole.checkpoint("encoder").unlink()
    assert not run_stage(whole, "encoder", config, lambda progress, segment: None, lambda: next(steps) >= 6)
    assert run_stage(whole, "encoder", config, lambda progress, segment: None)
    resumed = averaged(whole.checkpoint("encoder"))
    for name, value in unbroken.items():
        torch.testing.assert_close(resumed[name], value, atol=0, rtol=0)


def test_a_checkpoint_of_another_network_is_refused(trained: SegmenterTraining, tmp_path: Path) -> None:
    write_scenes(tmp_path / "train", 1)
    other = SegmenterTraining(tmp_path, CompactLisaConfig(), batch=1)
    other.checkpoint("encoder").write_bytes(trained.checkpoint("encoder").read_bytes())
    with pytest.raises(ModelError, match="isn't of this training"):
        run_stage(other, "encoder", StageConfig(1.0, steps=1), lambda progress, segment: None)


def test_the_vision_stages_learn_vehicles(trained: SegmenterTraining) -> None:
    vision = trained.fresh_vision()
    vision.load_state_dict(averaged(trained.checkpoint("decoder")))
    samples = [entry.load() for entry in read_segmented(trained.work / "train")]
    assert evaluate_masks(token_segmenter(vision), samples).iou[1] > 0.4


def test_the_saved_model_answers_as_the_trained_parts_do(trained: SegmenterTraining, tmp_path: Path) -> None:
    folder = export_segmenter(trained, tmp_path / "lisa", dtype=torch.float32)
    pipeline = LisaPipeline(load_lisa(folder), LisaOptions(verify_frames=1))
    image = read_segmented(trained.work / "train")[0].load().image
    (answer,) = pipeline.segment([FrameRequest(image, None, CONCEPT_PROMPTS[1])])
    assert answer.agrees, "greedy decoding doesn't say what was taught"

    language, vision = trained.fresh_language(), trained.fresh_vision()
    language.load_state_dict(averaged(trained.checkpoint("language")))
    vision.load_state_dict(averaged(trained.checkpoint("decoder")))
    pixels, (height, width) = sam_input(image, TINY_SAM.image_size)
    with torch.no_grad():
        images = language.image_tokens(torch.from_numpy(clip_pixels(image, TINY.clip_image))[None])
        prompt, words = language.ask(Question(CONCEPT_PROMPTS[1], "semantic", "human", 1), ANSWER)
        (states,) = language.states(images, [(prompt, words)])
        token = language.seg_token(states, [*prompt, *words], len(images[0]))
        masks = vision.masks(vision.features(torch.from_numpy(pixels)[None]), token[None])
    square = functional.interpolate(masks, size=(96, 96), mode="bilinear", align_corners=False)
    expected = functional.interpolate(square[..., :height, :width], size=SIZE_HW, mode="bilinear", align_corners=False)
    np.testing.assert_allclose(answer.mask_logits[0], expected[0, 0], atol=2e-3)


def test_normalised_pixels_are_the_original_ones() -> None:
    image = np.zeros((1, 1, 3), np.uint8)
    image[0, 0] = (103, 116, 124)
    np.testing.assert_allclose(normalised(image).ravel(), (0.325 / 58.395, -0.28 / 57.12, -0.53 / 57.375), atol=1e-6)
