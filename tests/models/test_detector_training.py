"""The detector's training: sampling, augmentation, the dense loss, figures, and going on after a stop."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from cable_models import DetectedBoxes, ModelError
from cable_models.training.augment import AugmentConfig, augment, covered_share, crop_start, mirrored
from cable_models.training.average_precision import Truth, average_precision, class_figures
from cable_models.training.detector_evaluation import Counted, judge_all
from cable_models.training.labelled_clips import read_clip
from cable_models.training.samples import LabelledImage, append_sample, learnable, read_entries
from cable_models.training.sampling import BalancedSampler
from cable_models.training.upload_views import WeightedFill, corridor_blocks, grey, upload_region
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch", reason="training needs torch")
pytest.importorskip("transformers", reason="building the network needs transformers")

from cable_models.rtdetr.compact import CompactRtDetrConfig  # noqa: E402
from cable_models.training.dense_loss import (  # noqa: E402
    DenseHead,
    cell_centres,
    dense_loss,
    focal_loss,
    paired_giou,
    positive_cells,
)
from cable_models.training.detector_batches import VIEWS, next_batch, view_size  # noqa: E402
from cable_models.training.train_rtdetr import (  # noqa: E402
    TrainConfig,
    TrainingFiles,
    learning_rate,
    load_weights,
    train,
)

TINY = CompactRtDetrConfig(
    input_size_wh=(128, 64),
    stem_channels=8,
    stage_channels=(8, 8, 16, 16),
    width=16,
    queries=12,
    decoder_layers=1,
    denoising_queries=4,
)
SHAPES = [(8, 16), (4, 8), (2, 4)]
SIZE = (128, 64)


def squares(rng: np.random.Generator, class_id: int = 2) -> LabelledImage:
    """One bright rectangle on a dark ground."""
    image = rng.integers(0, 40, (96, 160, 3), dtype=np.uint8)
    x, y = int(rng.integers(0, 100)), int(rng.integers(0, 50))
    image[y : y + 40, x : x + 50] = 230
    box = np.array([[x, y, x + 50, y + 40]], np.float32)
    return LabelledImage(image, box, np.array([class_id], np.int32), np.ones(1, np.float32))


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """A sample folder: ten cars, one pedestrian."""
    folder = tmp_path / "frames"
    folder.mkdir()
    rng = np.random.default_rng(1)
    for index in range(11):
        append_sample(folder, f"{index:03d}", squares(rng, 0 if index == 10 else 2))
    return folder


def run(frames: Path, work: Path, steps: int, stop_after: int | None = None, seed: int = 0) -> TrainingFiles:
    """Some steps of a tiny training; stops early where told so."""
    work.mkdir(exist_ok=True)
    files = TrainingFiles(work / "weights.safetensors", work / "state.safetensors")
    done = 0

    def stop() -> bool:
        nonlocal done
        done += 1
        return stop_after is not None and done > stop_after

    config = TrainConfig(steps=steps, batch=2, warmup_steps=2, seed=seed)
    held_out = [squares(np.random.default_rng(5))]
    train(frames, held_out, TINY, config, files, should_stop=stop, clock=lambda: 0.0)
    return files


def stored(path: Path) -> dict[str, torch.Tensor]:
    from safetensors.torch import load_file

    return load_file(path)


def test_stopped_training_goes_on_to_the_very_same_state(frames: Path, tmp_path: Path) -> None:
    whole = stored(run(frames, tmp_path / "whole", 4).state)
    files = run(frames, tmp_path / "halves", 4, stop_after=2)
    half = stored(files.state)
    assert any(not torch.equal(half[name], whole[name]) for name in whole if name.startswith("module/model"))
    run(frames, tmp_path / "halves", 4)
    halves = stored(files.state)
    assert set(halves) == set(whole)
    steps = {float(value) for name, value in halves.items() if name.endswith("/step")}
    assert steps == {4.0}
    for name, value in whole.items():
        assert torch.equal(halves[name], value), name
    # done: nothing is trained any more, and the weights that are left load
    run(frames, tmp_path / "halves", 4)
    assert torch.equal(stored(files.state)["random/torch"], halves["random/torch"])
    load_weights(TINY, files.weights)


def test_state_of_another_recipe_is_refused(frames: Path, tmp_path: Path) -> None:
    files = run(frames, tmp_path / "work", 1)
    with pytest.raises(ModelError, match="another recipe"):
        run(frames, tmp_path / "work", 2, seed=1)
    files.state.write_bytes(files.state.read_bytes()[:500])
    with pytest.raises(ModelError, match=r"no readable training state.*delete it"):
        run(frames, tmp_path / "work", 2)


def test_learning_rate_warms_up_and_falls_to_two_per_cent() -> None:
    config = TrainConfig(learning_rate=1.0, warmup_steps=10)
    assert learning_rate(config, 0, 0.0) == pytest.approx(0.1)
    assert learning_rate(config, 50, 0.0) == pytest.approx(1.0)
    assert learning_rate(config, 50, 0.5) == pytest.approx(0.51)
    assert learning_rate(config, 50, 1.0) == pytest.approx(0.02)


def test_rare_classes_are_drawn_as_often_as_asked(frames: Path) -> None:
    sampler, rng = BalancedSampler(frames), np.random.default_rng(0)
    drawn = [sampler.draw(rng).sample.class_ids[0] for _ in range(300)]
    # .34 against .16, of the two classes that are there
    assert np.mean(np.array(drawn) == 0) == pytest.approx(0.68, abs=0.08)
    with pytest.raises(ModelError, match=r"no labels\.jsonl"):
        BalancedSampler(frames / "elsewhere").draw(rng)


def test_batches_have_the_sizes_of_their_views(frames: Path) -> None:
    sampler, rng = BalancedSampler(frames), np.random.default_rng(0)
    seen = set()
    for _ in range(20):
        batch = next_batch(sampler, TINY, 2, 5.0, 0.25, rng)
        images, _, height, width = batch.pixels.shape
        seen.add((images, width, height))
        assert 0 <= float(batch.pixels.min()) <= float(batch.pixels.max()) <= 1
        assert len(batch.targets) == images
        for target in batch.targets:
            assert target["boxes"].shape == (len(target["class_labels"]), 4)
            assert bool(((target["boxes"] > 0) & (target["boxes"] <= 1)).all())
    assert seen == {(2, 128, 64), (4, 64, 32)}
    assert view_size((512, 288), VIEWS[0].input_share) == (512, 288)
    assert view_size((512, 288), VIEWS[1].input_share) == (320, 192)


def test_positive_cells_are_those_a_loop_finds() -> None:
    centres, levels = cell_centres(SHAPES)
    boxes = torch.tensor([[0.5, 0.5, 0.7, 0.9], [0.5, 0.45, 0.1, 0.2], [0.21, 0.3, 0.01, 0.02]])
    cells, owners = positive_cells(centres, levels, SHAPES, SIZE, boxes)
    expected: dict[int, int] = {}
    row = 0
    for level, (height, width) in enumerate(SHAPES):
        low, high = ((0, 64), (32, 160), (96, math.inf))[level]
        for y in range(height):
            for x in range(width):
                best = math.inf
                for index, (cx, cy, w, h) in enumerate(boxes.tolist()):
                    side = math.sqrt(w * SIZE[0] * h * SIZE[1])
                    near_x = abs((x + 0.5) / width - cx) <= max(0.25 * w, 0.5 / width)
                    near_y = abs((y + 0.5) / height - cy) <= max(0.25 * h, 0.5 / height)
                    if near_x and near_y and low <= side <= high and w * h < best:
                        best, expected[row] = w * h, index
                row += 1
    assert dict(zip(cells.tolist(), owners.tolist(), strict=True)) == expected
    assert set(expected.values()) == {0, 1, 2}


def test_dense_loss_is_small_only_for_the_right_answer() -> None:
    targets = [
        {"class_labels": torch.tensor([2, 0]), "boxes": torch.tensor([[0.3, 0.5, 0.2, 0.4], [0.8, 0.5, 0.1, 0.3]])}
    ]
    centres, levels = cell_centres(SHAPES)
    cells, owners = positive_cells(centres, levels, SHAPES, SIZE, targets[0]["boxes"])
    classes = torch.full((1, len(centres), 5), -12.0)
    classes[0, cells, targets[0]["class_labels"][owners]] = 12.0
    boxes = torch.zeros(1, len(centres), 4)
    boxes[0, cells] = torch.logit(targets[0]["boxes"][owners])
    right = float(dense_loss(classes, boxes, SHAPES, SIZE, targets))
    assert right == pytest.approx(0, abs=1e-4)
    assert float(dense_loss(-classes, boxes, SHAPES, SIZE, targets)) > 5
    assert float(dense_loss(classes, -boxes, SHAPES, SIZE, targets)) > 0.5
    nothing = [{"class_labels": torch.zeros(0, dtype=torch.int64), "boxes": torch.zeros(0, 4)}]
    assert float(dense_loss(torch.full_like(classes, -12.0), boxes, SHAPES, SIZE, nothing)) < 1e-3


def test_losses_match_hand_worked_numbers() -> None:
    # p = .5: .25 * .5^2 * ln 2 for a positive entry, .75 * .5^2 * ln 2 for a negative one
    found = focal_loss(torch.zeros(1, 2), torch.tensor([[1.0, 0.0]]))
    assert float(found) == pytest.approx(0.25 * math.log(2))
    first = torch.tensor([[0.25, 0.25, 0.5, 0.5], [0.1, 0.1, 0.2, 0.2]])
    second = torch.tensor([[0.5, 0.5, 0.5, 0.5], [0.9, 0.9, 0.2, 0.2]])
    # IoU 1/7 in a hull of 9/16 of which 7/16 is covered; then two far corners of the unit square
    expected = [1 / 7 - (9 - 7) / 9, 0 - (1 - 0.08) / 1]
    np.testing.assert_allclose(paired_giou(first, second).numpy(), expected, atol=1e-6)
    head = DenseHead(16, 5, 3, prior=0.01)
    logits = head([torch.zeros(2, 16, h, w) for h, w in SHAPES])
    assert logits.shape == (2, sum(h * w for h, w in SHAPES), 5)
    assert float(logits.detach().sigmoid().mean()) == pytest.approx(0.01, rel=1e-4)


def test_group_figures_take_a_bus_called_a_truck_for_a_vehicle() -> None:
    image = np.zeros((100, 100, 3), np.uint8)
    boxes = np.array([[0, 0, 20, 20], [40, 0, 60, 20], [80, 0, 84, 5]], np.float32)
    sample = LabelledImage(image, boxes, np.array([5, 0, 0], np.int32), np.ones(3, np.float32))
    found = DetectedBoxes(boxes[:2], np.array([7, 1], np.int32), np.array([0.9, 0.8], np.float32))
    result = judge_all([found], [sample], [0, 1, 2, 5, 7], Counted(min_height=0.06))
    assert result.groups["vehicle"].ap50 == 1.0
    assert result.classes["5"].ap50 == 0.0
    assert (result.groups["pedestrian"].objects, result.groups["pedestrian"].ap50) == (1, 0.0)
    assert result.mean_ap50 == 0.5  # no cyclist is there to be found
    assert json.loads(result.as_json())["vehicle"]["objects"] == 1


@given(
    side=st.integers(20, 200),
    share=st.floats(0.1, 1.0),
    low=st.floats(0, 199),
    size=st.floats(1, 199),
    seed=st.integers(0, 9),
)
@settings(max_examples=60, deadline=None)
def test_crops_lie_in_the_image_and_keep_what_fits(side: int, share: float, low: float, size: float, seed: int) -> None:
    crop = max(1, int(side * share))
    low = min(low, side - 1.0)
    high = min(low + size, float(side))
    start = crop_start(side, crop, low, high, np.random.default_rng(seed))
    assert 0 <= start <= side - crop
    if math.ceil(high) - math.floor(low) <= crop:
        assert start <= low
        assert start + crop >= high


def test_samples_survive_the_disk(tmp_path: Path) -> None:
    sample = squares(np.random.default_rng(3))
    append_sample(tmp_path, "a", sample)
    (entry,) = read_entries(tmp_path)
    loaded = entry.load()
    np.testing.assert_array_equal(loaded.boxes_xyxy, sample.boxes_xyxy)
    assert loaded.class_ids.tolist() == [2]
    assert np.abs(loaded.image.astype(int) - sample.image).mean() < 12
    (tmp_path / "a.jpg").unlink()
    with pytest.raises(ModelError, match="can't be read"):
        entry.load()
    with pytest.raises(ModelError, match=r"no labels\.jsonl"):
        read_entries(tmp_path / "elsewhere")
    with (tmp_path / "labels.jsonl").open("a") as lines:
        lines.write('{"image": 1\n')
    with pytest.raises(ModelError, match="line 2"):
        read_entries(tmp_path)


def test_small_and_hidden_objects_are_not_taught() -> None:
    boxes = np.array([[0, 0, 10, 12], [0, 0, 10, 11], [0, 0, 10, 50]], np.float32)
    seen = np.array([1, 1, 0.2], np.float32)
    assert learnable(boxes, seen, 540, 12 / 540, 0.25).tolist() == [True, False, False]


def test_augmented_boxes_still_frame_their_object() -> None:
    rng = np.random.default_rng(7)
    config = AugmentConfig(colour=0, region_only=0, jpeg=0, crop=1.0)
    checked = 0
    for turn in range(40):
        changed = augment(squares(rng), (128, 80), config, rng, focus=0 if turn % 2 else None)
        assert changed.image.shape == (80, 128, 3)
        assert len(changed.boxes_xyxy) == 1 or not turn % 2
        for box in changed.boxes_xyxy:
            bright = np.argwhere(changed.image.mean(axis=2) > 135)
            y0, x0 = bright.min(axis=0)
            y1, x1 = bright.max(axis=0) + 1
            np.testing.assert_allclose(box, [x0, y0, x1, y1], atol=1.6)
            checked += 1
    assert checked > 20


def test_masked_images_keep_only_what_is_left_to_see() -> None:
    rng = np.random.default_rng(5)
    config = AugmentConfig(flip=0, crop=0, colour=0, region_only=1.0, jpeg=0)
    filled = 0
    for _ in range(30):
        changed = augment(squares(rng), (160, 96), config, rng)
        filled += len(changed.boxes_xyxy) == 0
        for box in changed.boxes_xyxy:
            x0, y0, x1, y1 = box.astype(int)
            assert changed.image[y0:y1, x0:x1].mean() > 200
    assert 0 < filled < 15


def test_mirroring_twice_changes_nothing() -> None:
    sample = squares(np.random.default_rng(9))
    twice = mirrored(mirrored(sample))
    np.testing.assert_array_equal(twice.image, sample.image)
    np.testing.assert_allclose(twice.boxes_xyxy, sample.boxes_xyxy)


def test_covered_share_counts_pixels() -> None:
    mask = np.zeros((10, 10), np.bool_)
    mask[:, :4] = True
    boxes = np.array([[0, 0, 8, 10], [4, 0, 10, 10], [0, 0, 4, 4]], np.float32)
    np.testing.assert_allclose(covered_share(boxes, mask), [0.5, 0, 1])


def test_average_precision_of_hand_worked_cases() -> None:
    assert average_precision(np.array([1, 1], np.int8), 2) == 1.0
    assert average_precision(np.array([0, 1], np.int8), 1) == 0.5
    # envelope 1, 2/3, 2/3 over recall steps of a quarter; the fourth object is never found
    assert average_precision(np.array([1, 0, 1, 0], np.int8), 4) == pytest.approx(0.25 * 1 + 0.25 * 2 / 3)
    assert average_precision(np.zeros(0, np.int8), 3) == 0.0


def test_class_figures_ignore_what_is_not_counted() -> None:
    truth = Truth(
        np.array([[0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10]], np.float32),
        np.array([2, 2, 2], np.int32),
        np.array([True, True, False]),
    )
    found = DetectedBoxes(
        np.array([[0, 0, 10, 10], [1, 0, 11, 10], [40, 0, 50, 10], [70, 0, 80, 10]], np.float32),
        np.array([2, 2, 2, 2], np.int32),
        np.array([0.9, 0.8, 0.7, 0.3], np.float32),
    )
    figures = class_figures([found], [truth], 2, operating_score=0.4)
    # at .4: one hit, one double; the uncounted third is neither, the fourth lies below
    assert figures.objects == 2
    assert (figures.precision, figures.recall, figures.f1) == (0.5, 0.5, 0.5)
    assert figures.ap50 == 0.5


def test_labels_of_photographed_clips_are_read(tmp_path: Path) -> None:
    images = tmp_path / "training" / "image_02" / "0002"
    images.mkdir(parents=True)
    cv2.imwrite(str(images / "000036.png"), np.zeros((40, 60, 3), np.uint8))
    labels = tmp_path / "training" / "label_02" / "0002.txt"
    labels.parent.mkdir()
    labels.write_text(
        "36 0 Van 0 0 -1.5 1.0 2.0 31.5 22.0 1 1 1 1 1 1 0\n"
        "36 1 Pedestrian 0 2 -1.5 40 2 50 22 1 1 1 1 1 1 0\n"
        "36 -1 DontCare -1 -1 -10 0 0 5 5 -1 -1 -1 -1 -1 -1 -1\n"
        "37 0 Car 0 0 -1.5 1 2 31 22 1 1 1 1 1 1 0\n"
    )
    (sample,) = read_clip(f"kitti-tracking:{tmp_path}")
    assert sample.class_ids.tolist() == [2, 0, -1]
    np.testing.assert_allclose(sample.boxes_xyxy[0], [1, 2, 31.5, 22])
    np.testing.assert_allclose(sample.visibility, [1, 0.4, 0])
    labels.write_text("36 0 Car\n")
    with pytest.raises(ModelError, match="no label file of KITTI"):
        read_clip(f"kitti-tracking:{tmp_path}")

    for name in ("images", "labels"):
        (tmp_path / name).mkdir()
    classes = np.full((40, 60), 3, np.uint8)
    classes[5:15, 10:20] = 8
    classes[20:40, 30:34] = 9
    classes[0:2, 50:52] = 10  # a speck
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.zeros((40, 60, 3), np.uint8))
    with pytest.raises(ModelError, match="no class map"):
        read_clip(f"camvid:{tmp_path}")
    cv2.imwrite(str(tmp_path / "labels" / "a.png"), classes)
    (sample,) = read_clip(f"camvid:{tmp_path}")
    assert sample.boxes_xyxy.tolist() == [[10, 5, 20, 15], [30, 20, 34, 40]]
    assert sample.class_ids.tolist() == [2, 0]
    with pytest.raises(ModelError, match="names no labelled clip"):
        read_clip("cityscapes:somewhere")
    with pytest.raises(ModelError, match="holds no labelled frames"):
        read_clip(f"camvid:{images}")


def test_a_corridor_links_what_is_far_apart_with_the_methods_margins() -> None:
    blocks = np.zeros((90, 200), np.bool_)
    blocks[38:43, 20:25] = True
    blocks[30:35, 100:105] = True
    band = corridor_blocks(blocks)
    assert band[blocks].all()
    columns = np.flatnonzero(band.any(axis=0))
    assert (columns == np.arange(20, 105)).all()
    # 10 % of the way to the top, 15 % of the way to the bottom, and whole blocks
    assert np.flatnonzero(band[:, 22])[[0, -1]].tolist() == [34, 50]
    assert np.flatnonzero(band[:, 102])[[0, -1]].tolist() == [27, 43]
    middle = np.flatnonzero(band[:, 62])
    assert 27 <= middle[0] <= 34
    assert 43 <= middle[-1] <= 50


def test_upload_regions_are_blocks_that_hold_most_objects_whole() -> None:
    rng = np.random.default_rng(2)
    boxes = np.array([[20, 30, 60, 70], [100, 40, 130, 90]], np.float32)
    whole = 0
    for _ in range(60):
        region = upload_region(boxes, (96, 160), rng)
        padded = np.pad(region, ((0, -96 % 8), (0, -160 % 8)))
        per_block = padded.reshape(padded.shape[0] // 8, 8, padded.shape[1] // 8, 8).mean(axis=(1, 3))
        assert set(np.unique(per_block)) <= {0.0, 1.0}
        shares = covered_share(boxes, region)
        whole += int((shares == 1).sum())
    assert whole >= 0.85 * 120
    assert not upload_region(np.zeros((0, 4), np.float32), (96, 160), rng).any()


def test_the_drawn_fill_is_what_stands_outside() -> None:
    rng = np.random.default_rng(4)
    config = AugmentConfig(flip=0, crop=0, colour=0, region_only=1.0, jpeg=0)
    marks = [WeightedFill(lambda image, region: np.where(region[..., None], image, np.uint8(7)), 1.0)]
    marks.append(WeightedFill(grey, 0.0))
    for _ in range(10):
        changed = augment(squares(rng), (160, 96), config, rng, fills=marks)
        assert (changed.image == 7).all(axis=2).any()
        assert not (changed.image == 128).all(axis=2).any()
