"""LISA++ behind the wire: a tiny model with random weights, and doubles where an answer must be known beforehand."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cable_codecs import CodecParameters

from cable_rpc.cloud.backends import BackendOptions, FrameContext, load_segmenter
from cable_rpc.cloud.lisa_segmenter import LisaSegmenter, segmentation_of, torch_device, warm_up
from cable_rpc.cloud.perception import DEFAULT_PROMPT
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.cloud.weights_revision import weights_revision
from cable_rpc.edge.capture import Capture
from cable_rpc.edge.client import PerceptionClient, SessionRequest
from cable_rpc.edge.frame_encoder import FrameEncoder
from cable_rpc.edge.streamer import EdgeStreamer, StreamedFrame
from cable_rpc.errors import ConfigurationError, ModelError
from cable_rpc.study.run_record import read_frames
from cable_rpc.study.stream_run import StreamRun, StreamRunConfig
from cable_rpc.types import BoolMask, Detections, Image

from .test_uncertainty_loop import FPS, HEIGHT, REGION_COLUMNS, WIDTH, Listener, StillLife

torch = pytest.importorskip("torch", reason="the cloud extra is not installed")
lisa = pytest.importorskip("cable_models.lisa", reason="the cloud extra is not installed")

from tests.lisa.tiny_lisa import SHORT_ANSWER, build_tiny_lisa  # noqa: E402

GOLDEN = Path(__file__).resolve().parents[3] / "shared" / "golden" / "lisa_tiny_a"
CARS = "Please segment all vehicles on the road."
CONTEXT = FrameContext(0, Detections.empty(), "car 7")
PREFILL = lisa.prefill_cost.PrefillCost(94, 60, 256, 5.2, 2.3, 4_000, 9_000)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_tiny_lisa(tmp_path_factory.mktemp("lisa") / "tiny")


@pytest.fixture(scope="module")
def segmenter(checkpoint: Path) -> LisaSegmenter:
    loaded = load_segmenter(f"lisa:{checkpoint}", BackendOptions(device="cpu"))
    assert isinstance(loaded, LisaSegmenter)
    return loaded


def picture(height: int = HEIGHT, width: int = WIDTH) -> Image:
    return np.random.default_rng(7).integers(0, 256, (height, width, 3), np.uint8)


def middle(image: Image) -> BoolMask:
    height, width = image.shape[:2]
    roi = np.zeros((height, width), np.bool_)
    roi[height // 3 : -height // 4, width // 3 : -width // 3] = True
    return roi


def answer_of(logits: np.ndarray, **changes: Any) -> Any:
    answer = lisa.FrameAnswer(
        mask_logits=logits.astype(np.float32),
        answer_ids=(1,),
        text="It is [SEG].",
        forced=True,
        agrees=None,
        prefill=PREFILL,
        stage_ns={"clip": 3, "prefill": 4},
        batch_size=1,
    )
    return replace(answer, **changes)


def test_several_masks_become_their_union_judged_inside_the_region() -> None:
    logits = np.full((2, 4, 5), -9.0)
    logits[0, 1, 1], logits[1, 2, 3], logits[1, 0, 4] = 2.0, 1.0, 8.0
    roi = np.ones((4, 5), np.bool_)
    roi[:, 4] = False
    found = segmentation_of(answer_of(logits), roi)
    assert np.argwhere(found.mask).tolist() == [[0, 4], [1, 1], [2, 3]]
    sure = [1 / (1 + np.exp(-logit)) for logit in (2.0, 1.0)]
    assert found.confidence == pytest.approx(sum(sure) / 2)
    assert found.uncertainty is not None
    assert np.argwhere(found.uncertainty).tolist() == [[1, 1], [2, 3]]
    assert (found.tokens_in, found.tokens_full) == (60, 256)
    assert found.prefill is not None
    assert (found.prefill.prompt_tokens, found.prefill.speedup_quadratic, found.prefill.speedup_flops) == (94, 5.2, 2.3)
    assert (found.prefill.measured_ns, found.prefill.whole_ns) == (4_000, 9_000)
    assert (found.stages_ns, found.answer) == ({"clip": 3, "prefill": 4}, "It is [SEG].")


def test_an_answer_without_seg_is_an_empty_mask() -> None:
    found = segmentation_of(answer_of(np.zeros((0, 4, 5))), np.ones((4, 5), np.bool_))
    assert (found.mask.any(), found.confidence) == (False, 1.0)
    assert found.uncertainty is not None
    assert not found.uncertainty.any()


def test_logits_that_are_not_numbers_are_no_answer() -> None:
    logits = np.zeros((1, 4, 5))
    logits[0, 3, 3] = np.nan
    with pytest.raises(ModelError, match="dtype=bf16 or fp32"):
        segmentation_of(answer_of(logits), np.ones((4, 5), np.bool_))


@pytest.mark.parametrize(
    ("forced", "agrees", "word"),
    [
        (True, None, "forced"),
        (True, True, "forced, checked"),
        (False, None, "generate"),
        (False, False, "generate, forced refused"),
    ],
)
def test_how_an_answer_came_about(forced: bool, agrees: bool | None, word: str) -> None:
    answer = answer_of(np.zeros((1, 2, 2)), forced=forced, agrees=agrees)
    assert segmentation_of(answer, np.ones((2, 2), np.bool_)).decoding == word


def test_it_says_what_the_pipeline_says(segmenter: LisaSegmenter, checkpoint: Path) -> None:
    image = picture()
    roi = middle(image)
    pipeline = lisa.LisaPipeline(lisa.load_lisa(checkpoint))
    (expected,) = pipeline.segment([lisa.FrameRequest(image, roi, CARS, "car 7")])
    found = segmenter.segment(image, roi, CARS, CONTEXT)
    assert np.array_equal(found.mask, expected.masks.any(axis=0))
    assert 0.05 < found.mask[roi].mean() < 0.95
    assert 0 < found.tokens_in < found.tokens_full == 16
    assert found.prefill is not None
    prompt = found.prefill.prompt_tokens
    assert found.prefill.speedup_quadratic == pytest.approx(((prompt + 16) / (prompt + found.tokens_in)) ** 2)
    assert {"clip", "prefill", "sam_encoder", "mask_decoder"} <= set(found.stages_ns)
    assert found.decoding == "forced, checked"
    assert "[SEG]" in found.answer
    assert found.answer.startswith("Sure")


def test_a_model_with_another_answer_is_listened_to(tmp_path: Path) -> None:
    folder = build_tiny_lisa(tmp_path / "short", says=SHORT_ANSWER)
    segmenter = load_segmenter(f"lisa:{folder}", BackendOptions(device="cpu"))
    whole = np.ones((HEIGHT, WIDTH), np.bool_)
    assert segmenter.segment(picture(), whole, CARS, CONTEXT).decoding == "generate, forced refused"
    following = segmenter.segment(picture(), whole, CARS, CONTEXT)
    assert (following.decoding, following.answer.split()) == ("forced, checked", ["[SEG]", "."])
    segmenter.forget_stream("car 7")  # type: ignore[attr-defined]
    assert segmenter.segment(picture(), whole, CARS, CONTEXT).decoding == "generate, forced refused"


def test_a_question_it_can_t_be_asked_costs_the_frame(segmenter: LisaSegmenter) -> None:
    with pytest.raises(ModelError, match=r"lisa:tiny: the question holds <image>"):
        segmenter.segment(picture(), np.ones((HEIGHT, WIDTH), np.bool_), "What is <image>?", CONTEXT)


def test_warming_up_leaves_nothing_but_a_known_whole_prefill(checkpoint: Path) -> None:
    segmenter = load_segmenter(f"lisa:{checkpoint}", BackendOptions(device="cpu"))
    assert isinstance(segmenter, LisaSegmenter)
    warm_up(segmenter)
    image = picture()
    found = segmenter.segment(image, middle(image), DEFAULT_PROMPT, FrameContext(0, Detections.empty(), "car 7"))
    assert found.prefill is not None
    assert found.prefill.speedup_measured is not None
    assert found.decoding == "forced, checked"


def test_an_endless_question_is_refused_before_it_fills_the_memory(segmenter: LisaSegmenter) -> None:
    with pytest.raises(ModelError, match="has 2001 characters, at most 2000"):
        segmenter.segment(picture(), np.ones((HEIGHT, WIDTH), np.bool_), "a" * 2001, CONTEXT)


def test_a_checkpoint_without_tokenizer_names_what_to_add() -> None:
    if not GOLDEN.is_dir():
        pytest.skip("shared/golden/lisa_tiny_a is not there")
    with pytest.raises(ModelError, match=r"no tokenizer\.model.*put the tokenizer\.model .* beside its config\.json"):
        load_segmenter(f"lisa:{GOLDEN}", BackendOptions(device="cpu"))


def test_the_original_code_s_masks_come_out_as_one() -> None:
    if not GOLDEN.is_dir():
        pytest.skip("shared/golden/lisa_tiny_a is not there")
    inputs, outputs = (np.load(GOLDEN / f"{name}.npz") for name in ("inputs", "outputs_forced"))
    image = np.ascontiguousarray(inputs["image_uint8"][..., ::-1])
    prompt = inputs["input_ids_prompt"][0].tolist()
    forced = tuple(inputs["input_ids_forced"][0, len(prompt) :].tolist())
    options = lisa.LisaOptions(forced_ids=forced, verify_frames=0)
    (answer,) = lisa.LisaPipeline(lisa.load_lisa(GOLDEN), options).segment([lisa.FrameRequest(image, None, prompt)])
    found = segmentation_of(answer, np.ones(image.shape[:2], np.bool_))
    logits = outputs["mask_logits"].max(axis=0).astype(np.float64)
    assert np.mean(found.mask != outputs["masks"].any(axis=0)) <= 1e-4
    assert found.confidence == pytest.approx(np.mean(1 / (1 + np.exp(-logits[logits > 0]))), abs=1e-4)
    assert found.uncertainty is not None
    doubt = np.where(np.abs(logits) < 3, 255 / np.cosh(logits / 2) ** 2, 0)
    assert np.mean(np.abs(found.uncertainty - doubt) > 1.2) <= 1e-3
    assert found.decoding == "forced"


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("colour=red", r"unknown option 'colour'; known are(.|\n)*decoding=forced\|generate(.|\n)*sam_windows="),
        ("dtype=int8", r"dtype=int8 can't be read; give auto\|bf16\|fp16\|fp32"),
        ("max_new_tokens=0", "max_new_tokens is 0; give 1 or more"),
    ],
)
def test_options_that_don_t_exist_are_answered_with_those_that_do(checkpoint: Path, query: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        load_segmenter(f"lisa:{checkpoint}?{query}", BackendOptions(device="cpu"))


@pytest.mark.parametrize(
    ("spec", "device", "error", "said"),
    [
        ("lisa", "cpu", ConfigurationError, "--segmenter lisa:Senqiao/LISA_Plus_7b"),
        ("lisa:no/such/folder", "cpu", ModelError, "there is no folder no/such/folder"),
        ("lisa:tiny", "tpu", ConfigurationError, "device 'tpu' is unknown"),
    ],
)
def test_what_can_t_be_loaded_is_explained(spec: str, device: str, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        load_segmenter(spec, BackendOptions(device=device))


def test_a_missing_gpu_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert torch_device("auto") == "cpu"
    with pytest.raises(ConfigurationError, match="sees no GPU"):
        torch_device("cuda")


def test_weights_are_named_by_commit_or_digest(checkpoint: Path, tmp_path: Path) -> None:
    snapshot = tmp_path / "snapshots" / "0123456789abcdef"
    snapshot.mkdir(parents=True)
    assert weights_revision(snapshot) == "0123456789ab"
    own = weights_revision(checkpoint)
    assert len(own) == 12
    other = build_tiny_lisa(tmp_path / "other", seed=1, tokenizer=False)
    assert weights_revision(other) != own


async def streamed(target: str, count: int) -> list[StreamedFrame]:
    request = SessionRequest("jpeg", WIDTH, HEIGHT, FPS, prompt=CARS)
    async with PerceptionClient(target, request) as client:
        encoder = FrameEncoder(Listener(), CodecParameters("jpeg", WIDTH, HEIGHT, FPS))
        return [frame async for frame in EdgeStreamer(Capture(StillLife(count), realtime=False), encoder, client).run()]


class Watched:
    """The segmenter with a diary of streams."""

    def __init__(self, inner: LisaSegmenter) -> None:
        self.inner = inner
        self.name, self.revision, self.device = inner.name, inner.revision, inner.device
        self.streams: list[str] = []
        self.forgotten: list[str] = []

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Any:
        self.streams.append(context.stream)
        return self.inner.segment(image, roi, prompt, context)

    def forget_stream(self, stream: str) -> None:
        self.forgotten.append(stream)


async def test_masks_tokens_and_prefill_reach_the_edge(running_server: Any, segmenter: LisaSegmenter) -> None:
    watched = Watched(segmenter)
    async with running_server(segmenter=watched) as target:
        frames = await streamed(target, 3)
        await streamed(target, 1)
        for _ in range(500):
            if len(watched.forgotten) == 2:
                break
            await asyncio.sleep(0.01)
    assert [frame.answer.rejection for frame in frames] == [None] * 3
    first, *others = (frame.answer.segmentation for frame in frames)
    assert first is not None
    assert 0.05 < first.mask.mean() < 0.95
    assert (first.tokens_in, first.tokens_full) == (16, 16)
    for segmentation in others:
        assert segmentation is not None
        assert not segmentation.mask[:, 8 * REGION_COLUMNS :].any()
        assert segmentation.mask[:, : 8 * REGION_COLUMNS].any()
        assert 0 < segmentation.tokens_in < segmentation.tokens_full == 16
        prefill = segmentation.prefill
        assert prefill is not None
        ratio = (prefill.prompt_tokens + 16) / (prefill.prompt_tokens + segmentation.tokens_in)
        assert prefill.speedup_quadratic == pytest.approx(ratio**2)
        assert 1.0 < prefill.speedup_flops <= ratio**2
        assert prefill.speedup_measured is not None
        assert segmentation.uncertainty is not None
        assert segmentation.stages_ns["sam_encoder"] > 0
        assert segmentation.decoding == "forced, checked"
    times = frames[1].answer.times.run_ns
    assert times["segment.sam_encoder"] + times["segment.prefill"] < times["segment"]
    assert len(set(watched.streams[:3])) == 1
    assert len(set(watched.streams)) == 2
    assert sorted(watched.forgotten) == sorted(set(watched.streams))


class Clinging(BoxSegmenter):
    """Can't let go of a stream."""

    def forget_stream(self, stream: str) -> None:
        raise RuntimeError("still holding on")


async def test_a_segmenter_that_can_t_forget_hurts_nobody(
    running_server: Any, caplog: pytest.LogCaptureFixture
) -> None:
    async with running_server(segmenter=Clinging()) as target:
        for _ in range(2):
            (frame,) = await streamed(target, 1)
            assert frame.answer.rejection is None
        for _ in range(500):
            if caplog.text.count("segmenter boxes did not forget session") == 2:
                break
            await asyncio.sleep(0.01)
        else:
            pytest.fail("the failure was not logged twice")


async def test_a_run_writes_tokens_and_all_three_prefill_columns_down(
    running_server: Any, segmenter: LisaSegmenter, tmp_path: Path
) -> None:
    async with running_server(segmenter=segmenter) as target:
        config = StreamRunConfig(target, tmp_path, codec="jpeg", realtime=False, prompt=CARS)
        summary = await StreamRun(StillLife(4), config, lambda *_: None).run()
    records = read_frames(tmp_path / "frames.csv")
    assert [record.tokens_full for record in records] == [16] * 4
    assert records[0].tokens_in == 16
    for record in records:
        assert record.prefill_quadratic is not None
        assert record.prefill_flops is not None
        assert record.prefill_ns
        assert record.prefill_whole_ns
        assert record.segment_clip_ns
        assert record.segment_ns is not None
        assert record.segment_clip_ns < record.segment_ns
    assert summary.language is not None
    assert summary.language.of_run is not None
    assert summary.language.of_run.measured is not None
    assert summary.stage("segment_sam_encoder") is not None
