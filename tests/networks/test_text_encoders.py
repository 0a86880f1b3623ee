"""BERT as a text encoder: the library's own hidden states, masked, remembered, found on disk and checked."""

from __future__ import annotations

import copy
import logging
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from agents.networks.text import TextConfig, TextEncoder
from agents.networks.text_encoders import (
    FOLDER_VARIABLE,
    BertEncoder,
    BertTextConfig,
    load_bert,
    text_config,
    text_config_from_state,
    text_encoder,
)
from scene_envs.errors import InvalidInputError, MissingDependencyError
from tests.helpers.small_bert import WORDS, write_bert

transformers = pytest.importorskip("transformers")
pytest.importorskip("tokenizers")

PROMPTS = ["A scene with two cups and a table.", "", "A scene with 12 objects."]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bert(tmp_path_factory.mktemp("bert"))


@pytest.fixture
def encoder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> BertEncoder:
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    return BertEncoder(BertTextConfig.from_model(folder))


def test_tokens_are_the_last_hidden_states_of_the_library(encoder: BertEncoder, folder: Path) -> None:
    tokens, mask = encoder(PROMPTS)
    model = transformers.BertModel.from_pretrained(folder).eval()
    read = transformers.BertTokenizer.from_pretrained(folder)(PROMPTS, padding=True, return_tensors="pt")
    with torch.no_grad():
        expected = model(**read).last_hidden_state
    assert tokens.shape == (3, 11, 24)
    assert mask.sum(dim=1).tolist() == [11, 2, 8]
    assert torch.equal(mask, read["attention_mask"].bool())
    torch.testing.assert_close(tokens[mask], expected[mask], atol=1e-5, rtol=1e-5)
    assert bool((tokens[~mask] == 0).all())


def test_the_width_is_that_of_the_model(tmp_path: Path) -> None:
    config = BertTextConfig.from_model(write_bert(tmp_path, width=8, longest=16))
    assert (config.width, config.max_tokens) == (8, 16)
    assert BertEncoder(config)(["a cup"])[0].shape == (1, 4, 8)


def test_each_prompt_is_encoded_once_and_alone(encoder: BertEncoder, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    compute = encoder._hidden_states
    monkeypatch.setattr(encoder, "_hidden_states", lambda some: calls.append(len(some)) or compute(some))
    together, _ = encoder([*PROMPTS, *PROMPTS])
    again, _ = encoder(PROMPTS[:1])
    assert calls == [1, 1, 1]
    alone, _ = BertEncoder(encoder.config)(PROMPTS[:1])
    assert torch.equal(together[:1, :11], alone)
    assert torch.equal(again, alone)


def test_only_so_many_prompts_are_remembered(encoder: BertEncoder, monkeypatch: pytest.MonkeyPatch) -> None:
    few = BertEncoder(encoder.config, cached=2)
    few(["a cup", "a table", "two cups"])
    few(["a table", "12 cups"])
    computed: list[object] = []
    compute = few._hidden_states
    monkeypatch.setattr(few, "_hidden_states", lambda some: computed.extend(some) or compute(some))
    few(["12 cups", "a table"])
    assert computed == []
    few(["two cups"])
    assert len(computed) == 1


def test_token_indices_are_the_tokenizers_and_encode_the_same(encoder: BertEncoder, folder: Path) -> None:
    indices, unknown = encoder.tokenize([*PROMPTS, "a zeppelin"])
    read = transformers.BertTokenizer.from_pretrained(folder)([*PROMPTS, "a zeppelin"], padding=True)
    assert indices.tolist() == read["input_ids"]
    assert unknown == ["zeppelin"]
    assert encoder.token_space == (20, len(WORDS))
    wide = torch.nn.functional.pad(indices[:3], (0, 5))
    for first, second in zip(encoder.encode(wide), encoder(PROMPTS), strict=True):
        assert torch.equal(first, second)


def test_bert_is_frozen_and_no_part_of_the_file(encoder: BertEncoder, monkeypatch: pytest.MonkeyPatch) -> None:
    assert list(encoder.parameters()) == []
    state = encoder.state_dict()
    assert list(state) == ["nothing"]
    tokens, mask = encoder(["", ""])
    again = BertEncoder(encoder.config)
    again.load_state_dict(state)
    monkeypatch.setitem(sys.modules, "transformers", None)
    load_bert.cache_clear()
    assert torch.equal(again(["", ""])[0], tokens)
    assert bool(mask.all())
    with pytest.raises(MissingDependencyError, match=r"scene-envs\[bert\]"):
        again(["a cup"])


def test_copies_share_one_bert(encoder: BertEncoder) -> None:
    tokens, _ = encoder(PROMPTS)
    twin = copy.deepcopy(encoder)
    assert torch.equal(twin(PROMPTS)[0], tokens)
    assert twin._bert() is encoder._bert()


def test_another_model_is_refused_and_a_moved_one_is_found(
    encoder: BertEncoder, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens, _ = encoder(PROMPTS)
    other = write_bert(tmp_path / "other", seed=1)
    with pytest.raises(InvalidInputError, match="is not the BERT that this prior was trained with"):
        BertEncoder(replace(encoder.config, model=str(other)))(PROMPTS)
    lost = replace(encoder.config, model=str(tmp_path / "gone"))
    with pytest.raises(InvalidInputError, match=f"neither a folder nor in the local cache.*{FOLDER_VARIABLE}"):
        BertEncoder(lost)(PROMPTS)
    monkeypatch.setenv(FOLDER_VARIABLE, str(folder))
    assert torch.equal(BertEncoder(lost)(PROMPTS)[0], tokens)


def test_the_digest_is_of_weights_and_words(encoder: BertEncoder, tmp_path: Path) -> None:
    same = BertTextConfig.from_model(write_bert(tmp_path / "same"))
    assert same.digest == encoder.config.digest
    changed = write_bert(tmp_path / "changed")
    for name in ("vocab.txt", "tokenizer.json"):
        file = changed / name
        file.write_text(file.read_text().replace("table", "chair"))
    assert BertTextConfig.from_model(changed).digest != encoder.config.digest


def test_what_is_no_bert_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InvalidInputError, match="holds no BERT"):
        BertTextConfig.from_model(tmp_path)
    transformers.GPT2Config(n_layer=1, n_head=1, n_embd=4).save_pretrained(tmp_path / "gpt2")
    with pytest.raises(InvalidInputError, match="is a 'gpt2' model, not a BERT"):
        BertTextConfig.from_model(tmp_path / "gpt2")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(InvalidInputError, match="hf download some-one/no-such-bert"):
        text_config("some-one/no-such-bert", [])
    broken = write_bert(tmp_path / "broken")
    from safetensors.torch import load_file, save_file

    weights = load_file(broken / "model.safetensors")
    del weights["encoder.layer.1.output.dense.weight"]
    save_file(weights, broken / "model.safetensors", {"format": "pt"})
    with pytest.raises(InvalidInputError, match=r"lacks weights: encoder\.layer\.1\.output\.dense\.weight"):
        BertTextConfig.from_model(broken)
    (broken / "model.safetensors").write_bytes(b"nothing")
    with pytest.raises(InvalidInputError, match="holds no BERT"):
        BertTextConfig.from_model(broken)


def test_long_prompts_are_refused_and_unknown_words_listed(
    encoder: BertEncoder, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(InvalidInputError, match="has 32 tokens; BERT reads at most 20"):
        encoder(["a " * 30])
    with caplog.at_level(logging.WARNING):
        encoder(["A scene with a zeppelin and a table."])
    assert "zeppelin" in caplog.text
    assert "table" not in caplog.text


def test_configurations_survive_a_file(encoder: BertEncoder) -> None:
    small = TextConfig(("a", "cup"), width=8, heads=2)
    for config, kind in ((small, TextEncoder), (encoder.config, BertEncoder)):
        assert text_config_from_state(asdict(config)) == config
        assert isinstance(text_encoder(config), kind)
    assert text_config_from_state(None) is None
    assert text_config("vocabulary", ["a cup"]).width == TextConfig(()).width
