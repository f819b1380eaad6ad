"""The tokenizer against transformers where that is right, against the stored facts of LLaMA's ids where it isn't."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cable_models.errors import ModelError
from cable_models.lisa.prompt import build_prompt
from cable_models.lisa.tokenizer import LisaTokenizer
from hypothesis import given, settings
from hypothesis import strategies as st
from sentencepiece import SentencePieceProcessor
from tiny_tokenizer import llama_excerpt, save_tokenizer, trained_model

ADDED = {"[SEG]": 380, "<im_start>": 381, "<im_end>": 382}
TEXTS = ["USER: ", "\nCan you segment the cars?", "two  spaces ", "", "\n\n", "Müller, 漢字 12345", "ASSISTANT:"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tokenizer(tmp_path_factory.mktemp("tokenizer"), trained_model(), ADDED, {"add_bos_token": True})


@pytest.fixture(scope="module")
def tokenizer(folder: Path) -> LisaTokenizer:
    return LisaTokenizer.from_folder(folder)


@pytest.fixture(scope="module")
def llama() -> LisaTokenizer:
    return LisaTokenizer(SentencePieceProcessor(model_proto=llama_excerpt()), {"[SEG]": 32000})


@pytest.fixture(scope="module")
def transformers_tokenizer(folder: Path):
    """Another implementation (Rust) of the same model; right unless an added token is near or a space comes first."""
    from transformers import LlamaTokenizer

    return LlamaTokenizer.from_pretrained(folder)


@pytest.mark.parametrize("text", TEXTS)
def test_plain_text_equals_transformers(tokenizer: LisaTokenizer, transformers_tokenizer, text: str) -> None:
    assert tokenizer.encode(text) == transformers_tokenizer(text)["input_ids"]
    assert tokenizer.encode(text, bos=False) == transformers_tokenizer(text, add_special_tokens=False)["input_ids"]


@given(st.text(st.sampled_from("aeginst ASU.,:\n'é1"), max_size=40).filter(lambda text: text[:1] != " "))
@settings(max_examples=100, deadline=None)
def test_any_plain_text_equals_transformers(tokenizer: LisaTokenizer, transformers_tokenizer, text: str) -> None:
    assert tokenizer.encode(text) == transformers_tokenizer(text)["input_ids"]


def test_prompt_is_joined_as_llava_does(tokenizer: LisaTokenizer, transformers_tokenizer) -> None:
    prompt = build_prompt("Can you segment the cars in this image?")
    chunks = [transformers_tokenizer(chunk)["input_ids"] for chunk in prompt.split("<image>")]
    assert all(chunk[0] == 1 for chunk in chunks)
    assert tokenizer.encode_prompt(prompt) == [*chunks[0], -200, *chunks[1][1:]]


def test_neighbours_of_the_image_in_llamas_ids(llama: LisaTokenizer) -> None:
    """The fragment measured with LLaMA's tokenizer: USER, :, space piece, image, space piece, newline."""
    ids = llama.encode_prompt("USER: <image>\n")
    assert ids == [1, 3148, 1001, 29901, 29871, -200, 29871, 13]


def test_image_markers_swallow_the_newline(tokenizer: LisaTokenizer) -> None:
    before, after = tokenizer.encode("USER:"), tokenizer.encode("Can you", bos=False)
    assert tokenizer.encode_prompt("USER: <im_start><image><im_end>\nCan you") == [*before, 381, -200, 382, *after]


def literal_ids(tokenizer: LisaTokenizer, text: str) -> list[int]:
    """The rule of transformers 4.31 read aloud: cut at the longest token from the left, strip beside added ones."""
    tokens = [*ADDED, "<s>", "</s>", "<unk>"]
    parts = [""]
    while text:
        found = max((token for token in tokens if text.startswith(token)), key=len, default=None)
        if found:
            parts += [found, ""]
        else:
            parts[-1] += text[0]
        text = text[len(found or "x") :]
    ids = []
    for index, part in enumerate(parts):
        if part in tokens:
            ids.append(tokenizer.token_id(part))
            continue
        if index and parts[index - 1] in ADDED:
            part = part.lstrip()
        if index + 1 < len(parts) and parts[index + 1] in ADDED:
            part = part.rstrip()
        ids += tokenizer._pieces.encode(part)
    return ids


@given(
    st.lists(
        st.sampled_from(["[SEG]", "<im_start>", "</s>", "<s>", " ", "\n", "Sure", ",", "<", "[", "it"]), max_size=9
    )
)
@settings(max_examples=100, deadline=None)
def test_added_tokens_follow_the_rule_of_training(tokenizer: LisaTokenizer, words: list[str]) -> None:
    text = "".join(words)
    assert tokenizer.encode(text, bos=False) == literal_ids(tokenizer, text)


def test_legacy_flag_chooses_the_full_stop_after_seg(tmp_path: Path) -> None:
    """Documented by transformers for LLaMA: 869 is "▁.", 29889 is "."."""
    model, added = llama_excerpt(), {"[SEG]": 32000}
    for config, stop in [({}, 869), ({"legacy": None}, 869), ({"legacy": True}, 869), ({"legacy": False}, 29889)]:
        tokenizer = LisaTokenizer.from_folder(save_tokenizer(tmp_path, model, added, config))
        assert tokenizer.encode("It is [SEG].") == [1, 739, 338, 32000, stop]
        assert tokenizer.encode("[SEG].", bos=False) == [32000, stop]
        assert tokenizer.encode("USER: ") == [1, 3148, 1001, 29901, 29871]
        assert tokenizer.encode("[SEG], [SEG], and [SEG]", bos=False)[-2:] == [322, 32000]


@pytest.mark.parametrize(("legacy", "ids"), [(True, [1, 15043, 29871, 1, 869]), (False, [1, 15043, 29871, 1, 29889])])
def test_documented_example_of_the_legacy_flag(legacy: bool, ids: list[int]) -> None:
    """From the documentation of transformers' LlamaTokenizer; control tokens keep the white space beside them."""
    llama = LisaTokenizer(SentencePieceProcessor(model_proto=llama_excerpt()), {}, legacy=legacy)
    assert llama.encode("Hello <s>.") == ids


def test_configuration_may_leave_out_bos(tmp_path: Path) -> None:
    tokenizer = LisaTokenizer.from_folder(save_tokenizer(tmp_path, trained_model(), ADDED, {"add_bos_token": False}))
    assert tokenizer.encode("the cars")[0] != tokenizer.bos
    assert tokenizer.encode("the cars", bos=True)[0] == tokenizer.bos == 1
    assert tokenizer.encode_prompt("<image> the")[0] == -200


def test_added_tokens_of_newer_checkpoints(folder: Path, tokenizer: LisaTokenizer, tmp_path: Path) -> None:
    decoder = {str(token): {"content": text, "lstrip": False} for text, token in ADDED.items()}
    decoder |= {"1": {"content": "<s>"}, "2": {"content": "</s>"}}
    newer = save_tokenizer(tmp_path, trained_model(), {}, {"added_tokens_decoder": decoder})
    (newer / "added_tokens.json").unlink()
    text = "Sure, [SEG], and [SEG].</s> <im_start>"
    assert LisaTokenizer.from_folder(newer).encode(text) == tokenizer.encode(text)


def test_lookup(tokenizer: LisaTokenizer) -> None:
    assert [tokenizer.token_id(text) for text in ("[SEG]", "<s>", "</s>", "<unk>")] == [380, 1, 2, 0]
    assert (tokenizer.bos, tokenizer.eos, tokenizer.vocabulary_size) == (1, 2, 383)
    assert tokenizer.token_id("<0x0A>") == 13
    with pytest.raises(ModelError, match=r"no token '<image>'; its added tokens are \['<im_end>', '<im_start>', "):
        tokenizer.token_id("<image>")


def test_decode_shows_seg_and_hides_control_tokens(llama: LisaTokenizer) -> None:
    assert llama.decode([1, 18585, 29892, 372, 338, 32000, 869, 2]) == "Sure, it is [SEG] ."
    assert llama.decode([32000, 322, 32000]) == "[SEG] and [SEG]"
    assert llama.decode([1, -200, 0, 2]) == ""


@pytest.mark.parametrize("text", ["Sure, it is here.", "A chat\nbetween the cars", "Müller 漢"])
def test_decode_equals_transformers(tokenizer: LisaTokenizer, transformers_tokenizer, text: str) -> None:
    ids = tokenizer.encode(text)
    assert tokenizer.decode(ids) == transformers_tokenizer.decode(ids, skip_special_tokens=True) == text


@given(st.lists(st.sampled_from(["[SEG]", "Sure", ",", " and", "."]), max_size=8))
@settings(max_examples=60, deadline=None)
def test_decoded_answer_encodes_to_itself(tokenizer: LisaTokenizer, words: list[str]) -> None:
    ids = tokenizer.encode("".join(words), bos=False)
    assert tokenizer.encode(tokenizer.decode(ids), bos=False) == ids


def test_refusals(tmp_path: Path, tokenizer: LisaTokenizer) -> None:
    with pytest.raises(ModelError, match=r"no tokenizer\.model"):
        LisaTokenizer.from_folder(tmp_path)
    (tmp_path / "tokenizer.model").write_bytes(b"not a model")
    with pytest.raises(ModelError, match="can't be read"):
        LisaTokenizer.from_folder(tmp_path)
    without = LisaTokenizer.from_folder(save_tokenizer(tmp_path, trained_model(), {}, {}))
    with pytest.raises(ModelError, match=r"no token '\[SEG\]'"):
        without.token_id("[SEG]")
    with pytest.raises(ModelError, match="<im_start> is no token"):
        without.encode_prompt("USER: <im_start><image><im_end>\n")
    assert tokenizer.decode([383]) == "<383>"
    for prompt, times in [("no image", 0), ("<image> <image>", 2)]:
        with pytest.raises(ModelError, match=f"{times} times"):
            tokenizer.encode_prompt(prompt)
    (tmp_path / "added_tokens.json").write_text(json.dumps({"[SEG]": "last"}))
    with pytest.raises(ModelError, match="added tokens"):
        LisaTokenizer.from_folder(tmp_path)
